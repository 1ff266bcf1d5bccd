// The set network: what its kernels share. Numbers are those of models/networks of the Python package.
#pragma once

#include <stdint.h>

namespace echogrid {

constexpr int TOKENS = 6;     // sonars that are asked for a bearing
constexpr int FEATURES = 20;  // numbers that are told of each
constexpr int TRAITS = 4;     // numbers that say what the surroundings are like
constexpr int BEARINGS = 64;  // of the polar table
constexpr int RINGS = 51;     // likewise; the farthest that is looked up lies just beyond REACH_M
constexpr int PITCH = 80;     // floats from one ring of it to the next; the first bearing comes again behind the last
constexpr int TABLE = RINGS * PITCH;
constexpr int PAIRS = TOKENS * (TOKENS - 1) / 2;
constexpr float RING_M = 0.05F;
constexpr float REACH_M = 2.5F;
constexpr float FAR_M = 4.0F;   // readings beyond are all alike
constexpr int STEP_BENDS = 10;  // what the profile of an echo is made of: a number, and a bend at each of nine knots
constexpr int RING_BENDS = 9;   // likewise the profile by distance
constexpr int FUSE_UNITS = 12;
constexpr int LEAST_COLS = 16;  // of a window, as many as the widest vectors have lanes

// Weights of what reads a scan and fuses views; matrices [in][out]. Those of profiles give them as bends; the first
// of an echo's is the profile less what all its bends have at their knots.
struct SetWeights {
    int units;
    const float *w1, *b1, *a1, *w2, *w2p, *w2t, *b2, *a2, *steps, *steps_b, *w3, *b3, *rings, *rings_b;
    const float *ws, *wf, *bf, *wz;
};

// Floats that the weights take, one array after the other.
constexpr int set_weights_size(int h) {
    return FEATURES * h + h + 2 * h + h * h + 2 * h * h + TRAITS * h + h + 2 * h + STEP_BENDS * (h + 1) + 2 * h * h +
           h + RING_BENDS * (h + 1) + 1 + 4 * FUSE_UNITS + 2 * FUSE_UNITS;
}

static inline SetWeights set_weights(const float* from, int h) {
    SetWeights w{};
    w.units = h;
    const auto next = [&from](int count) {
        const float* begin = from;
        from += count;
        return begin;
    };
    w.w1 = next(FEATURES * h), w.b1 = next(h), w.a1 = next(2 * h);
    w.w2 = next(h * h), w.w2p = next(2 * h * h), w.w2t = next(TRAITS * h), w.b2 = next(h), w.a2 = next(2 * h);
    w.steps = next(STEP_BENDS * h), w.steps_b = next(STEP_BENDS);
    w.w3 = next(2 * h * h), w.b3 = next(h);
    w.rings = next(RING_BENDS * h), w.rings_b = next(RING_BENDS);
    w.ws = next(1), w.wf = next(4 * FUSE_UNITS), w.bf = next(FUSE_UNITS), w.wz = next(FUSE_UNITS);
    return w;
}

// The robot and its sonars; angles in rad, the rest in m.
struct SetRobot {
    int sonars;
    const double* mounts;    // [sonars][3]: forward, left, axis; nan: no such sonar
    const float* max_range;  // [sonars]
    float footprint;         // radius
    float beam;              // half the beam width
    int under;               // rings on which the robot itself stands
    bool ends;               // whether what a sonar tells ends at its range
};

struct Bearings {
    double cos[BEARINGS], sin[BEARINGS];
};

// What an array fixes of the polar table: of the sonars asked for each bearing, turned so that the nearest has it on
// its left.
struct alignas(64) SetArray {
    float axis[TOKENS][BEARINGS], axis_sin[TOKENS][BEARINGS], axis_cos[TOKENS][BEARINGS];
    float ahead[TOKENS][BEARINGS], aside[TOKENS][BEARINGS];
    float max_range[TOKENS][BEARINGS];        // at most FAR_M
    float near[PAIRS][BEARINGS];              // how nearly the same way two of them look, 0 to 1
    float distance[TOKENS][RINGS][BEARINGS];  // from each sonar to each point
    float after[TOKENS][BEARINGS],
        before[TOKENS][BEARINGS];     // how far it tells up to the next bearing; from the last
    int32_t looks[RINGS][BEARINGS];   // bit k: the sonar of token k looks at the point
    int32_t sonar[TOKENS][BEARINGS];  // index of the reading; as many as there are sonars: none
};

// Floats of room that the table of one scan is worked out in.
constexpr int set_room(int sonars, int h) {
    return 2 * TOKENS * BEARINGS + sonars + 1 +
           16 * (TOKENS * (FEATURES + 2 * h + 4 + STEP_BENDS) + 4 * h + RINGS + 16) + h + 64;
}

// What a scan is looked up by when it is added to the map.
struct SetScan {
    const float* table;  // [RINGS][PITCH]
    const float* until;  // [BEARINGS], how far it tells of each sector, m; null: to REACH_M everywhere
    float cos, sin;      // of the robot's heading
    float x, y;          // of the centre of the patch's first cell from the robot, world axes, m
    int row, col;        // of that cell in the window
    float weight;
};

// Layers of a window of the map: evidence for and against a surface, and of its squares, looks; and views.
struct SetWindow {
    float* sums[5];
    int32_t* views;
    int64_t stride;  // cells from one row to the next
    int rows, cols;
    float cell;  // side of a cell, m
};

}  // namespace echogrid
