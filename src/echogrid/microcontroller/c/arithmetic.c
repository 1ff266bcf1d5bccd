/* Functions of libm, to about 1e-6: enough here, alike on every machine, and no library is needed. */

#define PI 3.14159265f

static float magnitude(float x) { return x < 0.0f ? -x : x; }

static float smaller(float a, float b) { return a < b ? a : b; }

static float larger(float a, float b) { return a > b ? a : b; }

static float clipped(float x, float low, float high) { return smaller(larger(x, low), high); }

union word {
    float value;
    uint32_t bits;
};

/* The whole number at or below x, for |x| below 2^31. */
static int32_t whole(float x) {
    const int32_t cut = (int32_t)x;
    return (float)cut > x ? cut - 1 : cut;
}

static float root(float x) {
    if (!(x > 1e-30f)) {
        return 0.0f;
    }
    union word guess = {.value = x};
    guess.bits = 0x5f375a86u - (guess.bits >> 1);
    float y = guess.value;
    for (int i = 0; i < 3; i++) {
        y *= 1.5f - 0.5f * x * y * y;
    }
    return x * y;
}

static float exponential(float x) {
    const float within = clipped(x, -80.0f, 80.0f);
    const int32_t power = whole(within * 1.44269504f + 0.5f);
    const float r = (within - (float)power * 0.693359375f) + (float)power * 2.12194440e-4f;
    const float series =
        1.0f +
        r * (1.0f + r * (0.5f + r * (0.16666667f + r * (0.041666668f + r * (0.008333334f + r * 0.0013888889f)))));
    const union word scale = {.bits = (uint32_t)(power + 127) << 23};
    return series * scale.value;
}

/* log(1 + x) for x at or above 0. */
static float logarithm_past_one(float x) {
    union word parts = {.value = 1.0f + x};
    const int32_t power = (int32_t)((parts.bits - 0x3f3504f3u) >> 23);
    parts.bits -= (uint32_t)power << 23;
    const float s = (parts.value - 1.0f) / (parts.value + 1.0f), q = s * s;
    const float series = 2.0f * s * (1.0f + q * (0.33333333f + q * (0.2f + q * (0.14285714f + q * 0.11111111f))));
    return series + (float)power * 0.69314718f;
}

static float hyperbolic_tangent(float x) {
    const float e = exponential(2.0f * clipped(x, -20.0f, 20.0f));
    return (e - 1.0f) / (e + 1.0f);
}

/* The angle in [-pi, pi]. */
static float wrapped(float angle) {
    const float turns = (float)whole(angle * (0.5f / PI) + 0.5f);
    return (angle - turns * 6.28125f) - turns * 1.93530718e-3f;
}

static float sine(float angle) {
    float x = wrapped(angle);
    x = x > 0.5f * PI ? PI - x : x < -0.5f * PI ? -PI - x : x;
    const float q = x * x;
    return x * (1.0f + q * (-0.16666667f +
                            q * (8.3333333e-3f + q * (-1.9841270e-4f + q * (2.7557319e-6f + q * -2.5052108e-8f)))));
}

static float cosine(float angle) { return sine(wrapped(angle) + 0.5f * PI); }

/* Of the point (x, y), in [-pi, pi]. */
static float bearing_of(float y, float x) {
    const float across = magnitude(y), along = magnitude(x);
    float a = smaller(across, along) / larger(larger(across, along), 1e-30f), base = 0.0f;
    if (a > 0.41421356f) {
        a = (a - 1.0f) / (a + 1.0f);
        base = 0.25f * PI;
    }
    const float q = a * a;
    float angle =
        base +
        a * (1.0f +
             q * (-0.33333333f +
                  q * (0.2f + q * (-0.14285714f + q * (0.11111111f + q * (-0.090909091f + q * 0.076923077f))))));
    angle = across > along ? 0.5f * PI - angle : angle;
    angle = x < 0.0f ? PI - angle : angle;
    return y < 0.0f ? -angle : angle;
}
