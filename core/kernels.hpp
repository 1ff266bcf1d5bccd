// The kernels of one set of instructions, as a table of functions: the only name that an object of kernels exports.
#pragma once

#include "paper_network.hpp"
#include "score.hpp"
#include "set_network.hpp"
#include "surroundings_types.hpp"

namespace echogrid {

struct Kernels {
    const char* variant;  // "v2", "v3", "v4" of x86-64, "neon" or "baseline"

    // Scores of `count` poses [x (m), y (m), heading (rad)], finite: sums of log(1 + a b) over the points.
    void (*score)(const ScoreMap& map, const ScorePoints& points, const double* poses, size_t count, float* scores);

    // The set network, in the order in which its kernels follow each other; see set_array.hpp, set_encoder.hpp,
    // set_sums.hpp, surroundings.hpp and convolution.hpp.
    void (*prepare_array)(const SetRobot& robot, const Bearings& bearings, SetArray& array);
    void (*polar_table)(const SetWeights& w, const SetRobot& robot, const SetArray& array, const float* ranges,
                        const float* traits, float* room, float* table, float* until);
    void (*add_scans)(const SetWindow& window, const SetScan* scans, int count, int first, int last);
    void (*look_up)(const SetScan& scan, const float* x, const float* y, int count, float* found);
    void (*tell_cells)(const ReadOut& r, int first, int last, float* room);
    void (*begin_stack)(const ReadOut& r, int first, int last);
    void (*convolve)(const ReadOut& r, int layer, const Squares& wanted, int first, int last, float* room);
    void (*finish_cells)(const ReadOut& r, int first, int last, float* room);

    // The paper's network; see paper_kernel.hpp.
    void (*look_at_points)(const PaperWeights& w, const PaperPoints& points, const float* ranges, float* room,
                           float* told);
    void (*add_local_maps)(const LocalWindow& window, const LocalRule& rule, const LocalScan* scans, int count,
                           int first, int last);
};

}  // namespace echogrid

#if defined(__x86_64__)
extern "C" const echogrid::Kernels echogrid_kernels_v2, echogrid_kernels_v3, echogrid_kernels_v4;
#elif defined(__aarch64__)
extern "C" const echogrid::Kernels echogrid_kernels_neon;
#else
extern "C" const echogrid::Kernels echogrid_kernels_baseline;
#endif
