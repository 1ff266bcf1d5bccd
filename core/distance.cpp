#include "distance.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>

namespace echogrid {
namespace {

constexpr int32_t nowhere = std::numeric_limits<int32_t>::max() / 2;

// To the nearest marked cell of its column, for each cell.
void find_along(const DistanceField& field) {
    const size_t rows = static_cast<size_t>(field.rows), cols = static_cast<size_t>(field.cols);
    for (size_t i = 0; i < rows * cols; ++i) {
        const int32_t above = i < cols ? nowhere : field.along[i - cols];
        field.along[i] = field.marked[i] ? 0 : std::min(above + 1, nowhere);
    }
    for (size_t i = (rows - 1) * cols; i-- > 0;)
        field.along[i] = std::min(field.along[i], std::min(field.along[i + cols] + 1, nowhere));
}

// From a column of a row to the marked cell nearest to it in another column, squared.
int64_t squared(const int32_t* along, int64_t col, int32_t apex) {
    const int64_t aside = col - apex, down = along[apex];
    return aside * aside + down * down;
}

// The first column in which a later apex is nearer than an earlier one.
int64_t parting(const int32_t* along, int32_t apex, int32_t later) {
    const int64_t i = apex, u = later, g = along[apex], h = along[later];
    return 1 + (u * u - i * i + h * h - g * g) / (2 * (u - i));
}

// The apices of a row, each nearest from its first column on. Returns how many there are.
size_t find_apices(const DistanceField& field, const int32_t* along) {
    size_t count = 0;
    for (int32_t col = 0; col < field.cols; ++col) {
        if (along[col] >= nowhere) continue;
        while (count && squared(along, field.first[count - 1], field.apex[count - 1]) >
                            squared(along, field.first[count - 1], col))
            --count;
        const int64_t from = count ? parting(along, field.apex[count - 1], col) : 0;
        if (from >= field.cols) continue;
        field.apex[count] = col;
        field.first[count++] = static_cast<int32_t>(from);
    }
    return count;
}

}  // namespace

void find_distance(const DistanceField& field) {
    if (field.rows <= 0 || field.cols <= 0) return;
    find_along(field);
    const size_t rows = static_cast<size_t>(field.rows), cols = static_cast<size_t>(field.cols);
    for (size_t row = 0; row < rows; ++row) {
        const int32_t* along = field.along.data() + row * cols;
        float* out = field.distance.data() + row * cols;
        size_t count = find_apices(field, along);
        if (!count) std::fill_n(out, cols, std::numeric_limits<float>::infinity());
        for (int32_t col = field.cols; count && col-- > 0;) {
            out[col] = static_cast<float>(std::sqrt(static_cast<double>(squared(along, col, field.apex[count - 1]))));
            if (col == field.first[count - 1]) --count;
        }
    }
}

}  // namespace echogrid
