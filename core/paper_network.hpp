// The paper's network on its local map: what its kernels share. Numbers are those of models/networks of the package.
#pragma once

#include <stdint.h>

namespace echogrid {

constexpr int LOCAL_CELLS = 24;  // along the side of the local map, the robot in its middle
constexpr float LOCAL_CELL_M = 0.12F;
constexpr int POINTS_AT_ONCE = 96;              // that the network is asked of; points are filled up to a multiple
constexpr float UNSPOKEN = 4.0F;                // what is not spoken of rides with its value, this much below it,
constexpr float UNSPOKEN_ON_LOG_ODDS = 100.0F;  // or so much where the value is in log-odds

// Weights of the perceptron; matrices [in][out].
struct PaperWeights {
    int zone, first, second;  // sonars that it reads for a point, units of its layers
    const float* w0;          // [5 zone][first]: of the readings and of what lies beyond
    const float *w1, *b1, *w2;
    float b2;
};

// What a robot fixes of points of its frame; arrays [..][count].
struct PaperPoints {
    int sonars, count;      // count is a multiple of POINTS_AT_ONCE
    const int32_t* sonar;   // [zone][..]: index of the reading; as many as there are sonars: none
    const float* distance;  // [zone][..]: from the sonar to the point, m
    const int32_t* looks;   // [zone][..]: -1 where the sonar looks at the point, else 0
    const float* place;     // [first][..]: what the place of the point adds to the first layer
    float prior;
};

// Floats of room that the points of one scan are worked out in.
constexpr int paper_room(int zone, int first, int second) { return POINTS_AT_ONCE * (5 * zone + first + second + 1); }

// A sonar whose range ends within the local map, in the robot's frame.
struct Beam {
    float x, y, cos, sin, longest;
};

// Where a scan's local map lies, and what it tells.
struct LocalScan {
    const float* told;    // [LOCAL_CELLS][LOCAL_CELLS], row 0 the lowest y
    const float* ranges;  // of the beams, m; null: nothing ends within the local map
    float cos, sin;       // of the robot's heading
    float x, y;           // of the centre of the patch's first cell from the robot, world axes, m
    int row, col;         // of that cell in the window
};

// Layers of a window of the map.
struct LocalWindow {
    float* log_odds;
    uint8_t* observed;
    int32_t* views;
    int64_t log_odds_stride, observed_stride, views_stride;
    int rows, cols;
    float cell;  // side of a cell, m
};

// How views are fused.
struct LocalRule {
    float prior;        // log-odds that views contain and are to lose
    float least, most;  // no single view is surer, a probability
    bool on_log_odds;   // whether eq. 4 takes the mean of log-odds in place of probabilities
    float footprint;    // radius of the robot, m
    const Beam* beams;
    int count;   // of beams
    float cone;  // cosine of the angle off its axis at which a beam ends
};

}  // namespace echogrid
