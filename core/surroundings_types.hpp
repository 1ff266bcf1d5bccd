// Reading the map out: what the kernels share. Numbers are those of models/networks/surroundings of the package.
#pragma once

#include <stdint.h>

#include "set_network.hpp"

namespace echogrid {

constexpr int PACK = 2;           // cells along the side of a square that the stack works on
constexpr int CELL_FEATURES = 7;  // numbers that it is told of a cell
constexpr int PLANES =
    PACK * PACK * (CELL_FEATURES + 1);  // of a square; the last say of which cells anything is known
constexpr int LAYERS = 5;
constexpr int DILATIONS[LAYERS] = {1, 2, 4, 8, 1};  // in squares
constexpr int MARGIN = 8;                           // squares past the rim that the widest of them reaches
constexpr int PRODUCTS = 6 + 4;                     // of the rows of taps, for 4 rows of squares at once and for 2
constexpr int REACH = PACK * (1 + 2 + 4 + 8 + 1);   // cells within which the surroundings count

// Weights of what reads cells with their surroundings; matrices [in][out].
struct Around {
    int units, passed, cell_units;  // 0 units: each cell is read alone
    const float *in, *begin;        // [PACK PACK CELL_FEATURES][units]; what the robot's sonars add, [units]
    const float *layers[LAYERS], *bias[LAYERS];  // [PRODUCTS][3][units][units], see convolution.hpp
    const float* pass;                           // [units][PACK PACK passed]
    const float *cell, *cell_bias, *out;         // [CELL_FEATURES + passed][cell_units]
    float scale;
};

// Columns of squares that a convolution works on at once, and its room in floats for each unit.
constexpr int STRETCH = 96, STRETCH_PITCH = STRETCH + 2 * MARGIN;
constexpr int convolution_room = 6 * (STRETCH_PITCH + STRETCH);

// Squares that are wanted of a layer: rows, and columns by whole vectors.
struct Squares {
    int row, row_end, col, col_end;
};

// A rectangle of cells that is read out. It begins at even cells, and consists of whole squares.
struct ReadOut {
    SetWeights set;
    Around around;
    // Of its cells those that are held: evidence for and against a surface, and of its squares, looks, stood.
    const float* held[6];
    int64_t stride;
    int held_row, held_col, held_rows, held_cols;
    float stood;         // log-odds, at most, of floor on which the robot has stood
    float faded, least;  // what evidence has come to count; what is less than this is none
    int high, wide;      // squares
    int padded, pitch;   // squares of a row with those that fill the last vector, and with margins to both sides
    float* told;         // [high][PLANES][pitch]
    float* hidden[2];    // [high][units][pitch]
    // The part of it that is written.
    float* log_odds;
    uint8_t* observed;
    int64_t log_odds_stride, observed_stride;
    int out_row, out_col, out_rows, out_cols;
};

}  // namespace echogrid
