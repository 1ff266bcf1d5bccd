// A layer of the stack that reads surroundings: a dilated convolution of 3 x 3 taps, several rows at once.
//
// Rows that lie a dilation apart are taken together, so that fewer products serve them all (Winograd's minimal
// filtering: Lavin and Gray, Fast Algorithms for Convolutional Neural Networks, CVPR 2016): 4 rows by 6 products for
// each column of taps rather than 12, 2 rows by 4 rather than 6.
#pragma once

#include "dense.hpp"
#include "surroundings_types.hpp"

namespace {

using namespace echogrid;

static_assert(STRETCH % (TILE * lanes) == 0 && MARGIN % (lanes / 2) == 0);

// Rows of squares to products of the taps' rows, and products back to rows.
inline void spread(const Floats (&x)[4], Floats (&to)[4]) {
    to[0] = x[0] - x[2], to[1] = x[1] + x[2], to[2] = x[2] - x[1], to[3] = x[1] - x[3];
}

inline void spread(const Floats (&x)[6], Floats (&to)[6]) {
    const Floats a = x[4] - 4.0F * x[2], b = x[3] - 4.0F * x[1], c = x[4] - x[2], d = 2.0F * (x[3] - x[1]);
    to[0] = 4.0F * x[0] - 5.0F * x[2] + x[4];
    to[1] = a + b, to[2] = a - b, to[3] = c + d, to[4] = c - d;
    to[5] = 4.0F * x[1] - 5.0F * x[3] + x[5];
}

inline void gather(const Floats (&m)[4], Floats (&y)[2]) { y[0] = m[0] + m[1] + m[2], y[1] = m[1] - m[2] - m[3]; }

inline void gather(const Floats (&m)[6], Floats (&y)[4]) {
    const Floats a = m[1] + m[2], b = m[1] - m[2], c = m[3] + m[4], d = m[3] - m[4];
    y[0] = m[0] + a + c, y[1] = b + 2.0F * d, y[2] = a + 4.0F * c, y[3] = b + 8.0F * d + m[5];
}

// Past the rim all is unknown, and stays so.
inline Floats inside(const ReadOut& r, int col, Floats value) { return counted() + col < r.wide ? value : Floats{}; }

inline void clear_margins(const ReadOut& r, float* row, int units) {
    for (int k = 0; k < units; ++k) {
        for (int col = 0; col < MARGIN; ++col) {
            row[k * r.pitch + col] = 0.0F;
            row[k * r.pitch + MARGIN + r.padded + col] = 0.0F;
        }
    }
}

// One after the other as many units and columns of vectors as a tile holds: work<K, T>(k, col). What is narrower than
// the widest tile is higher, so that no sum waits for the one before; units are a multiple of 4.
template <typename Work>
inline void in_tiles(int units, int columns, const Work& work) {
    constexpr int HALF = TILE / 2, ONE = TILE == 6 ? 16 : 8;
    int col = 0;
    for (; col + TILE * lanes <= columns; col += TILE * lanes)
        for (int k = 0; k < units; k += 4) work.template operator()<4, TILE>(k, col);
    const auto narrow = [&]<int K, int T>() {
        for (; col + T * lanes <= columns; col += T * lanes) {
            int k = 0;
            for (; k + K <= units; k += K) work.template operator()<K, T>(k, col);
            for (; k < units; k += 4) work.template operator()<4, T>(k, col);
        }
    };
    if constexpr (HALF > 1) narrow.template operator()<8, HALF>();
    narrow.template operator()<ONE, 1>();
}

// N rows, a dilation apart from each other, of a layer, or those of them that are wanted.
template <int N>
class Rows {
   public:
    Rows(const ReadOut& r, int layer, const Squares& wanted, int row)
        : r_(r), wanted_(wanted), layer_(layer), dilation_(DILATIONS[layer]), units_(r.around.units), row_(row) {
        for (int i = 0; i < N + 2; ++i) {
            const int at = row + (i - 1) * dilation_;
            // What lies past those that the wanted ones need counts nothing in them, and need not be known.
            const bool known = at >= 0 && at < r.high && at < wanted.row_end + dilation_;
            from_[i] = known ? line(r.hidden[layer % 2], at) : nullptr;
        }
    }

    // Room for (N + 2) units (STRETCH_PITCH + STRETCH) floats.
    void convolve(float* room) const {
        float* products = room + (N + 2) * units_ * STRETCH_PITCH;
        for (int col = wanted_.col; col < wanted_.col_end; col += STRETCH) {
            const int columns = wanted_.col_end - col < STRETCH ? wanted_.col_end - col : STRETCH;
            spread_columns(col, columns, room);
            for (int e = 0; e < N + 2; ++e) multiply(e, columns, room, products);
            gather_columns(col, columns, products);
        }
        for (int j = 0; j < N && wanted_here(j); ++j)
            clear_margins(r_, line(r_.hidden[(layer_ + 1) % 2], row_ + j * dilation_) - MARGIN, units_);
    }

   private:
    bool wanted_here(int j) const { return row_ + j * dilation_ < wanted_.row_end; }

    float* line(float* hidden, int row) const {
        return hidden + static_cast<int64_t>(row) * units_ * r_.pitch + MARGIN;
    }

    void spread_columns(int first, int columns, float* to) const {
        const float* from[N + 2] = {};
        for (int i = 0; i < N + 2; ++i) from[i] = from_[i] ? from_[i] + first - MARGIN : nullptr;
        const int step = units_ * STRETCH_PITCH, pitch = r_.pitch;
        for (int k = 0; k < units_; ++k, to += STRETCH_PITCH) {
            for (int col = 0; col < columns + 2 * MARGIN; col += lanes) {
                Floats x[N + 2], v[N + 2];
                for (int i = 0; i < N + 2; ++i) x[i] = from[i] ? load(from[i] + k * pitch + col) : Floats{};
                spread(x, v);
                for (int e = 0; e < N + 2; ++e) store(to + e * step + col, v[e]);
            }
        }
    }

    void multiply(int e, int columns, const float* room, float* products) const {
        const float* weights = r_.around.layers[layer_] + ((N == 4 ? 0 : 6) + e) * 3 * units_ * units_;
        const float* from = room + e * units_ * STRETCH_PITCH + MARGIN;
        float* to = products + e * units_ * STRETCH;
        in_tiles(units_, columns, [&]<int K, int T>(int k, int col) {
            Floats sum[K][T] = {};
            for (int tap = 0; tap < 3; ++tap)
                tile<K, T>(
                    weights + tap * units_ * units_ + k, units_, units_, from + col + (tap - 1) * dilation_,
                    STRETCH_PITCH, [&](int i, int t) { return sum[i][t]; },
                    [&](int i, int t, Floats total) { sum[i][t] = total; });
            for (int i = 0; i < K; ++i)
                for (int t = 0; t < T; ++t) store(to + (k + i) * STRETCH + col + t * lanes, sum[i][t]);
        });
    }

    // h becomes max(h + its convolution, 0).
    void gather_columns(int first, int columns, const float* products) const {
        const float* from[N] = {};
        float* to[N] = {};
        int rows = 0;
        for (; rows < N && wanted_here(rows); ++rows) {
            from[rows] = from_[rows + 1] + first;
            to[rows] = line(r_.hidden[(layer_ + 1) % 2], row_ + rows * dilation_) + first;
        }
        const int wide = r_.wide - first, step = units_ * STRETCH, pitch = r_.pitch;
        for (int k = 0; k < units_; ++k) {
            const float bias = r_.around.bias[layer_][k];
            const float* product = products + k * STRETCH;
            for (int col = 0; col < columns; col += lanes) {
                Floats m[N + 2], y[N];
                for (int e = 0; e < N + 2; ++e) m[e] = load(product + e * step + col);
                gather(m, y);
                const Ints known = counted() + col < wide;
#pragma GCC unroll 4
                for (int j = 0; j < N; ++j) {
                    if (j >= rows) break;
                    const Floats total = larger(load(from[j] + k * pitch + col) + bias + y[j], 0.0F);
                    store(to[j] + k * pitch + col, known ? total : Floats{});
                }
            }
        }
    }

    const ReadOut& r_;
    const Squares& wanted_;
    int layer_, dilation_, units_, row_;
    const float* from_[N + 2];
};

// Groups of rows of a layer: the first rows of a block of 4 dilations one after the other, then those of the next.
void convolve(const ReadOut& r, int layer, const Squares& wanted, int first, int last, float* room) {
    const Flushing flushing;
    const int dilation = DILATIONS[layer];
    for (int group = first; group < last; ++group) {
        const int row = wanted.row + group / dilation * 4 * dilation + group % dilation;
        if (row + 2 * dilation < wanted.row_end)
            Rows<4>(r, layer, wanted, row).convolve(room);
        else if (row < wanted.row_end)
            Rows<2>(r, layer, wanted, row).convolve(room);
    }
}

}  // namespace
