// A scan in, its polar table out: what it tells of bearings and rings round the robot.
#pragma once

#include "dense.hpp"
#include "set_network.hpp"

namespace {

using namespace echogrid;

constexpr float LIMIT = 4.0F;      // log-odds at which the evidence of one scan levels off
constexpr float UNDER = -2.0F;     // log-odds of the floor under the robot
constexpr float SAME_M = 0.08F;    // readings farther apart do not agree
constexpr float BEAM_RAD = 0.22F;  // half a common beam width, which a sonar's is compared with
constexpr float STEPS_M[STEP_BENDS - 1] = {-0.5F, -0.2F, -0.1F, -0.05F, 0.0F, 0.05F, 0.1F, 0.2F, 0.45F};
constexpr float RINGS_M[RING_BENDS - 1] = {0.0F, 0.3F, 0.6F, 0.9F, 1.2F, 1.6F, 2.0F, 2.5F};
constexpr int ROW = TOKENS * lanes;  // floats of one number of all the tokens of a block of bearings

// Room for a block of bearings, as many as a vector has lanes.
struct Block {
    float* told;      // [FEATURES][TOKENS]
    float* hidden;    // [units][TOKENS]
    float* hidden2;   // likewise
    float* shares;    // [4][TOKENS]
    float* bends;     // [STEP_BENDS][TOKENS]
    float* pooled;    // [2 units]
    float* context;   // [units]
    float* rings;     // [RING_BENDS]
    float* evidence;  // [RINGS]
};

inline Block block_in(float* room, int units) {
    const auto next = [&room](int vectors) {
        float* begin = room;
        room += vectors * lanes;
        return begin;
    };
    Block work{};
    work.told = next(FEATURES * TOKENS);
    work.hidden = next(units * TOKENS), work.hidden2 = next(units * TOKENS);
    work.shares = next(4 * TOKENS), work.bends = next(STEP_BENDS * TOKENS);
    work.pooled = next(2 * units), work.context = next(units);
    work.rings = next(RING_BENDS), work.evidence = next(RINGS);
    return work;
}

// The readings of a block of bearings.
struct Heard {
    Floats reading[TOKENS], place[TOKENS], range[TOKENS];
    Ints fired[TOKENS], echo[TOKENS];
};

inline Heard heard_at(const SetArray& array, const float* readings, int b) {
    constexpr int32_t INFINITE = 0x7f800000;
    Heard heard;
    for (int k = 0; k < TOKENS; ++k) {
        const Floats reading = load(readings + k * BEARINGS + b), aside = load(&array.aside[k][b]);
        const Ints held = bits(reading) & 0x7fffffff;
        heard.fired[k] = held <= INFINITE;
        heard.echo[k] = held < INFINITE;
        heard.reading[k] = heard.echo[k] ? reading : Floats{};
        const Floats range = within(heard.echo[k] ? reading : load(&array.max_range[k][b]), 0.01F, FAR_M);
        heard.range[k] = range;
        heard.place[k] = load(&array.ahead[k][b]) + root(larger(range * range - aside * aside, 0.01F));
    }
    return heard;
}

// How each reading compares with those of sonars that look nearly the same way: how many agree, how much farther they
// read, fine and coarse.
inline void compare(const SetArray& array, const Heard& heard, int b, Floats (&told)[3][TOKENS]) {
    for (auto& each : told)
        for (Floats& value : each) value = Floats{};
    int pair = 0;
    for (int i = 0; i < TOKENS; ++i) {
        for (int j = i + 1; j < TOKENS; ++j, ++pair) {
            const Floats near = load(&array.near[pair][b]);
            const Floats of_i = heard.fired[j] ? near : Floats{}, of_j = heard.fired[i] ? near : Floats{};
            const Floats apart = heard.place[j] - heard.place[i];
            const Floats same = larger(1.0F - absolute(apart) * (1 / SAME_M), 0.0F);
            const Floats fine = within(apart * 4.0F, -1.0F, 1.0F), coarse = within(apart, -1.0F, 1.0F);
            told[0][i] += of_i * same, told[0][j] += of_j * same;
            told[1][i] += of_i * fine, told[1][j] -= of_j * fine;
            told[2][i] += of_i * coarse, told[2][j] -= of_j * coarse;
        }
    }
}

inline void tell_features(const SetArray& array, const SetRobot& robot, const Heard& heard, int b, float* to) {
    const float beam_log = __builtin_logf(robot.beam / BEAM_RAD), beam_part = 1 / (robot.beam * robot.beam);
    Floats first = all(FAR_M + 1.0F), compared[3][TOKENS];
    for (int k = 0; k < TOKENS; ++k) first = smaller(first, heard.echo[k] ? heard.place[k] : first);
    compare(array, heard, b, compared);
    const Floats one = all(1.0F);
    for (int k = 0; k < TOKENS; ++k) {
        const Floats aside = load(&array.aside[k][b]), range = heard.range[k], after = heard.place[k] - first;
        // The bearing's point at the range of the echo, off the sonar's axis.
        const Floats sine = within(aside / range, -1.0F, 1.0F);
        const Floats off = -(sine + sine * sine * sine * (1.0F / 6)) - load(&array.axis[k][b]);
        // One exponential for three bells: each is a power of the widest.
        const Floats wide = exponential(off * off * -4.0F);
        const Floats wide2 = wide * wide, middle = wide2 * wide2, wide8 = middle * middle;
        const Floats values[FEATURES] = {
            heard.echo[k] ? one : Floats{},
            heard.echo[k] ? Floats{} : one,
            load(&array.axis_sin[k][b]),
            load(&array.axis_cos[k][b]),
            wide8 * wide8 * wide8 * wide,
            middle,
            wide,
            off,
            range * 0.5F,
            exponential(range * -2.0F),
            larger(1.0F - after * 10.0F, 0.0F),
            smaller(after, 0.5F) * 2.0F,
            load(&array.ahead[k][b]) * 3.0F,
            aside * 3.0F,
            compared[0][k],
            compared[1][k],
            compared[2][k],
            all(beam_log),
            exponential(off * off * -beam_part),
            load(&array.max_range[k][b]) * (1 / FAR_M),
        };
        for (int i = 0; i < FEATURES; ++i) store(to + i * ROW + k * lanes, heard.fired[k] ? values[i] : Floats{});
    }
}

// Two weighted means over the tokens of what is hidden; weights [units][2] of the scores.
inline void pool(const float* scores, int units, const float* hidden, const Heard& heard, float* shares,
                 float* pooled) {
    dense<TOKENS>(
        scores, 2, units, hidden, [](int, int) { return Floats{}; },
        [&](int i, int k, Floats score) {
            const Floats share = exponential(within(score, -10.0F, 10.0F));
            store(shares + i * ROW + k * lanes, heard.fired[k] ? share : Floats{});
        });
    Floats share[2][TOKENS];
    for (int i = 0; i < 2; ++i) {
        Floats total = all(1e-6F);
        for (int k = 0; k < TOKENS; ++k) total += share[i][k] = load(shares + i * ROW + k * lanes);
        const Floats part = 1.0F / total;
        for (Floats& each : share[i]) each *= part;
    }
    for (int m = 0; m < units; ++m) {
        Floats mean[2]{};
        for (int k = 0; k < TOKENS; ++k) {
            const Floats value = load(hidden + m * ROW + k * lanes);
            mean[0] += share[0][k] * value, mean[1] += share[1][k] * value;
        }
        store(pooled + m * lanes, mean[0]), store(pooled + (units + m) * lanes, mean[1]);
    }
}

// The echoes' profiles and that by distance, as bends. ``base``: what the traits add to each unit of the second
// layer.
inline void encode(const SetWeights& w, const float* base, const Heard& heard, const Block& work) {
    const int h = w.units;
    dense<TOKENS>(
        w.w1, h, FEATURES, work.told, [&](int i, int) { return all(w.b1[i]); },
        [&](int i, int k, Floats sum) {
            store(work.hidden + i * ROW + k * lanes, heard.fired[k] ? larger(sum, 0.0F) : Floats{});
        });
    pool(w.a1, h, work.hidden, heard, work.shares, work.pooled);
    dense<1>(
        w.w2p, h, 2 * h, work.pooled, [&](int i, int) { return all(base[i]); },
        [&](int i, int, Floats sum) { store(work.context + i * lanes, sum); });
    dense<TOKENS>(
        w.w2, h, h, work.hidden, [&](int i, int) { return load(work.context + i * lanes); },
        [&](int i, int k, Floats sum) { store(work.hidden2 + i * ROW + k * lanes, larger(sum, 0.0F)); });
    pool(w.a2, h, work.hidden2, heard, work.shares, work.pooled);
    dense<TOKENS>(
        w.steps, STEP_BENDS, h, work.hidden2, [&](int i, int) { return all(w.steps_b[i]); },
        [&](int i, int k, Floats sum) { store(work.bends + i * ROW + k * lanes, heard.echo[k] ? sum : Floats{}); });
    dense<1>(
        w.w3, h, 2 * h, work.pooled, [&](int i, int) { return all(w.b3[i]); },
        [&](int i, int, Floats sum) { store(work.context + i * lanes, larger(sum, 0.0F)); });
    dense<1>(
        w.rings, RING_BENDS, h, work.context, [&](int i, int) { return all(w.rings_b[i]); },
        [&](int i, int, Floats sum) { store(work.rings + i * lanes, sum); });
}

// Sums of the profiles at the rings of a block of bearings.
inline void sum_profiles(const SetArray& array, const Heard& heard, int b, const Block& work) {
    Floats rest{};
    for (int k = 0; k < TOKENS; ++k) rest += load(work.bends + k * lanes);
    for (int ring = 0; ring < RINGS; ++ring) {
        const float distance = (static_cast<float>(ring) + 0.5F) * RING_M;
        Floats total = rest + load(work.rings);
        for (int i = 0; i + 1 < RING_BENDS && RINGS_M[i] < distance; ++i)
            total += (distance - RINGS_M[i]) * load(work.rings + (i + 1) * lanes);
        store(work.evidence + ring * lanes, total);
    }
    for (int k = 0; k < TOKENS; ++k) {
        if (!any(heard.echo[k])) continue;
        Floats bend[STEP_BENDS - 1];
        for (int i = 1; i < STEP_BENDS; ++i) bend[i - 1] = load(work.bends + i * ROW + k * lanes);
        const Floats reading = heard.reading[k];
        for (int ring = 0; ring < RINGS; ++ring) {
            const Floats beyond = load(&array.distance[k][ring][b]) - reading;
            Floats total = load(work.evidence + ring * lanes);
#pragma GCC unroll 16
            for (int i = 0; i < STEP_BENDS - 1; ++i) total += bend[i] * larger(beyond, STEPS_M[i]);
            store(work.evidence + ring * lanes, total);
        }
    }
}

inline void fill_table(const SetArray& array, const SetRobot& robot, const Heard& heard, int b, const Block& work,
                       float* table) {
    Ints fired{};
    for (int k = 0; k < TOKENS; ++k) fired |= heard.fired[k] & (1 << k);
    for (int ring = 0; ring < RINGS; ++ring) {
        const Floats found = LIMIT * hyperbolic_tangent(load(work.evidence + ring * lanes) * (1 / LIMIT));
        const Ints looked = (loaded<Ints>(&array.looks[ring][b]) & fired) != 0;
        store(table + ring * PITCH + b, ring < robot.under ? all(UNDER) : looked ? found : Floats{});
    }
}

// How far from the robot's middle the sonars that fired can tell, from each bearing to the next.
inline void tell_until(const SetArray& array, const SetRobot& robot, const float* readings, float* until) {
    for (int b = 0; b < BEARINGS; ++b) {
        const int next = (b + 1) % BEARINGS;
        float told = 0.0F;
        for (int k = 0; k < TOKENS; ++k) {
            if (!__builtin_isnan(readings[k * BEARINGS + b])) told = __builtin_fmaxf(told, array.after[k][b]);
            if (!__builtin_isnan(readings[k * BEARINGS + next])) told = __builtin_fmaxf(told, array.before[k][next]);
        }
        until[b] = __builtin_fminf(__builtin_fmaxf(told, robot.footprint), REACH_M);
    }
}

// Args:
//   ranges: of the scan, m [sonars]; inf: no echo, nan: not fired.
//   traits: [TRAITS].
//   room: floats, as many as set_room says.
//   table: [RINGS][PITCH], log-odds; 0 where no sonar that fired looks.
//   until: [BEARINGS], m; written where the robot's sonars end.
void polar_table(const SetWeights& w, const SetRobot& robot, const SetArray& array, const float* ranges,
                 const float* traits, float* room, float* table, float* until) {
    const Flushing flushing;
    float* readings = room;
    float* base = readings + TOKENS * BEARINGS;
    const Block work = block_in(base + w.units, w.units);
    for (int k = 0; k < TOKENS; ++k) {
        for (int b = 0; b < BEARINGS; ++b) {
            const int32_t s = array.sonar[k][b];
            readings[k * BEARINGS + b] = s < robot.sonars ? ranges[s] : __builtin_nanf("");
        }
    }
    for (int i = 0; i < w.units; ++i) {
        base[i] = w.b2[i];
        for (int m = 0; m < TRAITS; ++m) base[i] += w.w2t[m * w.units + i] * (traits[m] - 0.5F);
    }
    for (int b = 0; b < BEARINGS; b += lanes) {
        const Heard heard = heard_at(array, readings, b);
        tell_features(array, robot, heard, b, work.told);
        encode(w, base, heard, work);
        sum_profiles(array, heard, b, work);
        fill_table(array, robot, heard, b, work, table);
    }
    for (int ring = 0; ring < RINGS; ++ring) table[ring * PITCH + BEARINGS] = table[ring * PITCH];
    if (robot.ends) tell_until(array, robot, readings, until);
}

}  // namespace
