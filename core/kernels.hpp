// The kernels of one set of instructions, as a table of functions: the only name that an object of kernels exports.
#pragma once

#include "score.hpp"

namespace echogrid {

struct Kernels {
    const char* variant;  // "v2", "v3", "v4" of x86-64, "neon" or "baseline"

    // Scores of `count` poses [x (m), y (m), heading (rad)], finite: sums of log(1 + a b) over the points.
    void (*score)(const ScoreMap& map, const ScorePoints& points, const double* poses, size_t count, float* scores);
};

}  // namespace echogrid

#if defined(__x86_64__)
extern "C" const echogrid::Kernels echogrid_kernels_v2, echogrid_kernels_v3, echogrid_kernels_v4;
#elif defined(__aarch64__)
extern "C" const echogrid::Kernels echogrid_kernels_neon;
#else
extern "C" const echogrid::Kernels echogrid_kernels_baseline;
#endif
