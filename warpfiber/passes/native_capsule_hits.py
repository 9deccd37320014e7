"""C++ text that collects near pairs of bonded spheres within reach for their law of contact.

Pairs are collected apart by what of the law they need: whether their patch lies within both
segments, at the end of a fiber, or across which mean directions. What a step reads and writes is
more than the second cache holds; it is fetched there, since asking for the first one stands still.
Source: the patch of `capsule_touch`, with the largest reach of all pairs.
"""

# Distances of all near pairs of a part, and the law of contact wherever enough are collected.
SWEEP = """
    const int begin = out_start[part_start[part]], end = begin + near_count[part];
    if (keeps) __builtin_memset(pair_acts + begin, 0, out_start[part_start[part + 1]] - begin);
    struct Whole {
        enum { IS_SHARED = false, WAYS = 1, HAS_TIPS = false };
        typedef Untipped Tips;
    };
    struct OneWay : Whole { enum { IS_SHARED = true }; };
    struct TwoWays : OneWay { enum { WAYS = 2 }; };
    struct AtTips : OneWay {
        enum { WAYS = 0, HAS_TIPS = true };
        typedef Tipped Tips;
    };
    auto fetch = [](const void* from) { __builtin_prefetch(from, 0, 2); };
    constexpr int ROOM = RUN + W, KINDS = 4;
    int hit_at[KINDS * ROOM], hits_of[KINDS] = {0, 0, 0, 0};
    T hit_s[KINDS * ROOM], hit_t[KINDS * ROOM];
    auto run = [&](auto kind, int from, int& hits) {
        for (int at = from; at < from + RUN; at += W)
            law(kind, hit_at + at, hit_s + at, hit_t + at, W);
        hits -= RUN;
        for (int l = from; l < from + hits; ++l) {
            hit_at[l] = hit_at[RUN + l];
            hit_s[l] = hit_s[RUN + l];
            hit_t[l] = hit_t[RUN + l];
        }
    };
    auto run_rest = [&](auto kind, int from, int hits) {
        for (int l = from + hits; hits > 0 && l < from + hits + W; ++l) {
            hit_at[l] = hit_at[from];
            hit_s[l] = hit_s[from];
            hit_t[l] = hit_t[from];
        }
        for (int at = from; hits > 0; at += W, hits -= W)
            law(kind, hit_at + at, hit_s + at, hit_t + at, hits < W ? hits : W);
    };
    for (int first = begin; first < end; first += W) {
        const int count = end - first < W ? end - first : W;
        I code_i, code_j, images;
        __builtin_memcpy(&code_i, near_i + first, sizeof(I));
        __builtin_memcpy(&code_j, near_j + first, sizeof(I));
        __builtin_memcpy(&images, near_image + first, sizeof(I));
        const I from_i = code_i >> TIP_BITS, from_j = code_j >> TIP_BITS;
        const int* const later = near_j + first + AHEAD * W;
        for (int l = 0; l < W; ++l) {
            const double* const x = (const double*)place + 3L * (later[l] >> TIP_BITS);
            fetch(x);
            fetch(x + 5);
        }
        fetch(near_i + first + FAR * W);
        fetch(near_j + first + FAR * W);
        fetch(near_image + first + FAR * W);
        fetch(near_pair + first + FAR * W);
        V s, t, aa, bb, ab;
        const V3 c = closest(images, (const int*)&from_i, (const int*)&from_j, s, t, aa, bb, ab);
        const V square = c.dot(c), rest_s = T(1) - s, rest_t = T(1) - t;
        const M hit = square < largest_reach * largest_reach;
        // half of a patch along either fiber: p^2 = (reach^2 - square) / 2 (1 - cosine)
        const V in_s = smaller(s, rest_s), in_t = smaller(t, rest_t);
        const V both = root(aa * bb), wide = T(2) * (both - (ab < T(0) ? -ab : ab));
        const V most = (largest_reach * largest_reach - square) * both;
        const M whole = (in_s * in_s * aa * wide > most) & (in_t * in_t * bb * wide > most);
        const M at_tip = (s < T(0.5) ? tipped(code_i, 1) : tipped(code_i, 2))
            | (t < T(0.5) ? tipped(code_j, 1) : tipped(code_j, 2));
        const V size = ab < T(0) ? -ab : ab;
        const unsigned shared = bits(~whole), tips = bits(at_tip);
        const unsigned two_ways = bits(at_tip | (size < BOTH_WAYS * both));
        for (unsigned left = bits(hit) & ((1u << count) - 1u); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            // without a branch: whole, one way, two ways, tips
            const int kind = (shared >> l & 1) * (1 + (two_ways >> l & 1) + (tips >> l & 1));
            const int slot = kind * ROOM + hits_of[kind]++;
            hit_at[slot] = first + l;
            hit_s[slot] = ((const T*)&s)[l];
            hit_t[slot] = ((const T*)&t)[l];
            const long k = near_pair[first + l];
            const long i = ((const int*)&from_i)[l], j = ((const int*)&from_j)[l];
            if constexpr (HAS_DASHPOT || HAS_FRICTION) {
                fetch((const T*)node_velocity + 3 * i);
                fetch((const T*)node_velocity + 3 * j);
                fetch((const T*)node_spin + 3 * i);
                fetch((const T*)node_spin + 3 * j);
                fetch((const T*)node_velocity + 3 * j + 5);
                fetch((const T*)node_spin + 3 * j + 5);
            }
            fetch(load + i);
            fetch(load + i + 1);
            fetch(load + j);
            fetch(load + j + 1);
            if constexpr (HAS_FRICTION) {
                fetch(pair_step + 2 * k);
                fetch((const T*)pair_memory + 8 * k);
            }
        }
        if (hits_of[0] >= RUN) run(Whole(), 0, hits_of[0]);
        if (hits_of[1] >= RUN) run(OneWay(), ROOM, hits_of[1]);
        if (hits_of[2] >= RUN) run(TwoWays(), 2 * ROOM, hits_of[2]);
        if (hits_of[3] >= RUN) run(AtTips(), 3 * ROOM, hits_of[3]);
    }
    run_rest(Whole(), 0, hits_of[0]);
    run_rest(OneWay(), ROOM, hits_of[1]);
    run_rest(TwoWays(), 2 * ROOM, hits_of[2]);
    run_rest(AtTips(), 3 * ROOM, hits_of[3]);
"""
