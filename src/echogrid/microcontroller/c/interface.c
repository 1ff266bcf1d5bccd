/* What echogrid.h offers. */

void echogrid_start(struct echogrid* map) {
    map->row = map->col = 0;
    map->scans = map->dither = 0;
    map->last_x = map->last_y = 0.0f;
    for (int i = 0; i < TRAITS; i++) {
        map->trait_sums[i] = map->trait_counts[i] = 0.0f;
    }
    for (int s = 0; s < ECHOGRID_SONARS; s++) {
        map->heard[s].range = ECHOGRID_SILENT;
    }
    for (int p = 0; p < ECHOGRID_PLACES; p++) {
        map->places[p].key = NOWHERE;
        map->places[p].looks = 0.0f;
    }
    for (int32_t slot = 0; slot < ECHOGRID_CELLS; slot++) {
        forget(map, slot);
    }
}

/* Ranges as the network takes them, by the limits of the sonars. */
static void clean(const float raw[ECHOGRID_SONARS], float ranges[ECHOGRID_SONARS]) {
    for (int s = 0; s < ECHOGRID_SONARS; s++) {
        ranges[s] = raw[s] >= LONGEST[s] ? ECHOGRID_NO_ECHO : raw[s] >= SHORTEST ? raw[s] : ECHOGRID_SILENT;
    }
}

#if ENDS
/* Whether the range of a sonar ends within the local map. */
static int ends_within(const struct mount mounts[ECHOGRID_SONARS]) {
    for (int s = 0; s < ECHOGRID_SONARS; s++) {
        if (MAX_RANGE[s] - root(mounts[s].x * mounts[s].x + mounts[s].y * mounts[s].y) < REACH_M) {
            return 1;
        }
    }
    return 0;
}

/* How far the sonars that fired can tell from a bearing to the next, and from the one before to it, m. */
static void told_until(const struct token tokens[TOKENS], const float ranges[ECHOGRID_SONARS], float* after,
                       float* before) {
    *after = *before = 0.0f;
    for (int k = 0; k < TOKENS; k++) {
        if (tokens[k].sonar != NO_SONAR && ranges[tokens[k].sonar] == ranges[tokens[k].sonar]) {
            *after = larger(*after, tokens[k].after);
            *before = larger(*before, tokens[k].before);
        }
    }
}
#endif

/* The local map of a scan, and how far it reaches. mounts: from where the sonars looked; moved: other than their own.
 */
static void tell_scan(struct echogrid* map, const float ranges[ECHOGRID_SONARS], const float traits[TRAITS],
                      const struct mount mounts[ECHOGRID_SONARS], int moved) {
#if ENDS
    const int ends = moved ? ends_within(mounts) : ENDS_AT_REST;
    float before[BEARINGS];
#else
    const int ends = 0;
#endif
    for (int i = 0; i < BEARINGS; i++) {
        struct token seen[TOKENS];
        const struct token* tokens = ARRAY[i];
        if (moved) {
            seen_from(mounts, i, ends, seen);
            tokens = seen;
        }
        tell_bearing(tokens, ranges, traits, map->polar[i]);
        map->reach[i] = REACH_M;
#if ENDS
        told_until(tokens, ranges, &map->reach[i], &before[i]);
#endif
    }
#if ENDS
    for (int i = 0; i < BEARINGS; i++) {
        const float told = larger(map->reach[i], before[i + 1 < BEARINGS ? i + 1 : 0]);
        map->reach[i] = ends ? smaller(larger(told, FOOTPRINT_M), REACH_M) : REACH_M;
    }
#endif
}

int echogrid_scan(struct echogrid* map, const float raw[ECHOGRID_SONARS], float x, float y, float theta,
                  uint32_t ms) {
    if (!(magnitude(x) <= ECHOGRID_FAR_M && magnitude(y) <= ECHOGRID_FAR_M && magnitude(theta) <= 200.0f * PI)) {
        return ECHOGRID_BAD_POSE;
    }
    const struct echogrid_heard now = {ECHOGRID_SILENT, x, y, theta, ms, map->scans};
    float ranges[ECHOGRID_SONARS], traits[TRAITS], new_share;
    struct mount mounts[ECHOGRID_SONARS];
    clean(raw, ranges);
    const int moved = complete(map, ranges, &now, mounts, &new_share);
    int heard = 0;
    for (int s = 0; s < ECHOGRID_SONARS; s++) {
        heard += ranges[s] == ranges[s];
    }
    const float looks = counted_again(map, x, y, theta, new_share * (float)heard / (float)ECHOGRID_SONARS);
    notice(map, ranges, traits);
    map->scans++;
    tell_scan(map, ranges, traits, mounts, moved);
    roll(map, whole(y / ECHOGRID_CELL_M) - ECHOGRID_SIDE / 2, whole(x / ECHOGRID_CELL_M) - ECHOGRID_SIDE / 2);
    if (new_share > 0.0f) {
        add_scan(map, x, y, theta, new_share / larger(looks, 1.0f));
    }
    stand(map, x, y);
    return ECHOGRID_DONE;
}

void echogrid_corner(const struct echogrid* map, float* x, float* y) {
    *x = (float)map->col * ECHOGRID_CELL_M;
    *y = (float)map->row * ECHOGRID_CELL_M;
}

int8_t echogrid_cell(const struct echogrid* map, int32_t row, int32_t col) {
    if (row < 0 || row >= ECHOGRID_SIDE || col < 0 || col >= ECHOGRID_SIDE) {
        return ECHOGRID_UNKNOWN;
    }
    return read_out(map, slot_of(map, map->row + row, map->col + col));
}

void echogrid_read(const struct echogrid* map, int8_t cells[ECHOGRID_CELLS]) {
    for (int32_t row = 0; row < ECHOGRID_SIDE; row++) {
        for (int32_t col = 0; col < ECHOGRID_SIDE; col++) {
            cells[row * ECHOGRID_SIDE + col] = echogrid_cell(map, row, col);
        }
    }
}
