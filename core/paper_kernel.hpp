// The paper's network: readings in, a local map out; and local maps into the global one. Included by kernels.cpp.
#pragma once

#include "dense.hpp"
#include "paper_network.hpp"

namespace {

using namespace echogrid;

constexpr int AT_ONCE = POINTS_AT_ONCE / lanes;

inline Floats read_for(const PaperPoints& points, const float* ranges, const int32_t* sonar) {
    Floats reading;
    for (int lane = 0; lane < lanes; ++lane)
        reading[lane] = sonar[lane] < points.sonars ? ranges[sonar[lane]] : __builtin_nanf("");
    return reading;
}

// What the network is told of the readings of some points, [5 zone][POINTS_AT_ONCE], and which of them are looked at.
inline void tell_points(const PaperPoints& points, int zone, const float* ranges, int at, float* told,
                        Ints (&looked)[AT_ONCE]) {
    constexpr int32_t INFINITE = 0x7f800000;
    for (int v = 0; v < AT_ONCE; ++v) {
        looked[v] = Ints{};
        for (int k = 0; k < zone; ++k) {
            const int64_t place = static_cast<int64_t>(k) * points.count + at + v * lanes;
            const Floats reading = read_for(points, ranges, points.sonar + place);
            const Ints held = bits(reading) & 0x7fffffff;
            const Ints echo = held < INFINITE, silent = held == INFINITE;
            const Floats beyond = (echo ? reading : Floats{}) - load(points.distance + place);
            const Floats one = all(1.0F);
            const Floats values[5] = {
                echo ? one : Floats{},
                silent ? one : Floats{},
                echo ? smaller(reading, 4.0F) * 0.5F : Floats{},
                echo ? within(beyond * (1 / 0.6F), -1.0F, 1.0F) : Floats{},
                echo ? larger(1.0F - absolute(beyond) * 5.0F, 0.0F) : Floats{},
            };
            for (int i = 0; i < 5; ++i) store(told + (i * zone + k) * POINTS_AT_ONCE + v * lanes, values[i]);
            looked[v] |= (held <= INFINITE) & loaded<Ints>(points.looks + place);
        }
    }
}

// Args:
//   ranges: of the scan, m [sonars]; inf: no echo, nan: not fired.
//   room: floats, as many as paper_room says.
//   told: [count], probability that each point is occupied; where none looks the prior, UNSPOKEN below it.
void look_at_points(const PaperWeights& w, const PaperPoints& points, const float* ranges, float* room, float* told) {
    const Flushing flushing;
    constexpr float LIMIT_ODDS = 4.0F;  // log-odds at which the output levels off
    float* const hidden = room + 5 * w.zone * POINTS_AT_ONCE;
    float* const hidden2 = hidden + w.first * POINTS_AT_ONCE;
    for (int at = 0; at < points.count; at += POINTS_AT_ONCE) {
        Ints looked[AT_ONCE];
        tell_points(points, w.zone, ranges, at, room, looked);
        dense<AT_ONCE>(
            w.w0, w.first, 5 * w.zone, room,
            [&](int i, int v) {
                return load(points.place + static_cast<int64_t>(i) * points.count + at + v * lanes);
            },
            [&](int i, int v, Floats sum) { store(hidden + i * POINTS_AT_ONCE + v * lanes, larger(sum, 0.0F)); });
        dense<AT_ONCE>(
            w.w1, w.second, w.first, hidden, [&](int i, int) { return all(w.b1[i]); },
            [&](int i, int v, Floats sum) { store(hidden2 + i * POINTS_AT_ONCE + v * lanes, larger(sum, 0.0F)); });
        dense<AT_ONCE>(
            w.w2, 1, w.second, hidden2, [&](int, int) { return all(w.b2); },
            [&](int, int v, Floats sum) {
                const Floats odds = LIMIT_ODDS * hyperbolic_tangent(sum * (1 / LIMIT_ODDS));
                const Floats p = 1.0F / (1.0F + exponential(-odds));
                store(told + at + v * lanes, looked[v] != 0 ? p : all(points.prior - UNSPOKEN));
            });
    }
}

// Whether points (robot's frame, m) lie under the robot, or in the range and cone of a sonar that fired.
inline Ints reached(const LocalRule& rule, const float* ranges, Floats x, Floats y) {
    Ints within_any = x * x + y * y <= rule.footprint * rule.footprint;
    for (int k = 0; k < rule.count; ++k) {
        if (__builtin_isnan(ranges[k])) continue;
        const Beam& beam = rule.beams[k];
        const Floats dx = x - beam.x, dy = y - beam.y, distance = root(dx * dx + dy * dy);
        within_any |= (distance <= beam.longest) & (dx * beam.cos + dy * beam.sin >= rule.cone * distance);
    }
    return within_any;
}

// Evidence of a scan for points of its robot's frame by eq. 4, and where it says anything.
inline Floats resampled(const LocalRule& rule, const LocalScan& scan, Floats x, Floats y, Ints& spoken) {
    constexpr float LAST = LOCAL_CELLS - 2;
    const Floats in_x = x * (1 / LOCAL_CELL_M) + 0.5F * (LOCAL_CELLS - 1);
    const Floats in_y = y * (1 / LOCAL_CELL_M) + 0.5F * (LOCAL_CELLS - 1);
    const Ints col = whole(within(in_x, 0.0F, LAST)), row = whole(within(in_y, 0.0F, LAST));
    const Floats u = in_x - as_floats(col), v = in_y - as_floats(row);
    spoken = (u >= 0.0F) & (u <= 1.0F) & (v >= 0.0F) & (v <= 1.0F);
    uint32_t places[lanes];
    store(places, row * LOCAL_CELLS + col);
    Floats told[4];
    pairs_at(scan.told, places, told[0], told[1]);
    pairs_at(scan.told + LOCAL_CELLS, places, told[2], told[3]);
    const float unspoken = rule.on_log_odds ? UNSPOKEN_ON_LOG_ODDS : UNSPOKEN;
    Ints any_told{};
    Floats sum{}, total{};
    for (int k = 0; k < 4; ++k) {
        const Floats du = u - static_cast<float>(k % 2), dv = v - static_cast<float>(k / 2);
        const Floats weight = 1.0F / root(du * du + dv * dv + 1e-12F);
        const Ints said = told[k] > -unspoken / 4;
        any_told |= said;
        total += weight;
        sum += weight * (said ? told[k] : told[k] + unspoken);
    }
    spoken &= any_told;
    if (scan.ranges) spoken &= reached(rule, scan.ranges, x, y);
    Floats p = sum / total;
    if (rule.on_log_odds) p = 1.0F / (1.0F + exponential(-p));
    p = within(p, rule.least, rule.most);
    return logarithm(p / (1.0F - p)) - rule.prior;
}

using Bytes = int8_t __attribute__((vector_size(lanes)));

// Cells of a row of the window from col on, as many as there are lanes; the first of them that counts is `from`.
inline void add_cells(const LocalWindow& window, const LocalRule& rule, const LocalScan& scan, int row, int col,
                      int from, float* log_odds, uint8_t* observed, int32_t* views) {
    const float y = scan.y + static_cast<float>(row - scan.row) * window.cell;
    const Floats x = scan.x + as_floats(counted() + (col - scan.col)) * window.cell;
    Ints spoken;
    const Floats evidence = resampled(rule, scan, scan.cos * x + scan.sin * y, scan.cos * y - scan.sin * x, spoken);
    spoken &= counted() + col >= from;
    store(log_odds, load(log_odds) + (spoken ? evidence : Floats{}));
    store(views, loaded<Ints>(views) - spoken);
    const Bytes seen = __builtin_convertvector(spoken, Bytes);
    store(observed, loaded<Bytes>(observed) | (seen & 1));
}

// The same where the window has fewer columns than a vector lanes.
inline void add_narrow(const LocalWindow& window, const LocalRule& rule, const LocalScan& scan, int row,
                       float* log_odds, uint8_t* observed, int32_t* views) {
    float log_odds_of[lanes] = {};
    uint8_t observed_of[lanes] = {};
    int32_t views_of[lanes] = {};
    add_cells(window, rule, scan, row, 0, 0, log_odds_of, observed_of, views_of);
    for (int col = 0; col < window.cols; ++col) {
        log_odds[col] += log_odds_of[col];
        observed[col] |= observed_of[col];
        views[col] += views_of[col];
    }
}

// Add scans by Bayes' rule to the rows first <= row < last of a window.
void add_local_maps(const LocalWindow& window, const LocalRule& rule, const LocalScan* scans, int count, int first,
                    int last) {
    const Flushing flushing;
    // How far the outermost centres lie from the robot, and a little, whatever rounding makes of it.
    constexpr float FAR_OFF_M = 0.5F * (LOCAL_CELLS - 1) * LOCAL_CELL_M * 1.4143F;
    for (const LocalScan* scan = scans; scan < scans + count; ++scan) {
        const int low = scan->row + static_cast<int>(__builtin_floorf((-FAR_OFF_M - scan->y) / window.cell));
        const int high = scan->row + static_cast<int>(__builtin_ceilf((FAR_OFF_M - scan->y) / window.cell)) + 1;
        for (int row = larger(first, low); row < smaller(last, high); ++row) {
            const float y = scan->y + static_cast<float>(row - scan->row) * window.cell;
            const float half = __builtin_sqrtf(larger(FAR_OFF_M * FAR_OFF_M - y * y, 0.0F));
            const int begin =
                larger(0, scan->col + static_cast<int>(__builtin_floorf((-half - scan->x) / window.cell)));
            const int end = smaller(
                window.cols, scan->col + static_cast<int>(__builtin_ceilf((half - scan->x) / window.cell)) + 1);
            float* const log_odds = window.log_odds + row * window.log_odds_stride;
            uint8_t* const observed = window.observed + row * window.observed_stride;
            int32_t* const views = window.views + row * window.views_stride;
            if (window.cols < lanes) {
                add_narrow(window, rule, *scan, row, log_odds, observed, views);
                continue;
            }
            for (int from = begin; from < end; from += lanes) {
                const int col = smaller(from, window.cols - lanes);
                add_cells(window, rule, *scan, row, col, from, log_odds + col, observed + col, views + col);
            }
        }
    }
}

}  // namespace
