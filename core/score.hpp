// Poses against a map: what the kernel of score reads. The memory belongs to the caller.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace echogrid {

// A map of b = 2 p - 1 in [-1, 1]. For each cell it holds two numbers, b of the cell and of the one above it, so that
// the four cells round a point lie side by side in memory. Round the map lie cells that nobody knows, where b is 0.
struct ScoreMap {
    static constexpr int32_t before = 2;  // rows and columns of unknown cells before the map
    static constexpr int32_t rows_around = 3, cols_around = 4;

    const float* pairs;  // [rows + rows_around, cols + cols_around, 2]; of cell [-before, -before] first
    int32_t rows, cols;  // of the map itself
    double x, y;         // of the lower left corner of cell [0, 0], m
    double cells_per_m;
};

// What was seen from a pose, in the frame of the robot. Padded by points whose a is 0 to a multiple of `multiple`.
struct ScorePoints {
    static constexpr size_t multiple = 64;

    const float *x, *y;  // m
    const float* a;      // 2 p - 1 in [-1, 1]
    size_t count;
    int32_t reach_cells;  // no point lies as many cells away
};

}  // namespace echogrid
