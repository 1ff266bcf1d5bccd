// What it costs to get from each cell of a map to the nearest goal. No heap: the memory belongs to the caller.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace echogrid {

// A map of costs with a rim of closed cells, so that no step has to ask whether it leaves the map. `cols` is that of
// a row with its rim; all arrays have a value for each cell, the rim's among them, at most 2^31 - 2.
struct CostField {
    int32_t rows, cols;
    std::span<const float> costs;       // of a metre in each cell, >= 0; inf = closed, which the rim must be
    std::span<double> to_go;            // out; inf where no goal can be reached
    std::span<int32_t> next, previous;  // scratch
};

// Steps lead to the eight cells around, diagonal ones only where both cells beside them are open; one costs its
// length times the mean of the costs of its two cells. Goals are cells, counted row by row; one that is closed is
// none.
void find_cost_to_go(const CostField& field, std::span<const int32_t> goals, double resolution);

}  // namespace echogrid
