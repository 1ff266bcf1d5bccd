/* The set network: of a bearing round the robot, what its sonars say together of the points along it. */

/* A sonar that fired, as the network sees it from a bearing. */
struct fired {
    const struct token* from;
    float reading; /* m */
    float range;   /* m; without an echo the sonar's maximum */
    float place;   /* of the echo along the bearing, m */
    float off;     /* rad, between the sonar's axis and the bearing's point at its range */
    float reach;   /* the sonar's maximum range, m */
    int echo;
};

/* The tokens of a bearing that fired; returns how many. */
static int fired_of(const struct token tokens[TOKENS], const float ranges[ECHOGRID_SONARS],
                    struct fired fired[TOKENS]) {
    int count = 0;
    for (int k = 0; k < TOKENS; k++) {
        const struct token* const t = &tokens[k];
        if (t->sonar == NO_SONAR || ranges[t->sonar] != ranges[t->sonar]) {
            continue;
        }
        struct fired* const f = &fired[count++];
        const float reading = ranges[t->sonar];
        f->from = t;
        f->reading = reading;
        f->reach = MAX_RANGE[t->sonar];
        f->echo = reading < INFINITY;
        f->range = clipped(f->echo ? reading : f->reach, 0.01f, FAR_M);
        f->place = t->ahead + root(larger(f->range * f->range - t->aside * t->aside, 0.01f));
        const float sin = clipped(t->aside / f->range, -1.0f, 1.0f);
        f->off = -(sin + sin * sin * sin / 6.0f) - t->axis;
    }
    return count;
}

static float bell(float off, float width) {
    const float x = off / width;
    return exponential(-x * x);
}

/* How a reading compares with those of sonars that look nearly the same way: how many agree, how much farther they
 * read, fine and coarse. */
static void compare(const struct fired* f, const struct fired all[], int count, float told[3]) {
    float same = -1.0f, fine = 0.0f, coarse = 0.0f;
    for (int j = 0; j < count; j++) {
        const float near = bell(f->from->axis - all[j].from->axis, NEIGHBOUR_RAD);
        const float apart = all[j].place - f->place;
        same += near * larger(1.0f - magnitude(apart) / SAME_M, 0.0f);
        fine += near * clipped(apart / 0.25f, -1.0f, 1.0f);
        coarse += near * clipped(apart, -1.0f, 1.0f);
    }
    told[0] = same;
    told[1] = fine;
    told[2] = coarse;
}

static void describe(const struct fired* f, const struct fired all[], int count, float first, float told[FEATURES]) {
    const float after = f->place - first;
    told[0] = f->echo ? 1.0f : 0.0f;
    told[1] = f->echo ? 0.0f : 1.0f;
    told[2] = sine(f->from->axis);
    told[3] = cosine(f->from->axis);
    told[4] = bell(f->off, 0.1f);
    told[5] = bell(f->off, 0.25f);
    told[6] = bell(f->off, 0.5f);
    told[7] = f->off;
    told[8] = f->range / 2.0f;
    told[9] = exponential(-f->range / 0.5f);
    told[10] = larger(1.0f - after / 0.1f, 0.0f);
    told[11] = smaller(after, 0.5f) * 2.0f;
    told[12] = f->from->ahead * 3.0f;
    told[13] = f->from->aside * 3.0f;
    compare(f, all, count, &told[14]);
    told[17] = LOG_BEAM;
    told[18] = bell(f->off, BEAM_RAD);
    told[19] = smaller(f->reach, FAR_M) / FAR_M;
}

/* y = bias + weights x; a row of weights for each of n units. Four at a time, so that x is loaded once for them. */
static void dense(const float* weights, const float* bias, const float* x, int m, int n, float* y) {
    const int fours = n - n % 4;
    for (int j = 0; j < fours; j += 4) {
        const float* const w = weights + j * m;
        float a = bias[j], b = bias[j + 1], c = bias[j + 2], d = bias[j + 3];
        for (int i = 0; i < m; i++) {
            a += w[i] * x[i];
            b += w[m + i] * x[i];
            c += w[2 * m + i] * x[i];
            d += w[3 * m + i] * x[i];
        }
        y[j] = a;
        y[j + 1] = b;
        y[j + 2] = c;
        y[j + 3] = d;
    }
    for (int j = fours; j < n; j++) {
        float total = bias[j];
        for (int i = 0; i < m; i++) {
            total += weights[j * m + i] * x[i];
        }
        y[j] = total;
    }
}

static void rectify(float* x, int n) {
    for (int i = 0; i < n; i++) {
        x[i] = larger(x[i], 0.0f);
    }
}

/* Two weighted means over the tokens of their units. */
static void pool(float h[TOKENS][UNITS], int count, const float* weights, float pooled[2 * UNITS]) {
    static const float zero[2] = {0.0f, 0.0f};
    float share[TOKENS][2], total[2] = {1e-6f, 1e-6f};
    for (int k = 0; k < count; k++) {
        dense(weights, zero, h[k], UNITS, 2, share[k]);
        for (int i = 0; i < 2; i++) {
            share[k][i] = exponential(clipped(share[k][i], -10.0f, 10.0f));
            total[i] += share[k][i];
        }
    }
    for (int i = 0; i < 2; i++) {
        for (int j = 0; j < UNITS; j++) {
            float sum = 0.0f;
            for (int k = 0; k < count; k++) {
                sum += share[k][i] * h[k][j];
            }
            pooled[i * UNITS + j] = sum / total[i];
        }
    }
}

/* Log-odds at the knots before and behind each echo, and at those along the bearing. */
static void encode(const struct fired fired[], int count, const float traits[TRAITS], float profiles[TOKENS][STEPS],
                   float rings[KNOTS]) {
    float h[TOKENS][UNITS], pooled[2 * UNITS], common[UNITS], first = FAR_M + 1.0f;
    for (int k = 0; k < count; k++) {
        first = fired[k].echo ? smaller(first, fired[k].place) : first;
    }
    for (int k = 0; k < count; k++) {
        float told[FEATURES];
        describe(&fired[k], fired, count, first, told);
        dense(W1, B1, told, FEATURES, UNITS, h[k]);
        rectify(h[k], UNITS);
    }
    pool(h, count, A1, pooled);
    float own[UNITS];
    dense(W2T, B2, traits, TRAITS, UNITS, own);
    dense(W2P, own, pooled, 2 * UNITS, UNITS, common);
    for (int k = 0; k < count; k++) {
        dense(W2, common, h[k], UNITS, UNITS, own);
        rectify(own, UNITS);
        for (int j = 0; j < UNITS; j++) {
            h[k][j] = own[j];
        }
        if (fired[k].echo) {
            dense(WP, BP, own, UNITS, STEPS, profiles[k]);
        }
    }
    pool(h, count, A2, pooled);
    dense(W3, B3, pooled, 2 * UNITS, UNITS, common);
    rectify(common, UNITS);
    dense(WR, BR, common, UNITS, KNOTS, rings);
}

/* The profile of an echo at a distance beyond it, m: linear between its knots, flat before them, 0 behind. */
static float profile_at(const float profile[STEPS], float beyond) {
    if (beyond <= STEPS_M[0]) {
        return profile[0];
    }
    if (beyond >= STEPS_M[STEPS]) {
        return 0.0f;
    }
    int k = 0;
    while (beyond > STEPS_M[k + 1]) {
        k++;
    }
    const float next = k + 1 < STEPS ? profile[k + 1] : 0.0f;
    return profile[k] + (next - profile[k]) * ((beyond - STEPS_M[k]) / (STEPS_M[k + 1] - STEPS_M[k]));
}

/* What is said of the points of a bearing, in 1 / POLAR_SCALE log-odds; 0 where no sonar that fired looks. */
static void tell(const struct fired fired[], int count, float profiles[TOKENS][STEPS], const float rings[KNOTS],
                 int16_t polar[RINGS]) {
    int knot = 0;
    for (int j = UNDER_RINGS; j < RINGS; j++) {
        const float distance = ((float)j + 0.5f) * RING_M;
        while (knot < KNOTS - 2 && distance > RINGS_M[knot + 1]) {
            knot++;
        }
        const float part = smaller((distance - RINGS_M[knot]) / (RINGS_M[knot + 1] - RINGS_M[knot]), 1.0f);
        float total = rings[knot] + (rings[knot + 1] - rings[knot]) * part;
        int spoken = 0;
        for (int k = 0; k < count; k++) {
            const struct token* const t = fired[k].from;
            spoken |= j >= t->first && j < t->end;
        }
        if (!spoken) {
            polar[j] = 0;
            continue;
        }
        for (int k = 0; k < count; k++) {
            if (fired[k].echo) {
                const float forward = distance - fired[k].from->ahead, aside = fired[k].from->aside;
                total += profile_at(profiles[k], root(forward * forward + aside * aside) - fired[k].reading);
            }
        }
        const float told = LIMIT * hyperbolic_tangent(total / LIMIT) * POLAR_SCALE;
        const int16_t nearest = (int16_t)whole(told + 0.5f);
        polar[j] = nearest != 0 ? nearest : told < 0.0f ? -1 : 1;
    }
}

/* The scan's local map: evidence at bearings and rings round the robot. */
static void tell_bearing(const struct token tokens[TOKENS], const float ranges[ECHOGRID_SONARS],
                         const float traits[TRAITS], int16_t polar[RINGS]) {
    struct fired fired[TOKENS];
    float profiles[TOKENS][STEPS], rings[KNOTS];
    const int count = fired_of(tokens, ranges, fired);
    for (int j = 0; j < RINGS; j++) {
        polar[j] = j < UNDER_RINGS ? UNDER : 0;
    }
    if (count > 0) {
        encode(fired, count, traits, profiles, rings);
        tell(fired, count, profiles, rings, polar);
    }
}
