/* The array as seen from a bearing where its sonars are taken to have looked from elsewhere than their own mounts. */

struct mount {
    float x, y, axis; /* on the robot, m and rad */
    float cos, sin;   /* of the axis */
};

static struct mount mounted(float x, float y, float axis) {
    const struct mount mount = {x, y, axis, cosine(axis), sine(axis)};
    return mount;
}

/* How far off its axis a sonar sees the bearing's point at AT_M. */
static float off_axis(const struct mount* m, float cos, float sin) {
    return magnitude(wrapped(bearing_of(AT_M * sin - m->y, AT_M * cos - m->x) - m->axis));
}

/* The sonars whose axes point nearest to a bearing, the nearest first, of equals that of the lower index. */
static int nearest(const struct mount mounts[ECHOGRID_SONARS], float cos, float sin, uint8_t found[TOKENS]) {
    float offs[TOKENS];
    int count = 0;
    for (int s = 0; s < ECHOGRID_SONARS; s++) {
        const float off = off_axis(&mounts[s], cos, sin);
        int place = count;
        while (place > 0 && off < offs[place - 1] - 4e-6f) {
            place--;
        }
        if (place == TOKENS) {
            continue;
        }
        count = count < TOKENS ? count + 1 : TOKENS;
        for (int k = count - 1; k > place; k--) {
            offs[k] = offs[k - 1];
            found[k] = found[k - 1];
        }
        offs[place] = off;
        found[place] = (uint8_t)s;
    }
    return count;
}

#if ENDS
/* Where a ray from the robot's middle leaves what lies within a sonar's cone and range, m; 0: it does not enter. */
static float leaves(const struct mount* m, float range, float cos, float sin) {
    const float ahead = cos * m->x + sin * m->y, aside = cos * m->y - sin * m->x;
    const float half = root(range * range - aside * aside);
    float enter = ahead - half, leave = ahead + half;
    for (int side = -1; side <= 1; side += 2) {
        /* A normal of the cone's edge, which points into the cone. */
        const float nx = EDGE_COS * m->cos + (float)side * EDGE_SIN * m->sin;
        const float ny = EDGE_COS * m->sin - (float)side * EDGE_SIN * m->cos;
        const float inside = -(nx * m->x + ny * m->y), into = nx * cos + ny * sin;
        const float crosses = -inside / (magnitude(into) < 1e-6f ? 1e-6f : into);
        if (into < 0.0f) {
            leave = smaller(leave, crosses);
        } else {
            enter = larger(enter, crosses);
        }
    }
    return leave > enter && leave > 0.0f && half > 0.0f ? leave : 0.0f;
}
#endif

/* The rings at which a sonar looks. */
static void look_at(struct token* t, float cos, float sin, float range, int ends) {
    t->first = t->end = 0;
    for (int j = 0; j < RINGS; j++) {
        const float forward = ((float)j + 0.5f) * RING_M - t->ahead, left = -t->aside;
        const float squared = forward * forward + left * left, along = forward * cos + left * sin;
        const int within = !ends || squared <= (range + RING_M) * (range + RING_M);
        if (within && along >= 0.0f && along * along >= LOOK_COS * LOOK_COS * squared) {
            t->first = t->end == 0 ? (uint8_t)j : t->first;
            t->end = (uint8_t)(j + 1);
        }
    }
}

/* An axis in [-PI, PI), whatever rounding makes of one that looks away from the bearing. */
static float on_the_right(float axis) { return axis > PI - TIE_RAD ? axis - 2.0f * PI : axis; }

/* The tokens of a bearing; ends: whether what sonars tell ends within the local map. */
static void seen_from(const struct mount mounts[ECHOGRID_SONARS], int bearing, int ends,
                      struct token tokens[TOKENS]) {
    const float angle = (float)bearing * STEP_RAD, cos = cosine(angle), sin = sine(angle);
    uint8_t found[TOKENS];
    const int count = nearest(mounts, cos, sin, found);
    float sign = 1.0f;
    for (int k = 0; k < TOKENS; k++) {
        struct token* const t = &tokens[k];
        t->sonar = NO_SONAR;
        if (k >= count) {
            continue;
        }
        const struct mount* const m = &mounts[found[k]];
        const float axis = on_the_right(wrapped(m->axis - angle)), aside = cos * m->y - sin * m->x;
        t->sonar = found[k];
        t->ahead = cos * m->x + sin * m->y;
        if (k == 0) {
            /* Turned so that the nearest has the bearing on its left. */
            sign = bearing_of(-aside, AT_M - t->ahead) - axis < -TIE_RAD ? -1.0f : 1.0f;
        }
        t->axis = on_the_right(sign * axis);
        t->aside = sign * aside;
        look_at(t, cosine(t->axis), sine(t->axis), MAX_RANGE[t->sonar], ends);
#if ENDS
        const float here = leaves(m, MAX_RANGE[t->sonar], cos, sin);
        const float step_cos = cosine(STEP_RAD), step_sin = sine(STEP_RAD);
        const float before =
            leaves(m, MAX_RANGE[t->sonar], cos * step_cos + sin * step_sin, sin * step_cos - cos * step_sin);
        const float after =
            leaves(m, MAX_RANGE[t->sonar], cos * step_cos - sin * step_sin, sin * step_cos + cos * step_sin);
        t->after = smaller(here, after);
        t->before = smaller(before, here);
#endif
    }
}
