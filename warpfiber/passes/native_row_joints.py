"""Rows of contact next to the joints of a chain, many pairs at a time: C++ text for `find_slots`.

Repeats what of `row_geometry.make_row_geometry` looks at the segments beside the two of a pair:
`is_nearest` and `is_beside_next`. Measured, 1000 chains of 5 segments, V_f = 0.1: 800 of the 2900
pairs that a step looks at need it, 80 ns each; 300 one after the other.
Source, symbols: as there; `begins`, `ends`: the segment is the first, the last of its fiber.
"""

# Behind `is_joint`; `near`, `arc` and `least` as in `native_row_slots`.
JOINTS = """
            // edges before and behind a segment, of a fiber's own end anything
            struct Beside { V3 before, behind; M next_ends; };
            auto beside_of = [&](const auto& own) -> Beside {
                R before[W], behind[W];
                T ends[W];
                for (int l = 0; l < W; ++l) {
                    const int segment = own.data[pairs[l]], of = segment_ends.data[segment];
                    const long long node = segment_node.data[segment];
                    const T* const b = back + 3 * (of & FIRST ? node : node - 1);
                    const T* const a = back + 3 * (of & LAST ? node : node + 1);
                    before[l] = load(b + 2).yzww - load(b);
                    behind[l] = load(a + 2).yzww - load(a);
                    ends[l] = !(of & LAST) && segment_ends.data[segment + 1] & LAST ? T(1) : T(0);
                }
                V flag;
                __builtin_memcpy(&flag, ends, sizeof(V));
                return Beside{transposed(before), transposed(behind), flag > V(T(0.5))};
            };
            // `apart`: from the point to the place `t` on `edge`
            auto is_nearest = [&](V t, const V3& apart, const V3& edge, V length,
                                  const Beside& on, M begins, M ends) -> M {
                const V rest = T(1) - t, before2 = on.before.dot(on.before);
                const V behind2 = on.behind.dot(on.behind);
                const M at_end = ~ends & (t >= T(1) - near);
                const M outside = apart.dot(on.behind) >= -near * behind2;
                const V back = (apart - edge * t).dot(on.before) / before2;
                const V ahead = V(T(0)) - (apart + edge * rest).dot(on.behind) / behind2;
                const V left = back * __builtin_elementwise_sqrt(before2), from = t * length;
                const V right = ahead * __builtin_elementwise_sqrt(behind2), to = rest * length;
                const M is_left = ~begins & (from < arc) & (back > near) & (left + from < arc)
                    & (left >= from);
                const M is_right = ~ends & (to < arc) & (ahead > near) & (right + to < arc)
                    & (right > to);
                return (at_end & outside) | ~(at_end | is_left | is_right);
            };
            // `from`: from a joint to the start of the other segment, whose nearest place is t
            auto is_beside_next = [&](const V3& from, const Beside& on, const V3& other, V size2,
                                      V length, V t, M begins, M ends) -> M {
                const V own2 = larger(on.behind.dot(on.behind), least);
                const Place p = closest(Motion{from, on.behind, other}, own2, size2);
                const M joins = (p.s <= near) | (~on.next_ends & (p.s >= T(1) - near));
                return ~(joins | is_joint(p.t, begins, ends))
                    & (size(p.s) * __builtin_elementwise_sqrt(own2) < arc)
                    & (size(p.t - t) * length < arc);
            };
"""
