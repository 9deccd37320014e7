"""C++ text that collects near pairs of bonded spheres whose law of contact may have a load.

Most pairs within reach leave their contact to a neighboring segment (vertex rule). What is left to
them are saddles and maxima of the distance in hollows of kinks, and few have any. Both are looked
for here pair by pair: to take all of them through the law of contact costs a third more.
Source: vertex rule of `pairs`, saddles of `capsule_touch`; both with a margin for rounding.
Symbols: as in `capsule_touch`; c from the nearest point of i to that of j, `start` from the first
    node of i to that of j, `onward` edges away from a node.
"""

# Numbers of a pair; whether its contact is that of a neighbor, and whether it may have saddles or
# maxima at its nodes that are `close` (first, second one of i, those of j).
MATTERS = """
    struct Ends {
        int code_i, code_j;
        T s, t;
        P4 c;
    };
    auto along = [](P4 x, P4 y) -> double {
        const P4 product = x * y;
        return product[0] + product[1] + product[2];
    };
    auto edge = [&](long from, long to) -> P4 { return place_row(to) - place_row(from); };
    auto is_passed_on = [&](const Ends& e) -> bool {
        const long i = e.code_i >> TIP_BITS, j = e.code_j >> TIP_BITS;
        if (e.s <= NEAR && !(e.code_i & 1)) {
            const P4 back = edge(i, i - 1);
            if (along(e.c, back) > 2 * NEAR * along(back, back)) return true;
        }
        if (e.t > NEAR || e.code_j & 1) return false;
        const P4 back = edge(j, j - 1);
        return along(e.c, back) < -2 * NEAR * along(back, back);
    };
    auto may_be_hollow = [&](const Ends& e, const unsigned* close, int l) -> bool {
        const long i = e.code_i >> TIP_BITS, j = e.code_j >> TIP_BITS;
        const P4 a = edge(i, i + 1), b = edge(j, j + 1);
        const P4 start = e.c - b * e.t + a * e.s;
        const P4 nodes_i[2] = {a - a, a}, nodes_j[2] = {start, start + b};
        // from a node to the nearest point of the other segment
        auto away = [&](P4 node, P4 from, P4 other) -> P4 {
            double part = along(node - from, other) / along(other, other);
            part = part > 0 ? part : 0;
            return from + other * (part < 1 ? part : 1) - node;
        };
        bool is_close[4];
        P4 onward[4];
        for (int m = 0; m < 4; ++m) {
            is_close[m] = close[m] >> l & 1;
            const long node = (m < 2 ? i : j) + (m & 1);
            if (is_close[m]) onward[m] = edge(node, m & 1 ? node + 1 : node - 1);
        }
        for (int m = 0; m < 2; ++m) {
            if (is_close[m] && (m == 0 ? e.s : 1 - e.s) > NEAR
                && along(away(nodes_i[m], start, b), onward[m]) > 0) return true;
            if (is_close[2 + m] && (m == 0 ? e.t : 1 - e.t) > NEAR
                && along(away(nodes_j[m], nodes_i[0], a), onward[2 + m]) > 0) return true;
            for (int n = 0; n < 2; ++n) {
                if (!is_close[m] || !is_close[2 + n]) continue;
                const P4 gap = nodes_j[n] - nodes_i[m];
                if (along(gap, onward[m]) > 0 && along(gap, onward[2 + n]) < 0) return true;
            }
        }
        return false;
    };
"""

# Distances of all near pairs of a part, and the law of contact wherever enough are collected.
SWEEP = """
    const int begin = out_start[part_start[part]], end = begin + near_count[part];
    if (keeps) __builtin_memset(pair_acts + begin, 0, out_start[part_start[part + 1]] - begin);
    struct Point { enum { HAS_LINE = false }; };
    struct Line { enum { HAS_LINE = true }; };
    constexpr int ROOM = 2 * W;
    // pairs that may touch along a line lie behind those that touch at a point
    int hit_at[2 * ROOM], points = 0, lines = 0;
    T hit_s[2 * ROOM], hit_t[2 * ROOM];
    auto run = [&](auto kind, int from, int& hits) {
        law(kind, hit_at + from, hit_s + from, hit_t + from, W);
        hits -= W;
        for (int l = from; l < from + hits; ++l) {
            hit_at[l] = hit_at[W + l];
            hit_s[l] = hit_s[W + l];
            hit_t[l] = hit_t[W + l];
        }
    };
    auto run_rest = [&](auto kind, int from, int hits) {
        if (hits == 0) return;
        for (int l = from + hits; l < from + W; ++l) {
            hit_at[l] = hit_at[from];
            hit_s[l] = hit_s[from];
            hit_t[l] = hit_t[from];
        }
        law(kind, hit_at + from, hit_s + from, hit_t + from, hits);
    };
    for (int first = begin; first < end; first += W) {
        const int count = end - first < W ? end - first : W;
        I code_i, code_j, images;
        __builtin_memcpy(&code_i, near_i + first, sizeof(I));
        __builtin_memcpy(&code_j, near_j + first, sizeof(I));
        __builtin_memcpy(&images, near_image + first, sizeof(I));
        const I from_i = code_i >> TIP_BITS, from_j = code_j >> TIP_BITS;
        const int* const later = near_j + first + (is_large ? AHEAD : 1) * W;
        for (int l = 0; l < W; ++l) {
            const double* const x = (const double*)place + 3L * (later[l] >> TIP_BITS);
            __builtin_prefetch(x);
            if (is_large) __builtin_prefetch(x + 5);
        }
        V s, t, aa, bb, ab;
        M aligned;
        const V3 c = closest(
            images, (const int*)&from_i, (const int*)&from_j, s, t, aligned, aa, bb, ab);
        const V square = c.dot(c);
        // Nearest points at an inner node: the contact may be that of a neighbor; then at most
        // saddles and maxima are left, at nodes within a patch from which the distance falls.
        const M on_i = ~tipped(code_i, 2), on_j = ~tipped(code_j, 2);
        const V rest_s = T(1) - s, rest_t = T(1) - t;
        const M past_i = ~tipped(code_i, 1), past_j = ~tipped(code_j, 1);
        const M leaves = ~aligned & (((rest_s <= NEAR) & on_i) | ((rest_t <= NEAR) & on_j));
        const M begins = ~aligned & (((s <= NEAR) & past_i) | ((t <= NEAR) & past_j));
        const V wide = aa * bb - ab * ab;
        const V most = (ROUNDED * largest_reach) * (largest_reach - root(square));
        const M close0_i = past_i & (s * s * wide <= most * bb);
        const M close1_i = on_i & (rest_s * rest_s * wide <= most * bb);
        const M close0_j = past_j & (t * t * wide <= most * aa);
        const M close1_j = on_j & (rest_t * rest_t * wide <= most * aa);
        const M hollow = ((s > NEAR) & close0_i) | ((rest_s > NEAR) & close1_i)
            | ((t > NEAR) & close0_j) | ((rest_t > NEAR) & close1_j);
        const M hit = (square < largest_reach * largest_reach) & (hollow | ~leaves);
        const unsigned line = bits(aligned), left_some = bits(leaves);
        const unsigned asked = bits(leaves | begins);
        const unsigned close[4] = {bits(close0_i), bits(close1_i), bits(close0_j), bits(close1_j)};
        const unsigned hollows = bits(hollow);
        for (unsigned left = bits(hit) & ((1u << count) - 1u); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            if (asked >> l & 1) {
                const P4 gap = {((const T*)&c.x)[l], ((const T*)&c.y)[l], ((const T*)&c.z)[l], 0};
                const Ends ends = {code_i[l], code_j[l], ((const T*)&s)[l], ((const T*)&t)[l], gap};
                const bool leaves_it = (left_some >> l & 1) || is_passed_on(ends);
                if (leaves_it && !((hollows >> l & 1) && may_be_hollow(ends, close, l))) continue;
            }
            const int slot = line >> l & 1 ? ROOM + lines++ : points++;
            hit_at[slot] = first + l;
            hit_s[slot] = ((const T*)&s)[l];
            hit_t[slot] = ((const T*)&t)[l];
            const long k = near_pair[first + l];
            const long i = ((const int*)&from_i)[l], j = ((const int*)&from_j)[l];
            if constexpr (HAS_DASHPOT || HAS_FRICTION) {
                __builtin_prefetch((const T*)node_velocity + 3 * i);
                __builtin_prefetch((const T*)node_velocity + 3 * j);
                __builtin_prefetch((const T*)node_spin + 3 * i);
                __builtin_prefetch((const T*)node_spin + 3 * j);
            }
            __builtin_prefetch(load + j, 1);
            __builtin_prefetch(load + j + 1, 1);
            if constexpr (HAS_FRICTION) {
                __builtin_prefetch(written_last + k);
                __builtin_prefetch(written_now + k, 1);
                __builtin_prefetch(kept_last + 4 * k);
                __builtin_prefetch(kept_now + 4 * k, 1);
            }
        }
        if (points >= W) run(Point(), 0, points);
        if (lines >= W) run(Line(), ROOM, lines);
    }
    run_rest(Point(), 0, points);
    run_rest(Line(), ROOM, lines);
"""
