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
#define ECHOGRID_LOW 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29
#define ECHOGRID_HIGH 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31
#define ECHOGRID_FIRST 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29
#define ECHOGRID_SECOND 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31
#elif defined(__AVX__)
#define ECHOGRID_LOW 0, 8, 1, 9, 4, 12, 5, 13
#define ECHOGRID_HIGH 2, 10, 3, 11, 6, 14, 7, 15
#define ECHOGRID_FIRST 0, 1, 8, 9, 4, 5, 12, 13
#define ECHOGRID_SECOND 2, 3, 10, 11, 6, 7, 14, 15
#else
#define ECHOGRID_LOW 0, 4, 1, 5
#define ECHOGRID_HIGH 2, 6, 3, 7
#define ECHOGRID_FIRST 0, 1, 4, 5
#define ECHOGRID_SECOND 2, 3, 6, 7
#endif

// Four numbers of each point in, four vectors of a number of each point out.
inline Corners corners(const float* fours) {
    const Floats a = load(fours), b = load(fours + lanes), c = load(fours + 2 * lanes), d = load(fours + 3 * lanes);
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

// One axis of a pose in cells, as a whole cell and what is left of it: a cell far out is as sharp as one near, and a
// float32 holds where the points are from there.
struct Axis {
    int32_t base;     // cell from which the points are counted, so far before the pose that no point comes before it
    float pose;       // of the pose, from base
    float low, high;  // first unknown cell before the map and behind it, from base

    Axis(double value, int32_t cells, int32_t reach) {
        // Where no point reaches the map it does not matter how far it is away.
        const double first = -2.0 * reach - 4, last = cells + 2.0 * reach + 4;
        value = value < first ? first : value > last ? last : value;
        const double whole = __builtin_floor(value);
        base = static_cast<int32_t>(whole) - reach;
        pose = static_cast<float>(value - whole) + static_cast<float>(reach);
        low = static_cast<float>(-ScoreMap::before - base);
        high = static_cast<float>(cells - base);
        // What lies before base is no place where a point is.
        low = low < 0.0F ? 0.0F : low;
    }
};

constexpr int in_a_row = 4;  // factors until a product might leave the range of float32
constexpr size_t block = in_a_row * lanes;

// The cells round the points of a block.
struct Fetched {
    Floats u[in_a_row], v[in_a_row];               // how far a point lies between two cells, 0 to 1
    alignas(64) float fours[in_a_row][4 * lanes];  // as `corners` takes them
};

float score_pose(const ScoreMap& map, const ScorePoints& points, const double* pose) {
    // A cell is known by its centre, half a cell from its corner.
    const Axis x0((pose[0] - map.x) * map.cells_per_m - 0.5, map.cols, points.reach_cells);
    const Axis y0((pose[1] - map.y) * map.cells_per_m - 0.5, map.rows, points.reach_cells);
    const float cosine = static_cast<float>(__builtin_cos(pose[2]) * map.cells_per_m);
    const float sine = static_cast<float>(__builtin_sin(pose[2]) * map.cells_per_m);
    const int32_t stride = map.cols + ScoreMap::cols_around;
    const float* pairs =
        map.pairs + 2 * (static_cast<int64_t>(y0.base + ScoreMap::before) * stride + x0.base + ScoreMap::before);
    static_assert(ScorePoints::multiple % block == 0);

    Fetched fetched[2];
    Product product;
    const auto fetch = [&](size_t begin) {
        Fetched& to = fetched[begin / block % 2];
        for (int k = 0; k < in_a_row; ++k) {
            const Floats px = load(points.x + begin + k * lanes), py = load(points.y + begin + k * lanes);
            const Floats x = clamp(px * cosine - py * sine + x0.pose, x0.low, x0.high);
            const Floats y = clamp(px * sine + py * cosine + y0.pose, y0.low, y0.high);
            const Ints col = __builtin_convertvector(x, Ints), row = __builtin_convertvector(y, Ints);
            to.u[k] = x - as_floats(col);
            to.v[k] = y - as_floats(row);
            const Ints index = row * stride + col;
            alignas(64) int32_t at[lanes];
            __builtin_memcpy(at, &index, sizeof index);
            for (int i = 0; i < lanes; ++i)
                __builtin_memcpy(&to.fours[k][i % 4 * lanes + i / 4 * 4], pairs + 2 * static_cast<int64_t>(at[i]),
                                 16);
        }
    };
    const auto blend = [&](size_t begin) {
        const Fetched& from = fetched[begin / block % 2];
        for (int k = 0; k < in_a_row; ++k) {
            const Corners b = corners(from.fours[k]);
            const Floats u = from.u[k], v = from.v[k];
            const Floats low = b.here + u * (b.right - b.here), high = b.above + u * (b.across - b.above);
            const Floats factor = 1.0F + load(points.a + begin + k * lanes) * (low + v * (high - low));
            product.mantissa *= factor < least_factor ? Floats{} + least_factor : factor;
        }
        product.normalise();
    };
    // A block is blended while the next one is on its way: what was just stored cannot be loaded in other portions at
    // once.
    if (points.count > 0) fetch(0);
    for (size_t begin = 0; begin < points.count; begin += block) {
        if (begin + block < points.count) fetch(begin + block);
        blend(begin);
    }
    return static_cast<float>(product.logarithm());
}

void score_poses(const ScoreMap& map, const ScorePoints& points, const double* poses, size_t count, float* scores) {
    for (size_t i = 0; i < count; ++i) scores[i] = score_pose(map, points, poses + 3 * i);
}

}  // namespace
