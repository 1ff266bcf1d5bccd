/* What is remembered of the drive: where was looked from, what the surroundings are like, what sonars last heard. */

/* Count another look from a place and heading, of which the last ECHOGRID_PLACES are known, the last first. */
static float counted_again(struct echogrid* map, float x, float y, float theta, float share) {
    /* Places 819 m apart are one. */
    const uint32_t column = (uint32_t)whole(x / PLACE_M), row = (uint32_t)whole(y / PLACE_M);
    const float heading = wrapped(theta);
    const uint32_t turn = (uint32_t)whole((heading < 0.0f ? heading + 2.0f * PI : heading) / TURN_RAD);
    const uint32_t key = (column & 0x1fffu) | (row & 0x1fffu) << 13 | turn << 26;
    struct echogrid_place* const places = map->places;
    int at = 0;
    while (at < ECHOGRID_PLACES - 1 && places[at].key != key && places[at].key != NOWHERE) {
        at++;
    }
    const struct echogrid_place place = {key, share + (places[at].key == key ? places[at].looks : 0.0f)};
    for (; at > 0; at--) {
        places[at] = places[at - 1];
    }
    places[0] = place;
    return place.looks;
}

/* Take what a scan says of the surroundings, and tell what they are like, each from -0.5 to 0.5. */
static void notice(struct echogrid* map, const float ranges[ECHOGRID_SONARS], float traits[TRAITS]) {
    float sums[TRAITS] = {0.0f}, counts[TRAITS] = {0.0f};
    for (int s = 0; s < ECHOGRID_SONARS; s++) {
        if (ranges[s] == ranges[s]) {
            counts[0] += 1.0f;
            sums[0] += ranges[s] < INFINITY ? 0.0f : 1.0f;
            sums[3] += smaller(ranges[s], FAR_M) / FAR_M;
        }
    }
    counts[3] = counts[0];
    for (int p = 0; p < PAIRS; p++) {
        const float a = ranges[NEIGHBOURS[p].first], b = ranges[NEIGHBOURS[p].second], near = NEIGHBOURS[p].near;
        if (a != a || b != b) {
            continue;
        }
        const float apart = magnitude(smaller(a, FAR_M) - smaller(b, FAR_M));
        counts[2] += near;
        sums[2] += near * smaller(apart, 1.0f);
        if (a < INFINITY && b < INFINITY) {
            counts[1] += near;
            sums[1] += near * larger(1.0f - apart / SAME_M, 0.0f);
        }
    }
    for (int i = 0; i < TRAITS; i++) {
        map->trait_sums[i] = FADE * map->trait_sums[i] + sums[i];
        map->trait_counts[i] = FADE * map->trait_counts[i] + counts[i];
        traits[i] = (map->trait_sums[i] + 0.5f * PRIOR) / (map->trait_counts[i] + PRIOR) - 0.5f;
    }
}

/* Whether what a sonar heard last is to be used. */
static int is_recent(const struct echogrid_heard* last, const struct echogrid_heard* now) {
    const float dx = last->x - now->x, dy = last->y - now->y;
    const uint32_t age = now->ms - last->ms;
    return last->range == last->range && now->scan - last->scan <= RECENT_SCANS &&
           dx * dx + dy * dy <= RECENT_M * RECENT_M && magnitude(wrapped(last->theta - now->theta)) <= RECENT_RAD &&
           (age <= RECENT_MS || 0u - age <= RECENT_MS);
}

/* From where a sonar looked at another pose, as seen from the robot now. */
static struct mount seen_now(const float own[3], const struct echogrid_heard* then,
                             const struct echogrid_heard* now) {
    const float dx = then->x - now->x, dy = then->y - now->y, turned = wrapped(then->theta - now->theta);
    const float c = cosine(now->theta), s = sine(now->theta), tc = cosine(turned), ts = sine(turned);
    return mounted(c * dx + s * dy + tc * own[0] - ts * own[1], c * dy - s * dx + ts * own[0] + tc * own[1],
                   own[2] + turned);
}

/* Complete a scan by what its silent sonars heard last, and note it. `now` holds its pose, time and number.
 *
 * mounts: from where each looked. new_share: of the readings. Returns whether any looked from elsewhere than its own
 * mount: not on a robot that stands. */
static int complete(struct echogrid* map, float ranges[ECHOGRID_SONARS], const struct echogrid_heard* now,
                    struct mount mounts[ECHOGRID_SONARS], float* new_share) {
    int heard = 0, taken = 0, moved = 0;
    for (int s = 0; s < ECHOGRID_SONARS; s++) {
        struct echogrid_heard* const last = &map->heard[s];
        mounts[s] = mounted(MOUNTS[s][0], MOUNTS[s][1], MOUNTS[s][2]);
        if (ranges[s] == ranges[s]) {
            heard++;
            *last = *now;
            last->range = ranges[s];
        } else if (is_recent(last, now)) {
            taken++;
            ranges[s] = last->range;
            if (last->x != now->x || last->y != now->y || last->theta != now->theta) {
                mounts[s] = seen_now(MOUNTS[s], last, now);
                moved = 1;
            }
        }
    }
    *new_share = taken ? (float)heard / (float)(heard + taken) : 1.0f;
    return moved;
}
