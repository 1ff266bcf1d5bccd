// Compiled once for each set of instructions. Everything but the table lies in an anonymous namespace and nothing of
// the standard library is used that could leave a weak symbol: the linker keeps one copy of those, and the copy of
// AVX-512 would crash a machine without it.
#include "kernels.hpp"

#include "paper_kernel.hpp"
#include "score_kernel.hpp"
#include "set_array.hpp"
#include "set_encoder.hpp"
#include "set_sums.hpp"
#include "surroundings.hpp"

extern "C" const echogrid::Kernels ECHOGRID_KERNELS = {
    .variant = ECHOGRID_VARIANT,
    .score = score_poses,
    .prepare_array = prepare_array,
    .polar_table = polar_table,
    .add_scans = add_scans,
    .look_up = look_up,
    .tell_cells = tell_cells,
    .begin_stack = begin_stack,
    .convolve = convolve,
    .finish_cells = finish_cells,
    .look_at_points = look_at_points,
    .add_local_maps = add_local_maps,
};
