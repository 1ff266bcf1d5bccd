// The map read out: cells by what their views summed to, and by their surroundings.
#pragma once

#include "convolution.hpp"
#include "dense.hpp"
#include "set_network.hpp"
#include "surroundings_types.hpp"

namespace {

using namespace echogrid;

// Of cells, what speaks for and against a surface, and of its squares, looks, and whether the robot stood there: in,
// as numbers that the stack is told; and whether anything is known of them.
struct Cells {
    Floats told[CELL_FEATURES];
    Floats known;
};

// 1 - e^-a over a, for a >= 0.
inline Floats levelled(Floats a) {
    const Floats series = 1.0F - a * (0.5F - a * (1.0F / 6 - a * (1.0F / 24 - a * (1.0F / 120))));
    return a < 0.3F ? series : (1.0F - exponential(-a)) / larger(a, 0.3F);
}

inline Cells cells_of(const SetWeights& w, const Floats (&sums)[4], Floats looks, Floats stood, float least) {
    constexpr float LOOKS = 24.0F, LOOKS_LOG = 3.21887582F;  // ln(1 + LOOKS)
    const Floats share = levelled(looks * (1 / LOOKS));
    Cells cells;
    for (int i = 0; i < 4; ++i) cells.told[i] = logarithm(1.0F + share * sums[i]);
    Floats total = w.ws[0] * (share * (sums[0] - sums[1]));
    for (int i = 0; i < FUSE_UNITS; ++i) {
        Floats sum = all(w.bf[i]);
        for (int j = 0; j < 4; ++j) sum += w.wf[j * FUSE_UNITS + i] * cells.told[j];
        total += w.wz[i] * larger(sum, 0.0F);
    }
    cells.told[4] = 0.25F * (looks > 0.0F ? total : Floats{});
    cells.told[5] = logarithm(1.0F + looks) * (1 / LOOKS_LOG);
    cells.told[6] = stood > least ? all(1.0F) : Floats{};
    cells.known = sums[0] + sums[1] > least ? all(1.0F) : Floats{};
    return cells;
}

// A row of cells, in the room given as [6][padded], blank where nothing is held.
inline void copy_row(const ReadOut& r, int row, float* room) {
    const int held = row - r.held_row;
    for (int n = 0; n < 6; ++n) {
        float* to = room + n * 2 * r.pitch;
        for (int col = 0; col < 2 * r.pitch; ++col) to[col] = 0.0F;
        if (held < 0 || held >= r.held_rows) continue;
        const float* from = r.held[n] + held * r.stride;
        for (int col = 0; col < r.held_cols; ++col) to[r.held_col + col] = r.faded * from[col];
    }
}

// Rows of squares: what the stack is told of their cells. Room for 12 pitch floats.
void tell_cells(const ReadOut& r, int first, int last, float* room) {
    const Flushing flushing;
    for (int square = first; square < last; ++square) {
        float* to = r.told + static_cast<int64_t>(square) * PLANES * r.pitch;
        for (int a = 0; a < PACK; ++a) {
            copy_row(r, PACK * square + a, room);
            for (int col = 0; col < r.padded; col += lanes) {
                Cells cells[PACK];
                for (int b = 0; b < PACK; ++b) {
                    const float* from = room + 2 * col + b * lanes;
                    const int next = 2 * r.pitch;
                    const Floats sums[4] = {load(from), load(from + next), load(from + 2 * next),
                                            load(from + 3 * next)};
                    cells[b] = cells_of(r.set, sums, load(from + 4 * next), load(from + 5 * next), r.least);
                }
                float* out = to + PACK * a * CELL_FEATURES * r.pitch + MARGIN + col;
                for (int f = 0; f < CELL_FEATURES; ++f) {
                    store(out + f * r.pitch, evens(cells[0].told[f], cells[1].told[f]));
                    store(out + (CELL_FEATURES + f) * r.pitch, odds(cells[0].told[f], cells[1].told[f]));
                }
                float* known = to + (PACK * PACK * CELL_FEATURES + PACK * a) * r.pitch + MARGIN + col;
                store(known, evens(cells[0].known, cells[1].known));
                store(known + r.pitch, odds(cells[0].known, cells[1].known));
            }
        }
    }
}

// The stack's first layer, from the cells of each square.
void begin_stack(const ReadOut& r, int first, int last) {
    const Flushing flushing;
    const int units = r.around.units;
    for (int square = first; square < last; ++square) {
        const float* from = r.told + static_cast<int64_t>(square) * PLANES * r.pitch + MARGIN;
        float* to = r.hidden[0] + static_cast<int64_t>(square) * units * r.pitch;
        in_tiles(units, r.padded, [&]<int K, int T>(int k, int col) {
            tile<K, T>(
                r.around.in + k, units, PACK * PACK * CELL_FEATURES, from + col, r.pitch,
                [&](int i, int) { return all(r.around.begin[k + i]); },
                [&](int i, int t, Floats sum) {
                    const int at = col + t * lanes;
                    store(to + (k + i) * r.pitch + MARGIN + at, inside(r, at, larger(sum, 0.0F)));
                });
        });
        clear_margins(r, to, units);
    }
}

// Log-odds of the cells [a][b] of squares from what is told of each and what the stack passes to it.
inline Floats corrected(const ReadOut& r, const float* told, const float* passed, float* room) {
    const Around& w = r.around;
    for (int f = 0; f < CELL_FEATURES; ++f) store(room + f * lanes, load(told + f * r.pitch));
    for (int p = 0; p < w.passed; ++p) store(room + (CELL_FEATURES + p) * lanes, load(passed + p * lanes));
    Floats total = w.scale * 4.0F * load(told + 4 * r.pitch) + load(passed);
    dense<1>(
        w.cell, w.cell_units, CELL_FEATURES + w.passed, room, [&](int i, int) { return all(w.cell_bias[i]); },
        [&](int i, int, Floats sum) { total += w.out[i] * larger(sum, 0.0F); });
    return total;
}

// Log-odds of a row of cells, and where anything is known of them, as [2][2 padded] floats, as far as they are
// written.
inline void finish_row(const ReadOut& r, int square, int a, float* row, float* room) {
    const Around& w = r.around;
    const float* told = r.told + static_cast<int64_t>(square) * PLANES * r.pitch + MARGIN;
    const float* hidden = r.hidden[LAYERS % 2] + static_cast<int64_t>(square) * w.units * r.pitch + MARGIN;
    float* passed = room + (CELL_FEATURES + w.passed) * lanes;
    for (int col = r.out_col / PACK / lanes * lanes; PACK * col < r.out_col + r.out_cols; col += lanes) {
        Floats log_odds[PACK], known[PACK];
        int p = 0;
        const auto pass = [&]<int K>() {
            for (; p + K <= PACK * w.passed; p += K) {
                tile<K, 1>(
                    w.pass + PACK * a * w.passed + p, PACK * PACK * w.passed, w.units, hidden + col, r.pitch,
                    [](int, int) { return Floats{}; },
                    [&](int i, int, Floats sum) { store(passed + (p + i) * lanes, sum); });
            }
        };
        if (w.units) pass.template operator()<8>(), pass.template operator()<1>();
        for (int b = 0; b < PACK; ++b) {
            const int cell = PACK * a + b;
            const float* own = told + cell * CELL_FEATURES * r.pitch + col;
            log_odds[b] =
                w.units ? corrected(r, own, passed + b * w.passed * lanes, room) : 4.0F * load(own + 4 * r.pitch);
            const Floats stood = load(own + 6 * r.pitch);
            known[b] = load(told + (PACK * PACK * CELL_FEATURES + cell) * r.pitch + col);
            log_odds[b] = known[b] > 0.0F ? log_odds[b] : (stood > 0.0F ? log_odds[b] : Floats{});
            log_odds[b] = stood > 0.0F ? smaller(log_odds[b], r.stood) : log_odds[b];
            known[b] = larger(known[b], stood);
        }
        store(row + 2 * col, firsts(log_odds[0], log_odds[1]));
        store(row + 2 * col + lanes, lasts(log_odds[0], log_odds[1]));
        store(row + 2 * r.padded + 2 * col, firsts(known[0], known[1]));
        store(row + 2 * r.padded + 2 * col + lanes, lasts(known[0], known[1]));
    }
}

// Rows of squares: what is read out of their cells. Room for 4 padded + 16 (CELL_FEATURES + 3 passed) floats.
void finish_cells(const ReadOut& r, int first, int last, float* room) {
    const Flushing flushing;
    for (int square = first; square < last; ++square) {
        for (int a = 0; a < PACK; ++a) {
            const int row = PACK * square + a - r.out_row;
            if (row < 0 || row >= r.out_rows) continue;
            finish_row(r, square, a, room, room + 4 * r.padded);
            for (int col = 0; col < r.out_cols; ++col) {
                r.log_odds[row * r.log_odds_stride + col] = room[r.out_col + col];
                r.observed[row * r.observed_stride + col] = room[2 * r.padded + r.out_col + col] > 0.0F;
            }
        }
    }
}

}  // namespace
