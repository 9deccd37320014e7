"""How far segments moved off their listed lines, many at a time: C++ text for `list_bound`.

Repeats the plain kernel there, one lane per segment.
Symbols: as there; `strays` a bit per segment of the run.
"""

from warpfiber.passes.native_pair_lanes import row_lanes

TEXT = """
    auto times = [](const auto& m, const V3& v) -> V3 {
        return V3{v.x * m.data[0][0] + v.y * m.data[0][1] + v.z * m.data[0][2],
                  v.x * m.data[1][0] + v.y * m.data[1][1] + v.z * m.data[1][2],
                  v.x * m.data[2][0] + v.y * m.data[2][1] + v.z * m.data[2][2]};
    };
    const V3 origin = same3(flow_origin[0], flow_origin[1], flow_origin[2]);
    const V zero = V(T(0)), one = V(T(1)), limit2 = V(limit * limit);
    V most = zero, slid = zero, across = zero;
    unsigned long long strays = 0;
    for (int k = first; k < last; k += W) {
        R rows[6][W];
        for (int l = 0; l < W; ++l) {
            // the second node is read from its end, so that nothing behind the last is touched
            const int s = k + l < last ? k + l : last - 1;
            const long long at = 3ll * segment_node.data[s];
            const T* const from[3] = {(const T*)list_pos.data + at, (const T*)node_pos.data + at,
                                      (const T*)node_back.data + at};
            for (int n = 0; n < 3; ++n) {
                rows[2 * n][l] = load(from[n]);
                rows[2 * n + 1][l] = load(from[n] + 2).yzww;
            }
        }
        const V3 from = transposed(rows[0]), listed = transposed(rows[1]) - from;
        const V3 ends[2] = {transposed(rows[2]), transposed(rows[3])};
        const V3 back[2] = {transposed(rows[4]), transposed(rows[5])};
        const V length = __builtin_elementwise_sqrt(listed.dot(listed));
        V longer;
        for (int l = 0; l < W; ++l) {
            const int s = k + l < last ? k + l : last - 1;
            longer[l] = segment_extension.shape[0] > 0 ? segment_extension.data[s] : extension;
        }
        const V beyond = longer / length;
        const V3 start = origin + times(affine, from - origin), axis = times(affine, listed);
        const V inverse = one / axis.dot(axis);
        V moved2 = zero, off_most = zero, beyond_most = zero, beside_most = zero;
        M out = zero > one;
        for (int end = 0; end < 2; ++end) {
            const V3 apart = ends[end] - start;
            const V s = apart.dot(axis) * inverse;
            V nearest = s > -beyond ? s : -beyond;
            nearest = nearest < one + beyond ? nearest : one + beyond;
            const V3 away = apart - axis * nearest, beside = apart - axis * s;
            const V off = away.dot(away);
            out |= ~(off <= limit2);
            off_most = larger(off, off_most);
            beyond_most = larger(larger(-s, s - one) * length, beyond_most);
            beside_most = larger(beside.dot(beside), beside_most);
            const V3 moved = ends[end] - origin - times(push, back[end] - origin);
            moved2 = larger(moved.dot(moved), moved2);
        }
        most = larger(off_most, most);
        // what strays do is not what the list is chosen for, where they may
        const M told = spares != 0 ? ~out : one > zero;
        slid = told ? larger(beyond_most, slid) : slid;
        across = told ? larger(beside_most, across) : across;
        const V moved = __builtin_elementwise_sqrt(moved2);
        for (int l = 0; l < W && k + l < last; ++l)
            segment_moved.data[k + l] = moved[l] + segment_shift.data[k + l]
                + shift_again.data[k + l];
        for (int l = 0; l < W && k + l < last; ++l)
            strays |= (unsigned long long)(out[l] != 0) << (k + l - first);
    }
    if (limit < T(0)) strays = ~0ull;
    const V found[3] = {slid, across, most};
    T largest[3];
    for (int n = 0; n < 3; ++n) {
        largest[n] = T(0);
        for (int l = 0; l < W; ++l)
            largest[n] = found[n][l] > largest[n] ? found[n][l] : largest[n];
    }
    short_out.data[at_out] = strays;
    use_out.data[at_out][0] = largest[0];
    use_out.data[at_out][1] = wp::sqrt(largest[1]);
    use_out.data[at_out][2] = limit;
    share_out.data[at_out] = wp::sqrt(largest[2]) / (limit > T(1e-30) ? limit : T(1e-30));
"""


def bound_text(name: str) -> str:
    """The block in the given precision."""
    return row_lanes(name) + TEXT
