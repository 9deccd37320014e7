"""Motion of one flexible fiber by unit forces at its ends of rows, a SIMD vector of ends at a time.

A lane is an end with a unit force; the two solves of `chain_reply` run on all lanes at once. What
every lane leaves is turned into a column: four numbers of every node, its displacement and the
impulse of the segment before it.
Symbols: as in `chain_reply`; T, W, V, U, V3 from `native.lane_types`; z displacements and b
    impulses of the nodes, `at` the node before the end, `share` the part of the force on the next.
Limits: CPU only; fibers of up to MOST_NODES nodes (stack); sums are in another order than in
    `chain_reply` and multiplications and additions are fused: equal to rounding.
"""

from warpfiber.passes.chain_solve import CHI
from warpfiber.passes.native import transpose

MOST_NODES = 512


# `fill(f, lanes, row, side, column)`: columns of the ends `side` of `row`, one behind the other,
# of size_of(f) numbers each. With friction `kind` behind: 0 along the normal, 1 and 2 along the
# directions of the plane. `turn(v)` transposes W vectors.
def fill_text(lanes: int, friction: bool = False) -> str:
    """C++ text of `fill`."""
    parts = {
        "KINDS": ", const int* kind" if friction else "",
        "LANE_PUSH": PULLS if friction else PUSHES,
        "NODE_PUSH": PULLED if friction else PUSHED,
        "LANE_SPIN": SPUN if friction else "",
        "CHI": repr(CHI),
        "TURN": transpose(lanes),
        "MOST_NODES": str(MOST_NODES),
    }
    text = FILL
    for key, value in parts.items():
        text = text.replace(key, value)
    return text


PUSHES = """
        V3 push = none;
        for (int l = 0; l < lanes; ++l) {
            const Row& from = rows[row[l]];
            const bool own = side[l] == 0;
            at[l] = T(((own ? from.at_i : from.at_j) - d.fiber_at.data[f]) / 4);
            share[l] = own ? from.s : from.t;
            push.x[l] = own ? -from.normal[0] : from.normal[0];
            push.y[l] = own ? -from.normal[1] : from.normal[1];
            push.z[l] = own ? -from.normal[2] : from.normal[2];
        }"""
PUSHED = """
                const V part = at == V(T(k)) ? T(1) - share
                    : (at == V(T(k - 1)) ? share : V(T(0)));
                V3 r = push * (h * part);"""

# Forces on the surface: different ones on both nodes, and a torque about the axis.
PULLS = """
        V3 near = none, far = none;
        V torque = V(T(0));
        for (int l = 0; l < lanes; ++l) {
            const Row& from = rows[row[l]];
            const bool own = side[l] == 0;
            at[l] = T(((own ? from.at_i : from.at_j) - d.fiber_at.data[f]) / 4);
            const T part = own ? from.s : from.t;
            Pull pull = {own ? -from.normal : from.normal, Q{T(0), T(0), T(0), T(0)}, T(0)};
            const Rub& rub = rubs[row[l]];
            if (kind[l] > 0)
                pull = pull_of(row[l], side[l], kind[l] == 1 ? rub.first : rub.second);
            const Q before = (T(1) - part) * pull.whole - pull.couple;
            const Q behind = part * pull.whole + pull.couple;
            torque[l] = pull.torque;
            near.x[l] = before[0];
            near.y[l] = before[1];
            near.z[l] = before[2];
            far.x[l] = behind[0];
            far.y[l] = behind[1];
            far.z[l] = behind[2];
        }"""
PULLED = """
                const V first = at == V(T(k)) ? V(h) : V(T(0));
                const V second = at == V(T(k - 1)) ? V(h) : V(T(0));
                V3 r = near * first + far * second;"""
# Angle of the fiber about its axis, in place of the impulse before its first node.
SPUN = """
        const T carried = weight * T(segments) + T(2) * weight_excess;
        b[0] = torque * (h / (T(CHI) * group.torque * carried));"""


FILL = """
    auto fill = [&](int f, int lanes, const int* row, const int* side, T* columnKINDS)
            __attribute__((noinline)) {
        const int node = d.fiber_node_start.data[f];
        const int segments = d.fiber_node_start.data[f + 1] - node - 1;
        const int base = row_stride * f, of = d.fiber_group.data[f];
        const T* const number = numbers.data + 6 * of;
        const T pace = fiber_pace.data[f];
        const T h = pace * number[0], kappa = pace * number[1];
        const T drag_end = number[2], drag_inner = number[3];
        const T drag_off = number[4], strength = number[5];
        const auto& group = d.groups.data[of];
        const T weight = group.weight, weight_excess = group.weight_excess;
        V3 z[MOST_NODES];
        V b[MOST_NODES];
        auto times = [&](const auto& row, const V3& v) -> V3 {
            const auto& d = row.diagonal;
            const auto& o = row.off;
            return V3{d[0] * v.x + o[0] * v.y + o[1] * v.z, o[0] * v.x + d[1] * v.y + o[2] * v.z,
                      o[1] * v.x + o[2] * v.y + d[2] * v.z};
        };
        auto along = [](const auto& u, const V3& v) -> V {
            return u[0] * v.x + u[1] * v.y + u[2] * v.z;
        };
        auto same = [](const auto& u) -> V3 { return V3{V(u[0]), V(u[1]), V(u[2])}; };
        const V3 none = same3(T(0), T(0), T(0));
        V at = V(T(-9)), share = V(T(0));LANE_PUSH
        for (int again = 0; again < 2; ++again) {
            V3 y1 = none, v1 = none, v2 = none, couple = none, z0 = none, z1 = none;
            V yt1 = V(T(0));
            if (again == 1) z1 = z[0];
            for (int k = 0; k <= segments; ++k) {
                const auto& row = factors.data[base + k];
NODE_PUSH
                if (again == 1) {
                    const T drag = k == 0 || k == segments ? drag_end : drag_inner;
                    r = r + z1 * V(drag) + z0 * V(drag_off) + couple;
                    if (k < segments) {
                        const V3 z2 = z[k + 1], turn = z2 - z1;
                        const T s = strength * (weight + (k == 0 ? weight_excess : T(0))
                            + (k == segments - 1 ? weight_excess : T(0)));
                        couple = (turn - same(row.axis) * along(row.axis, turn)) * V(s);
                        r = r + z2 * V(drag_off) - couple;
                        z0 = z1;
                        z1 = z2;
                    }
                }
                V3 y = r - V3{along(row.l0, y1), along(row.l1, y1), along(row.l2, y1)};
                y = y - same(row.lt) * yt1 - v2 * V(kappa);
                const V yt = k == 0 ? V(T(0)) : along(factors.data[base + k - 1].axis, v1);
                v2 = v1;
                v1 = times(row, y) + same(row.q) * yt;
                z[k] = v1;
                b[k] = along(row.q, y) + yt * row.s;
                y1 = y;
                yt1 = yt;
            }
            V3 behind = none, beyond = none;
            V impulse = V(T(0));
            for (int k = segments; k >= 0; --k) {
                const auto& row = factors.data[base + k];
                V3 p = none;
                if (k < segments) p = same(row.axis) * impulse - beyond * V(kappa);
                V3 x = z[k] + times(row, p);
                V whole = b[k] + along(row.q, p);
                if (k < segments) {
                    const auto& next = factors.data[base + k + 1];
                    x = x - same(next.l0) * behind.x - same(next.l1) * behind.y
                        - same(next.l2) * behind.z;
                    whole = whole - along(next.lt, behind);
                }
                impulse = whole;
                beyond = behind;
                behind = x;
                z[k] = x;
                b[k] = whole;
            }
        }
LANE_SPIN
        const int size = size_of(f);
        for (int k = 0; 4 * k < size; k += W / 4) {
            V r[W];
            for (int n = 0; n < W / 4; ++n) {
                const bool there = k + n <= segments;
                r[4 * n] = there ? z[k + n].x : V(T(0));
                r[4 * n + 1] = there ? z[k + n].y : V(T(0));
                r[4 * n + 2] = there ? z[k + n].z : V(T(0));
                r[4 * n + 3] = there ? b[k + n] : V(T(0));
            }
            TURN
            for (int l = 0; l < lanes; ++l) *(U*)(column + (long long)l * size + 4 * k) = r[l];
        }
    };
"""
