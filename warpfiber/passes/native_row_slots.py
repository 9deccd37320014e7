"""Which rows of contact pairs have, many pairs at a time: C++ text for `pair_motion`.

Repeats `row_geometry.make_row_geometry` for what depends on two segments and their motion alone.
Pairs for which the segments beside them count (a place near a joint) wait for each other and are
decided by `native_row_joints`; what may depend on radii that differ, or on bead pairs, is marked
LOOK and decided by `row_count`.

Source: as there: closest points and four ends, those whose predicted gap is below `keep` and that
    no row nearby stands for.
Symbols: as there; `settles`: radii are equal and nothing but predicted gaps decides.
"""

from warpfiber.passes.native_row_joints import JOINTS
from warpfiber.passes.pairs import END_TOLERANCE
from warpfiber.passes.row_geometry import CLOSER, CROSSING

LOOK = 128  # among the slots of a pair
FIRST, LAST = 1, 2  # a segment begins, ends its fiber
ALONE = 2  # `settles` where all of them do both
SLACK = 1e-4  # radii: where rounding may decide, the other kernel does

TEXT = """
    int at_joints[2 * W], joints = 0;
    struct Alone { enum { value = 0 }; };
    struct ByJoints { enum { value = 1 }; };
    // compiled for each of both
    auto find_slots = [&](const int* pairs, int count, auto kind) __attribute__((noinline)) {
        constexpr bool beside = decltype(kind)::value;
        const Motion m = motion_of(pairs);
        const V aa = larger(m.a.dot(m.a), least), bb = larger(m.b.dot(m.b), least);
        const V ab = m.a.dot(m.b), da = m.d.dot(m.a), db = m.d.dot(m.b);
        const V length_a = __builtin_elementwise_sqrt(aa);
        const V length_b = __builtin_elementwise_sqrt(bb);
        const Place places[5] = {
            closest(m, aa, bb),
            {V(T(1)), clipped((ab - db) / bb)}, {V(T(0)), clipped(-db / bb)},
            {clipped((da + ab) / aa), V(T(1))}, {clipped(da / aa), V(T(0))},
        };
        const T below = widest * (keep + (settles ? T(0) : T(SLACK)));
        const T now_below = settles ? T(-1e20) : widest * (near_now + T(SLACK));
        const T damp = wet * (T(1) + T(SLACK));
        V apart2[5];
        M close[5], look = V(T(0)) > V(T(1)), waits = look;
        for (int k = 0; k < 5; ++k) {
            const V s = places[k].s, t = places[k].t;
            const V3 c = m.d + m.b * t - m.a * s, moved = m.w + m.wb * t - m.wa * s;
            apart2[k] = c.dot(c);
            const V apart = __builtin_elementwise_sqrt(apart2[k]);
            const V gap = apart - T(2) * widest;
            close[k] = (gap + c.dot(moved) / apart < below) | (gap < now_below);
            look |= apart <= T(CROSSING);
        }
        V bits = V(T(0));
        const T arc = widest;
        auto size = [](V x) -> V { return __builtin_elementwise_abs(x); };
        auto same = [&](const Place& p, const Place& q) -> M {
            return (size(p.s - q.s) * length_a < arc) & (size(p.t - q.t) * length_b < arc);
        };
        if (settles == ALONE) {  // as below, where every segment begins and ends its fiber
            M stands[3];
            bits = close[0] ? V(T(1)) : bits;
            for (int k = 1; k < 3; ++k) {
                stands[k] = ~same(places[k], places[0]);
                bits += close[k] & stands[k] ? V(T(1 << k)) : V(T(0));
            }
            for (int k = 3; k < 5; ++k) {
                M made = close[k] & ~same(places[k], places[0]);
                for (int other = 1; other < 3; ++other)
                    made &= ~(same(places[k], places[other]) & stands[other]);
                bits += made ? V(T(1 << k)) : V(T(0));
            }
        } else if (settles) {
            T flags[4][W];
            for (int l = 0; l < W; ++l) {
                const int i = pair_i.data[pairs[l]], j = pair_j.data[pairs[l]];
                // a fiber that meets itself: every pair for itself
                const bool own = segment_fiber.data[i] == segment_fiber.data[j]
                    && pair_image.data[pairs[l]] == NONE;
                const int of_i = own ? FIRST | LAST : segment_ends.data[i];
                const int of_j = own ? FIRST | LAST : segment_ends.data[j];
                flags[0][l] = of_i & FIRST ? T(1) : T(0);
                flags[1][l] = of_i & LAST ? T(1) : T(0);
                flags[2][l] = of_j & FIRST ? T(1) : T(0);
                flags[3][l] = of_j & LAST ? T(1) : T(0);
            }
            M is_end[4];
            for (int e = 0; e < 4; ++e) {
                V flag;
                __builtin_memcpy(&flag, flags[e], sizeof(V));
                is_end[e] = flag > V(T(0.5));
            }
            const M first_i = is_end[0], last_i = is_end[1];
            const M first_j = is_end[2], last_j = is_end[3];
            const T near = T(END_TOLERANCE);
            auto is_joint = [&](V s, M begins, M ends) -> M {
                return ((s <= near) & ~begins) | ((s >= T(1) - near) & ~ends);
            };
            // places next to a joint, where the segment beyond may have the nearer one
            auto by_joint = [&](V s, V length, M begins, M ends) -> M {
                return (~begins & (s * length < arc))
                    | (~ends & (((T(1) - s) * length < arc) | (s >= T(1) - near)));
            };
JOINTS
            Beside by_i, by_j;
            if (beside) {
                by_i = beside_of(pair_i);
                by_j = beside_of(pair_j);
            }
            const M has_first = ~(is_joint(places[0].s, first_i, last_i)
                                  | is_joint(places[0].t, first_j, last_j));
            bits = has_first & close[0] ? V(T(1)) : bits;
            const M with_i[2] = {close[1], close[2] & first_i};
            for (int k = 1; k < 3; ++k) {
                M made = with_i[k - 1] & ~(has_first & same(places[k], places[0]));
                made &= ~((places[k].t <= near) & ~first_j);
                if (beside) {
                    const V t = places[k].t;
                    const V3 c = m.d + m.b * t - m.a * places[k].s;
                    made &= is_nearest(t, c, m.b, length_b, by_j, first_j, last_j);
                    if (k == 1)
                        made &= last_i | ~is_beside_next(
                            m.d - m.a, by_i, m.b, bb, length_b, t, first_j, last_j);
                } else {
                    waits |= made & by_joint(places[k].t, length_b, first_j, last_j);
                    if (k == 1) waits |= made & ~last_i;
                }
                bits += made ? V(T(1 << k)) : V(T(0));
            }
            const M with_j[2] = {close[3], close[4] & first_j};
            for (int k = 3; k < 5; ++k) {
                M made = with_j[k - 3] & ~(has_first & same(places[k], places[0]));
                for (int other = 1; other < 3; ++other) {
                    const M stands = (has_first & ~same(places[other], places[0]))
                        | (~has_first & (apart2[k] >= T(CLOSER * CLOSER) * apart2[other]));
                    made &= ~(same(places[k], places[other]) & stands);
                }
                made &= ~((places[k].s <= near) & ~first_i);
                if (beside) {
                    const V at = places[k].s;
                    const V3 c = m.a * at - m.d - m.b * places[k].t;
                    made &= is_nearest(at, c, m.a, length_a, by_i, first_i, last_i);
                    if (k == 3)
                        made &= last_j | ~is_beside_next(
                            V3{} - m.d - m.b, by_j, m.a, aa, length_a, at, first_i, last_i);
                } else {
                    waits |= made & by_joint(places[k].s, length_a, first_i, last_i);
                    if (k == 3) waits |= made & ~last_j;
                }
                bits += made ? V(T(1 << k)) : V(T(0));
            }
            bits = waits ? V(T(0)) : bits;
        } else {
            for (int k = 0; k < 5; ++k) look |= close[k] | (apart2[k] < damp * damp);
        }
        waits &= ~look;
        for (int l = 0; l < count; ++l)
            if (waits[l]) at_joints[joints++] = pairs[l];
        bits = look ? V(T(LOOK)) : bits;
        for (int l = 0; l < count; ++l) {
            const int found = (int)bits[l], i = pair_i.data[pairs[l]];
            const bool looked_for = found == LOOK;
            const int made = looked_for ? 0 : __builtin_popcount(found);
            pair_slots.data[pairs[l]] = (unsigned char)found;
            pair_row_count.data[pairs[l]] = made;
            segment_look.data[i] |= looked_for;
            segment_rows.data[i] += made;
        }
    };
    // a vector of those that wait, at the end what is left
    auto find_joints = [&](bool all) {
        while (joints >= W || (all && joints > 0)) {
            const int count = joints < W ? joints : W;
            for (int l = count; l < W; ++l) at_joints[l] = at_joints[count - 1];
            joints -= count;
            find_slots(at_joints, count, ByJoints{});
            for (int l = 0; l < joints; ++l) at_joints[l] = at_joints[W + l];
        }
    };
"""


def slots_text(name: str) -> str:
    """`find_slots(pairs, count, kind)`, `find_joints(all)`; `NONE`: a pair that is no image."""
    text = TEXT.replace("JOINTS", JOINTS)
    for key, value in {
        "SLACK": repr(SLACK),
        "LOOK": str(LOOK),
        "ALONE": str(ALONE),
        "FIRST": str(FIRST),
        "LAST": str(LAST),
        "END_TOLERANCE": repr(END_TOLERANCE[name]),
        "CLOSER": repr(CLOSER),
        "CROSSING": repr(CROSSING[name]),
    }.items():
        text = text.replace(key, value)
    return text
