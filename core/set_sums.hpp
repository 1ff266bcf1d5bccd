// What scans tell, added up in the cells of the map.
#pragma once

#include "set_network.hpp"
#include "vector_math.hpp"

namespace {

using namespace echogrid;

// Bearing of points in units of the table's, in [0, BEARINGS]; exact to 0.2 degrees.
inline Floats bearing_of(Floats x, Floats y) {
    constexpr float UNIT = BEARINGS / 6.28318531F;
    const Floats across = absolute(y), along = absolute(x);
    const Floats z = smaller(across, along) / (larger(across, along) + 1e-9F);
    Floats a = z * (BEARINGS / 8.0F + 0.273F * UNIT * (1.0F - z));
    a = across > along ? BEARINGS / 4.0F - a : a;
    a = x < 0.0F ? BEARINGS / 2.0F - a : a;
    return y < 0.0F ? BEARINGS - a : a;
}

// What a scan tells of points in the robot's frame, m: log-odds; 0 = nothing.
template <bool ENDS>
inline Floats looked_up(const SetScan& scan, Floats x, Floats y) {
    const Floats distance = root(x * x + y * y);
    const Floats bearing = bearing_of(x, y), out = larger(distance * (1 / RING_M) - 0.5F, 0.0F);
    const Ints i = whole(smaller(bearing, BEARINGS - 1.0F)), j = whole(smaller(out, RINGS - 2.0F));
    const Floats u = bearing - as_floats(i), v = smaller(out - as_floats(j), 1.0F);
    uint32_t places[lanes];
    store(places, j * PITCH + i);
    __asm__("" : "+m"(places));  // they are to be read from memory, both times: registers are too few to hold them
    Floats near_low, near_high, far_low, far_high;
    pairs_at(scan.table, places, near_low, near_high);
    __asm__("" : "+m"(places));
    pairs_at(scan.table + PITCH, places, far_low, far_high);
    const Floats low = near_low + v * (far_low - near_low), high = near_high + v * (far_high - near_high);
    const Floats found = low + u * (high - low);
    if constexpr (ENDS) {
        store(places, i);
        return distance <= at_each(scan.until, places) ? found : Floats{};
    }
    return distance <= REACH_M ? found : Floats{};
}

inline void add_found(const SetWindow& window, int64_t cell, float weight, Floats found) {
    const Floats occupied = larger(found, 0.0F), free = occupied - found;
    const Ints spoke = found != 0.0F;
    const Floats added[5] = {weight * occupied, weight * free, weight * occupied * occupied, weight * free * free,
                             spoke ? all(weight) : Floats{}};
    for (int n = 0; n < 5; ++n) store(window.sums[n] + cell, load(window.sums[n] + cell) + added[n]);
    store(window.views + cell, loaded<Ints>(window.views + cell) - spoke);
}

// Row of the window, in cells from the patch's first.
template <bool ENDS>
inline void add_row(const SetWindow& window, const SetScan& scan, int row) {
    const float y = scan.y + static_cast<float>(row) * window.cell;
    const float half = __builtin_sqrtf(__builtin_fmaxf(REACH_M * REACH_M - y * y, 0.0F));
    // A cell more on each side than the circle has, whatever rounding makes of it; lanes past it find nothing.
    const int begin = larger(0, scan.col + static_cast<int>(__builtin_floorf((-half - scan.x) / window.cell)));
    const int end =
        smaller(window.cols, scan.col + static_cast<int>(__builtin_ceilf((half - scan.x) / window.cell)) + 1);
    const int64_t cells = (scan.row + row) * window.stride;
    for (int at = begin; at < end; at += lanes) {
        // The last cells of a row that ends at the window's edge go with some before them, which are not counted
        // again.
        const int col = smaller(at, window.cols - lanes);
        const Floats x = scan.x + as_floats(counted() + (col - scan.col)) * window.cell;
        Floats found = looked_up<ENDS>(scan, scan.cos * x + scan.sin * y, scan.cos * y - scan.sin * x);
        if (col < at) found = counted() + col >= at ? found : Floats{};
        add_found(window, cells + col, scan.weight, found);
    }
}

// Add scans to the rows first <= row < last of a window of at least lanes columns.
void add_scans(const SetWindow& window, const SetScan* scans, int count, int first, int last) {
    const Flushing flushing;
    for (const SetScan* scan = scans; scan < scans + count; ++scan) {
        if (!(scan->weight > 0.0F)) continue;
        const int low = scan->row + static_cast<int>(__builtin_floorf((-REACH_M - scan->y) / window.cell));
        const int high = scan->row + static_cast<int>(__builtin_ceilf((REACH_M - scan->y) / window.cell)) + 1;
        for (int row = larger(first, low); row < smaller(last, high); ++row) {
            if (scan->until) {
                add_row<true>(window, *scan, row - scan->row);
            } else {
                add_row<false>(window, *scan, row - scan->row);
            }
        }
    }
}

// What a scan tells of points in the robot's frame, m; room of lanes to spare behind the last.
void look_up(const SetScan& scan, const float* x, const float* y, int count, float* found) {
    const Flushing flushing;
    for (int i = 0; i < count; i += lanes) {
        const Floats at_x = load(x + i), at_y = load(y + i);
        store(found + i, scan.until ? looked_up<true>(scan, at_x, at_y) : looked_up<false>(scan, at_x, at_y));
    }
}

}  // namespace
