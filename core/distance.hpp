// How far each cell of a map is from the nearest of some. No heap: the memory belongs to the caller.
#pragma once

#include <cstdint>
#include <span>

namespace echogrid {

// A map row by row; `along` is scratch of a value for each cell, `first` and `apex` of one for each column.
struct DistanceField {
    int32_t rows, cols;
    std::span<const bool> marked;
    std::span<float> distance;  // out, in cells, between the middles; inf where no cell is marked
    std::span<int32_t> along, first, apex;
};

// Exact but for the rounding of float32: the two passes of Meijster, Roerdink & Hesselink (2000), a time that is the
// same for each cell.
void find_distance(const DistanceField& field);

}  // namespace echogrid
