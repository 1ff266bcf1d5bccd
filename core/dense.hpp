// Layers of a network, of many vectors at once.
#pragma once

#include "vector_math.hpp"

namespace {

#if defined(__AVX512F__)
constexpr int TILE = 6;
#else
constexpr int TILE = 3;
#endif

// Sums of K outputs for T vectors each: begin(k, t) + sum over m of w[m][k] x[m][t]; done(k, t, sum).
template <int K, int T, typename Begin, typename Done>
inline __attribute__((always_inline)) void tile(const float* w, int outs, int ins, const float* x, int row,
                                                const Begin& begin, const Done& done) {
    Floats sum[K][T];
#pragma GCC unroll 16
    for (int k = 0; k < K; ++k)
#pragma GCC unroll 8
        for (int t = 0; t < T; ++t) sum[k][t] = begin(k, t);
#pragma GCC unroll 1
    for (int m = 0; m < ins; ++m, w += outs, x += row) {
        Floats at[T];
#pragma GCC unroll 8
        for (int t = 0; t < T; ++t) at[t] = load(x + t * lanes);
#pragma GCC unroll 16
        for (int k = 0; k < K; ++k) {
            const Floats weight = all(w[k]);
#pragma GCC unroll 8
            for (int t = 0; t < T; ++t) sum[k][t] += weight * at[t];
        }
    }
#pragma GCC unroll 16
    for (int k = 0; k < K; ++k)
#pragma GCC unroll 8
        for (int t = 0; t < T; ++t) done(k, t, sum[k][t]);
}

// A layer: weights [ins][outs] on x [ins][N vectors]; begin and done as of a tile, of all outputs and vectors.
template <int N, typename Begin, typename Done>
inline void dense(const float* w, int outs, int ins, const float* x, const Begin& begin, const Done& done) {
    constexpr int T = N % TILE == 0 ? TILE : 1;
    for (int t = 0; t < N; t += T) {
        int k = 0;
        const auto from = [&](int i, int j) { return begin(k + i, t + j); };
        const auto to = [&](int i, int j, Floats sum) { done(k + i, t + j, sum); };
        for (; k + 4 <= outs; k += 4) tile<4, T>(w + k, outs, ins, x + t * lanes, N * lanes, from, to);
        if (k + 2 <= outs) tile<2, T>(w + k, outs, ins, x + t * lanes, N * lanes, from, to), k += 2;
        if (k < outs) tile<1, T>(w + k, outs, ins, x + t * lanes, N * lanes, from, to);
    }
}

}  // namespace
