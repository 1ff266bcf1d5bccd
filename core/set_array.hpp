// What an array of sonars fixes of the polar table.
#pragma once

#include "set_network.hpp"
#include "vector_math.hpp"

namespace {

using namespace echogrid;

constexpr double AT_M = 1.2;  // sonars are near whose axes point nearest to a bearing's point at this distance
constexpr double TURN = 6.28318530717958648;
constexpr double TIE_RAD = 1e-5;  // who looks so nearly along a bearing, or away from it, has it on its left
constexpr double NEIGHBOUR_RAD = 0.35;
constexpr float LOOK_COS = 0.866025404F;          // a sonar looks at what lies within 30 degrees of its axis,
constexpr double CONE_SIN = 0.70710678118654752;  // and tells of nothing farther than 45 degrees off it
constexpr double NONE = 9e6;

inline Doubles wrapped(Doubles a) { return a - TURN * rounded(a / TURN); }

// The sonars of a block of bearings, each a lane.
struct Asked {
    Longs sonar[TOKENS];                                                   // -1: no more
    Doubles x[TOKENS], y[TOKENS], axis[TOKENS], cos[TOKENS], sin[TOKENS];  // mounts in the robot's frame
};

// The sonars whose axes point nearest, the nearest first; of those alike to a millionth of a rad the first.
inline void ask(const SetRobot& robot, Doubles cos, Doubles sin, Asked& asked) {
    Doubles keys[TOKENS];
    for (int k = 0; k < TOKENS; ++k) keys[k] = Doubles{} + NONE, asked.sonar[k] = Longs{} - 1;
    for (int s = 0; s < robot.sonars; ++s) {
        const double* mount = robot.mounts + 3 * s;
        if (!(__builtin_isfinite(mount[0]) && __builtin_isfinite(mount[1]) && __builtin_isfinite(mount[2]))) continue;
        const Doubles off = wrapped(angle_of(AT_M * sin - mount[1], AT_M * cos - mount[0]) - mount[2]);
        Doubles key = rounded((off < 0.0 ? -off : off) * 1e6);
        Longs index = Longs{} + s, nearer{};
        for (int k = 0; k < TOKENS; ++k) {
            nearer |= key < keys[k];  // whom it pushes away pushes on, even one that is as near
            const Doubles pushed = nearer ? keys[k] : key;
            const Longs pushed_index = nearer ? asked.sonar[k] : index;
            keys[k] = nearer ? key : keys[k];
            asked.sonar[k] = nearer ? index : asked.sonar[k];
            key = pushed, index = pushed_index;
        }
    }
    for (int k = 0; k < TOKENS; ++k) {
        for (int lane = 0; lane < lanes; ++lane) {
            const int64_t s = asked.sonar[k][lane];
            const double* mount = robot.mounts + 3 * s;
            asked.x[k][lane] = s < 0 ? 0.0 : mount[0];
            asked.y[k][lane] = s < 0 ? 0.0 : mount[1];
            asked.axis[k][lane] = s < 0 ? 0.0 : mount[2];
            asked.cos[k][lane] = s < 0 ? 1.0 : __builtin_cos(mount[2]);
            asked.sin[k][lane] = s < 0 ? 0.0 : __builtin_sin(mount[2]);
        }
    }
}

// How far from the robot's middle what lies within range and cone of a sonar goes on along a bearing; 0: nowhere.
inline Doubles leaves(const Asked& asked, int k, Doubles reach, Doubles cos, Doubles sin) {
    const Doubles x = asked.x[k], y = asked.y[k];
    const Doubles ahead = cos * x + sin * y, aside = cos * y - sin * x;
    const Doubles half = root(larger(reach * reach - aside * aside, Doubles{}));
    Doubles enter = ahead - half, leave = ahead + half;
    constexpr double sides[] = {1.0, -1.0};
    for (const double side : sides) {
        // Of the cone's edge: its normal, how far inside of it the middle lies, and how fast the ray goes inside.
        const Doubles edge_cos = CONE_SIN * (side * asked.sin[k] + asked.cos[k]);
        const Doubles edge_sin = CONE_SIN * (asked.sin[k] - side * asked.cos[k]);
        const Doubles inside = -(edge_cos * x + edge_sin * y);
        const Doubles into = edge_cos * cos + edge_sin * sin;
        const Doubles size = into < 0.0 ? -into : into;
        const Doubles crosses = -inside / (size < 1e-6 ? Doubles{} + 1e-6 : into);
        leave = into < 0.0 ? smaller(leave, crosses) : leave;
        enter = into < 0.0 ? enter : larger(enter, crosses);
    }
    return (leave > enter) & (leave > 0.0) & (half > 0.0) ? leave : Doubles{};
}

inline void tell_ends(const Asked& asked, const SetRobot& robot, const Bearings& bearings, int b, SetArray& array) {
    Doubles cos[3], sin[3];
    for (int lane = 0; lane < lanes; ++lane) {
        for (int k = 0; k < 3; ++k) {
            const int bearing = (b + lane + BEARINGS - 1 + k) % BEARINGS;
            cos[k][lane] = bearings.cos[bearing], sin[k][lane] = bearings.sin[bearing];
        }
    }
    for (int k = 0; k < TOKENS; ++k) {
        Doubles reach{};
        for (int lane = 0; lane < lanes; ++lane) {
            const int64_t s = asked.sonar[k][lane];
            reach[lane] = s < 0 ? 0.0 : static_cast<double>(robot.max_range[s]);
        }
        Doubles end[3];
        for (int n = 0; n < 3; ++n) end[n] = leaves(asked, k, reach, cos[n], sin[n]);
        const Longs there = asked.sonar[k] >= 0;
        store(&array.after[k][b], narrowed(there ? smaller(end[1], end[2]) : Doubles{}));
        store(&array.before[k][b], narrowed(there ? smaller(end[0], end[1]) : Doubles{}));
    }
}

// An axis in [-half a turn, half a turn), whatever rounding makes of one that looks away from the bearing.
inline Doubles on_the_right(Doubles axis) { return axis > TURN / 2 - TIE_RAD ? axis - TURN : axis; }

// Axes and places of the sonars as seen along bearings.
inline void look_along(const Asked& asked, const SetRobot& robot, const Bearings& bearings, int b, SetArray& array) {
    const Doubles cos = loaded<Doubles>(&bearings.cos[b]), sin = loaded<Doubles>(&bearings.sin[b]);
    Doubles bearing;
    for (int lane = 0; lane < lanes; ++lane) bearing[lane] = (b + lane) * (TURN / BEARINGS);
    Doubles sign{};
    for (int k = 0; k < TOKENS; ++k) {
        const Longs there = asked.sonar[k] >= 0;
        const Doubles x = asked.x[k], y = asked.y[k];
        const Doubles ahead = cos * x + sin * y, aside = cos * y - sin * x;
        const Doubles axis = on_the_right(wrapped(asked.axis[k] - bearing));
        if (k == 0) {
            const Doubles off = angle_of(-aside, AT_M - ahead) - axis;
            sign = off < -TIE_RAD ? Doubles{} - 1.0 : Doubles{} + 1.0;
        }
        const Doubles axis_sin = asked.sin[k] * cos - asked.cos[k] * sin;
        const Doubles axis_cos = asked.cos[k] * cos + asked.sin[k] * sin;
        store(&array.axis[k][b], narrowed(there ? on_the_right(sign * axis) : Doubles{}));
        store(&array.axis_sin[k][b], narrowed(there ? sign * axis_sin : Doubles{}));
        store(&array.axis_cos[k][b], narrowed(there ? axis_cos : Doubles{} + 1.0));
        store(&array.ahead[k][b], narrowed(there ? ahead : Doubles{}));
        store(&array.aside[k][b], narrowed(there ? sign * aside : Doubles{}));
        for (int lane = 0; lane < lanes; ++lane) {
            const int64_t s = asked.sonar[k][lane];
            array.sonar[k][b + lane] = static_cast<int32_t>(s < 0 ? robot.sonars : s);
            array.max_range[k][b + lane] = s < 0 ? FAR_M : __builtin_fminf(robot.max_range[s], FAR_M);
        }
    }
}

inline void tell_points(const Asked& asked, const SetRobot& robot, int b, SetArray& array) {
    for (int k = 0; k < TOKENS; ++k) {
        const Floats ahead = load(&array.ahead[k][b]), aside = load(&array.aside[k][b]);
        const Floats cos = load(&array.axis_cos[k][b]), sin = load(&array.axis_sin[k][b]);
        Floats longest = all(-1.0F);
        for (int lane = 0; lane < lanes; ++lane) {
            const int64_t s = asked.sonar[k][lane];
            if (s >= 0) longest[lane] = robot.ends ? robot.max_range[s] + RING_M : 1e9F;
        }
        for (int ring = 0; ring < RINGS; ++ring) {
            const Floats forward = (static_cast<float>(ring) + 0.5F) * RING_M - ahead;
            const Floats distance = root(forward * forward + aside * aside);
            const Ints looks = (forward * cos - aside * sin >= LOOK_COS * distance) & (distance <= longest);
            store(&array.distance[k][ring][b], distance);
            const Ints others = k == 0 ? Ints{} : loaded<Ints>(&array.looks[ring][b]);
            store(&array.looks[ring][b], others | (looks & (1 << k)));
        }
    }
}

void prepare_array(const SetRobot& robot, const Bearings& bearings, SetArray& array) {
    const Flushing flushing;
    for (int b = 0; b < BEARINGS; b += lanes) {
        Asked asked;
        ask(robot, loaded<Doubles>(&bearings.cos[b]), loaded<Doubles>(&bearings.sin[b]), asked);
        look_along(asked, robot, bearings, b, array);
        tell_points(asked, robot, b, array);
        if (robot.ends) tell_ends(asked, robot, bearings, b, array);
        int pair = 0;
        for (int i = 0; i < TOKENS; ++i) {
            for (int j = i + 1; j < TOKENS; ++j, ++pair) {
                const Floats apart =
                    (load(&array.axis[i][b]) - load(&array.axis[j][b])) * static_cast<float>(1 / NEIGHBOUR_RAD);
                store(&array.near[pair][b], exponential(-apart * apart));
            }
        }
    }
}

}  // namespace
