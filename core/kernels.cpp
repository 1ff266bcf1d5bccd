// Compiled once for each set of instructions. Everything but the table lies in an anonymous namespace and nothing of
// the standard library is used that could leave a weak symbol: the linker keeps one copy of those, and the copy of
// AVX-512 would crash a machine without it.
#include "kernels.hpp"

#include "score_kernel.hpp"

extern "C" const echogrid::Kernels ECHOGRID_KERNELS = {
    .variant = ECHOGRID_VARIANT,
    .score = score_poses,
};
