// The kernel of score; included by kernels.cpp.
#pragma once

#include "score.hpp"
#include "vectors.hpp"

namespace {

using echogrid::ScoreMap;
using echogrid::ScorePoints;

// A factor 1 + a b is at least what float32 can tell from 0: of two that are sure of the opposite the score is -16.6.
constexpr float least_factor = 0x1p-24F;

// A product of factors, kept as mantissas in [1, 2) and sums of exponents: a logarithm is taken but once a pose.
struct Product {
    Floats mantissa = Floats{} + 1.0F;
    Ints exponent = {};

    void normalise() {
        const Ints held = bits(mantissa);
        exponent += (held >> 23) - 127;
        mantissa = floats_of_bits((held & 0x007fffff) | 0x3f800000);
    }

    double logarithm() const {
        double product = 1.0;
        int64_t power = 0;
        for (int i = 0; i < lanes; ++i) {
            product *= static_cast<double>(mantissa[i]);
            power += exponent[i];
        }
        return __builtin_log(product) + static_cast<double>(power) * 0.693147180559945309417;
    }
};

// b of the cells [row, col], [row + 1, col], [row, col + 1] and [row + 1, col + 1] of each lane.
struct Corners {
    Floats here, above, right, across;
};

#if defined(__AVX512F__)
using Floats8 = float __attribute__((vector_size(32)));

inline Floats side_by_side(Floats4 a, Floats4 b, Floats4 c, Floats4 d) {
    const Floats8 ab = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
    const Floats8 cd = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7);
    return __builtin_shufflevector(ab, cd, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
#define ECHOGRID_LOW 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29
#define ECHOGRID_HIGH 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31
#define ECHOGRID_FIRST 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29
#define ECHOGRID_SECOND 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31
#elif defined(__AVX__)
inline Floats side_by_side(Floats4 a, Floats4 b) { return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7); }
#define ECHOGRID_LOW 0, 8, 1, 9, 4, 12, 5, 13
#define ECHOGRID_HIGH 2, 10, 3, 11, 6, 14, 7, 15
#define ECHOGRID_FIRST 0, 1, 8, 9, 4, 5, 12, 13
#define ECHOGRID_SECOND 2, 3, 10, 11, 6, 7, 14, 15
#else
inline Floats side_by_side(Floats4 a) { return a; }
#define ECHOGRID_LOW 0, 4, 1, 5
#define ECHOGRID_HIGH 2, 6, 3, 7
#define ECHOGRID_FIRST 0, 1, 4, 5
#define ECHOGRID_SECOND 2, 3, 6, 7
#endif

// The four numbers of every fourth point, from the one at `first` on.
inline Floats fours(const float* pairs, const int32_t* index, int first) {
    const auto four = [&](int i) { return load4(pairs + 2 * static_cast<int64_t>(index[first + 4 * i])); };
#if defined(__AVX512F__)
    return side_by_side(four(0), four(1), four(2), four(3));
#elif defined(__AVX__)
    return side_by_side(four(0), four(1));
#else
    return side_by_side(four(0));
#endif
}

// Four numbers of each point in, four vectors of a number of each point out: one load a point and a few shuffles are
// faster than gathers, and every machine has them.
inline Corners corners(const float* pairs, Ints index) {
    alignas(64) int32_t at[lanes];
    __builtin_memcpy(at, &index, sizeof index);
    const Floats a = fours(pairs, at, 0), b = fours(pairs, at, 1), c = fours(pairs, at, 2), d = fours(pairs, at, 3);
    const Floats ab_low = __builtin_shufflevector(a, b, ECHOGRID_LOW),
                 cd_low = __builtin_shufflevector(c, d, ECHOGRID_LOW);
    const Floats ab_high = __builtin_shufflevector(a, b, ECHOGRID_HIGH),
                 cd_high = __builtin_shufflevector(c, d, ECHOGRID_HIGH);
    return {
        .here = __builtin_shufflevector(ab_low, cd_low, ECHOGRID_FIRST),
        .above = __builtin_shufflevector(ab_low, cd_low, ECHOGRID_SECOND),
        .right = __builtin_shufflevector(ab_high, cd_high, ECHOGRID_FIRST),
        .across = __builtin_shufflevector(ab_high, cd_high, ECHOGRID_SECOND),
    };
}

#undef ECHOGRID_LOW
#undef ECHOGRID_HIGH
#undef ECHOGRID_FIRST
#undef ECHOGRID_SECOND

// A coordinate in cells as a whole cell and what is left of it, in double so that a cell far out is as sharp as one
// near.
struct InCells {
    int32_t cell;
    float rest;  // [0, 1)

    explicit InCells(double value) {
        constexpr double far = 0x1p29;  // beyond any map
        value = value < -far ? -far : value > far ? far : value;
        const double whole = __builtin_floor(value);
        cell = static_cast<int32_t>(whole);
        rest = static_cast<float>(value - whole);
    }
};

float score_pose(const ScoreMap& map, const ScorePoints& points, const double* pose) {
    // A cell is known by its centre, half a cell from its corner.
    const InCells x0((pose[0] - map.x) * map.cells_per_m - 0.5), y0((pose[1] - map.y) * map.cells_per_m - 0.5);
    const float cosine = static_cast<float>(__builtin_cos(pose[2]) * map.cells_per_m);
    const float sine = static_cast<float>(__builtin_sin(pose[2]) * map.cells_per_m);
    const int32_t stride = map.cols + ScoreMap::cols_around;
    const float* cell_0 = map.pairs + 2 * (static_cast<int64_t>(ScoreMap::before) * stride + ScoreMap::before);
    constexpr size_t in_a_row = 4;  // factors until a product might leave the range of float32
    static_assert(ScorePoints::multiple % (in_a_row * lanes) == 0);

    Product product;
    for (size_t begin = 0; begin < points.count; begin += in_a_row * lanes) {
        for (size_t i = begin; i < begin + in_a_row * lanes; i += lanes) {
            const Floats px = load(points.x + i), py = load(points.y + i);
            Floats x = px * cosine - py * sine + x0.rest, y = px * sine + py * cosine + y0.rest;
            const Ints col = floor(x), row = floor(y);
            x -= as_floats(col);
            y -= as_floats(row);
            const Ints index = clamp(row + y0.cell, -ScoreMap::before, map.rows) * stride +
                               clamp(col + x0.cell, -ScoreMap::before, map.cols);
            const Corners b = corners(cell_0, index);
            const Floats low = b.here + x * (b.right - b.here), high = b.above + x * (b.across - b.above);
            const Floats factor = 1.0F + load(points.a + i) * (low + y * (high - low));
            product.mantissa *= factor < least_factor ? Floats{} + least_factor : factor;
        }
        product.normalise();
    }
    return static_cast<float>(product.logarithm());
}

void score_poses(const ScoreMap& map, const ScorePoints& points, const double* poses, size_t count, float* scores) {
    for (size_t i = 0; i < count; ++i) scores[i] = score_pose(map, points, poses + 3 * i);
}

}  // namespace
