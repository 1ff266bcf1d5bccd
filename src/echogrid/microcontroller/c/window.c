/* The window of the map: sums of evidence a cell, which rolls with the robot.
 *
 * A cell at global [row, col] lies in the slot of both modulo ECHOGRID_SIDE. Its five sums share an exponent: as one
 * grows past 16 bits all are halved. What is smaller than their unit is added at random, right in the mean. */

#define SQUARES 4.0f /* what the unit of squares is of that of the others, for they go up to four times as far */
#define STOOD 0x80u
#define EXPONENT 0x0fu

static int32_t in_turn(int32_t index) {
    const int32_t rest = index % ECHOGRID_SIDE;
    return rest < 0 ? rest + ECHOGRID_SIDE : rest;
}

/* The slot of a global cell; -1: outside of the window. */
static int32_t slot_of(const struct echogrid* map, int32_t row, int32_t col) {
    if (row < map->row || row >= map->row + ECHOGRID_SIDE || col < map->col || col >= map->col + ECHOGRID_SIDE) {
        return -1;
    }
    return in_turn(row) * ECHOGRID_SIDE + in_turn(col);
}

static void forget(struct echogrid* map, int32_t slot) {
    map->marks[slot] = 0;
    for (int i = 0; i < 5; i++) {
        map->sums[slot][i] = 0;
    }
}

/* Have the window begin at a global cell; cells that come in are unknown. */
static void roll(struct echogrid* map, int32_t row, int32_t col) {
    for (int32_t r = row; r < row + ECHOGRID_SIDE; r++) {
        for (int32_t c = col; c < col + ECHOGRID_SIDE; c++) {
            if (slot_of(map, r, c) < 0) {
                forget(map, in_turn(r) * ECHOGRID_SIDE + in_turn(c));
            }
        }
    }
    map->row = row;
    map->col = col;
}

/* Add what a scan says of a cell, log-odds. */
static void add(struct echogrid* map, int32_t slot, float told, float weight) {
    const float occupied = larger(told, 0.0f), free = occupied - told;
    const float added[5] = {weight * occupied, weight * free, weight * occupied * occupied / SQUARES,
                            weight * free * free / SQUARES, weight};
    uint16_t* const sums = map->sums[slot];
    uint32_t exponent = map->marks[slot] & EXPONENT, total[5], most = 0;
    map->dither = map->dither * 1664525u + 1013904223u;
    const float dither = (float)(map->dither >> 8) * 5.9604645e-8f;
    for (;;) {
        const float units = SUM_UNITS / (float)(1u << exponent);
        for (int i = 0; i < 5; i++) {
            total[i] = sums[i] + (uint32_t)(added[i] * units + dither);
            most = total[i] > most ? total[i] : most;
        }
        if (most <= UINT16_MAX) {
            break;
        }
        for (int i = 0; i < 5; i++) {
            sums[i] = (uint16_t)((sums[i] + (map->dither >> 31)) >> 1);
        }
        exponent = exponent < EXPONENT ? exponent + 1 : exponent;
        most = 0;
    }
    for (int i = 0; i < 5; i++) {
        sums[i] = (uint16_t)total[i];
    }
    sums[4] = sums[4] == 0 ? 1 : sums[4];
    map->marks[slot] = (uint8_t)((map->marks[slot] & STOOD) | exponent);
}

/* Bearing of a point in units of the local map's bearings, in [0, BEARINGS]; to 0.2 degrees. */
static float coarse_bearing(float x, float y) {
    const float across = magnitude(y), along = magnitude(x);
    const float z = smaller(across, along) / (larger(across, along) + 1e-9f);
    float a = z * (0.25f * PI + 0.273f * (1.0f - z));
    a = across > along ? 0.5f * PI - a : a;
    a = x < 0.0f ? PI - a : a;
    a = y < 0.0f ? 2.0f * PI - a : a;
    return a / STEP_RAD;
}

/* What the local map says of a point on the robot, m; 0: nothing. */
static float sampled(const struct echogrid* map, float x, float y) {
    const float distance = root(x * x + y * y), bearing = coarse_bearing(x, y), out = distance / RING_M - 0.5f;
    const int i = bearing < BEARINGS - 1 ? (int)bearing : BEARINGS - 1;
    if (distance > map->reach[i]) {
        return 0.0f;
    }
    const int j = out < 0.0f ? 0 : out < RINGS - 2 ? (int)out : RINGS - 2;
    const float u = bearing - (float)i, v = clipped(out - (float)j, 0.0f, 1.0f);
    const int16_t *const here = map->polar[i], *const next = map->polar[i + 1 < BEARINGS ? i + 1 : 0];
    const float low = (1.0f - v) * here[j] + v * here[j + 1], high = (1.0f - v) * next[j] + v * next[j + 1];
    return ((1.0f - u) * low + u * high) / POLAR_SCALE;
}

/* Add the local map of a scan from a pose. */
static void add_scan(struct echogrid* map, float x, float y, float theta, float weight) {
    const float c = cosine(theta), s = sine(theta);
    const int32_t row = whole(y / ECHOGRID_CELL_M), col = whole(x / ECHOGRID_CELL_M);
    for (int32_t r = row - REACH_CELLS; r <= row + REACH_CELLS; r++) {
        const float dy = ((float)r + 0.5f) * ECHOGRID_CELL_M - y;
        for (int32_t k = col - REACH_CELLS; k <= col + REACH_CELLS; k++) {
            const float dx = ((float)k + 0.5f) * ECHOGRID_CELL_M - x;
            const int32_t slot = dx * dx + dy * dy > REACH_M * REACH_M * 1.00001f ? -1 : slot_of(map, r, k);
            const float told = slot < 0 ? 0.0f : sampled(map, c * dx + s * dy, c * dy - s * dx);
            if (told < 0.0f || told > 0.0f) {
                add(map, slot, told, weight);
            }
        }
    }
}

/* Note the floor that the robot covers at a point. */
static void stand_at(struct echogrid* map, float x, float y) {
    const int32_t row = whole(y / ECHOGRID_CELL_M), col = whole(x / ECHOGRID_CELL_M);
    for (int32_t r = row - STOOD_CELLS; r <= row + STOOD_CELLS; r++) {
        const float dy = ((float)r + 0.5f) * ECHOGRID_CELL_M - y;
        for (int32_t k = col - STOOD_CELLS; k <= col + STOOD_CELLS; k++) {
            const float dx = ((float)k + 0.5f) * ECHOGRID_CELL_M - x;
            const int32_t slot = dx * dx + dy * dy < STOOD_M * STOOD_M ? slot_of(map, r, k) : -1;
            if (slot >= 0) {
                map->marks[slot] |= STOOD;
            }
        }
    }
}

/* Note the floor over which the robot has come to a point. */
static void stand(struct echogrid* map, float x, float y) {
    const float dx = x - map->last_x, dy = y - map->last_y, way = root(dx * dx + dy * dy);
    const int steps = map->scans > 1 && way <= STOOD_GAP_M ? -whole(-way / STOOD_STEP_M) : 1;
    for (int i = 1; i < steps; i++) {
        const float part = (float)i / (float)steps;
        stand_at(map, map->last_x + dx * part, map->last_y + dy * part);
    }
    stand_at(map, x, y);
    map->last_x = x;
    map->last_y = y;
}

/* The log-odds that a cell's sums amount to. */
static float fused(const uint16_t sums[5], uint32_t exponent) {
    const float unit = (float)(1u << exponent) / SUM_UNITS, looks = (float)sums[4] * unit, x = looks / LOOKS;
    const float share = x < 0.01f ? unit * (1.0f - 0.5f * x) : unit * (1.0f - exponential(-x)) / x;
    const float occupied = (float)sums[0] * share, free = (float)sums[1] * share;
    const float told[4] = {logarithm_past_one(occupied), logarithm_past_one(free),
                           logarithm_past_one((float)sums[2] * share * SQUARES),
                           logarithm_past_one((float)sums[3] * share * SQUARES)};
    float total = WS * (occupied - free);
    for (int i = 0; i < FUSE_UNITS; i++) {
        float unit_total = BF[i];
        for (int j = 0; j < 4; j++) {
            unit_total += WF[i * 4 + j] * told[j];
        }
        total += WZ[i] * larger(unit_total, 0.0f);
    }
    return total;
}

static int8_t read_out(const struct echogrid* map, int32_t slot) {
    const uint16_t* const sums = map->sums[slot];
    const int stood = (map->marks[slot] & STOOD) != 0;
    if (sums[4] == 0 && !stood) {
        return ECHOGRID_UNKNOWN;
    }
    float log_odds = sums[4] == 0 ? 0.0f : fused(sums, map->marks[slot] & EXPONENT);
    log_odds = stood ? smaller(log_odds, STOOD_LOG_ODDS) : log_odds;
    return (int8_t)whole(clipped(log_odds * ECHOGRID_PER_LOG_ODDS, -127.0f, 127.0f) + 0.5f);
}
