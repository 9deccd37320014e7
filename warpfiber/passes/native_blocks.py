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
from warpfiber.passes.native_factor import FACTOR_TEXTS

MOST_NODES = 512
FACTORS = 29  # numbers of a node


# `ready_factors(lanes, fiber)`: of fibers of one group, then
# `fill(lanes, fiber, row, side, column)`: columns of the ends `side` of `row` on these fibers, of
# lanes whose `column` is somewhere.
# With friction `kind` behind: 0 along the normal, 1 and 2 along the directions of the plane.
# `turn(v)` transposes W vectors.
def fill_text(lanes: int, friction: bool = False, found: bool = False) -> str:
    """C++ text; `found`: factors are found again by axes (`native_factor`), not read."""
    parts = {
        "KINDS": ", const int* kind" if friction else "",
        "LANE_PUSH": PULLS if friction else PUSHES,
        "NODE_PUSH": PULLED if friction else PUSHED,
        "LANE_SPIN": SPUN if friction else "",
        "CHI": repr(CHI),
        "FACTORS_OF": FOUND if found else GATHERED,
        **FACTOR_TEXTS,
        "TURN": transpose(lanes),
        "MOST_NODES": str(MOST_NODES),
    }
    text = FACTORS_TEXT + FILL
    for key, value in parts.items():
        text = text.replace(key, value)
    return text


PUSHES = """
        V3 push = none;
        for (int l = 0; l < lanes; ++l) {
            const Row& from = rows[row[l]];
            const bool own = side[l] == 0;
            at[l] = T(((own ? from.at_i : from.at_j) - d.fiber_at.data[fiber[l]]) / 4);
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
            at[l] = T(((own ? from.at_i : from.at_j) - d.fiber_at.data[fiber[l]]) / 4);
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
                const V first = at == V(T(k)) ? h : V(T(0));
                const V second = at == V(T(k - 1)) ? h : V(T(0));
                V3 r = near * first + far * second;"""
# Angle of the fiber about its axis, in place of the impulse before its first node.
SPUN = """
        const T carried = weight * T(segments) + T(2) * weight_excess;
        b[0] = torque * (h / (T(CHI) * group.torque * carried));"""


# Of every node in turn, from the rows of `chain_solve`, W numbers of all lanes at a time.
GATHERED = """
        for (int k = 0; k <= segments; ++k) {
            const T* from[W];
            for (int l = 0; l < W; ++l)
                from[l] = (const T*)(factors.data
                    + (long long)row_stride * fiber[l < lanes ? l : 0] + k);
            for (int next = 0; next < numbers_of; next += W) {
                const int first = next < numbers_of - W ? next : numbers_of - W;
                V r[W];
                for (int l = 0; l < W; ++l) r[l] = *(const U*)(from[l] + first);
                TURN
                for (int n = 0; n < W; ++n) ((V*)(factor + k))[first + n] = r[n];
            }
        }
"""
FOUND = """
        const long long stride = (4 * row_stride + W - 1) / W * W;
        for (int k = 0; k <= segments; k += W / 4) {
            V r[W];
            for (int l = 0; l < W; ++l)
                r[l] = *(const U*)(axes.data + stride * fiber[l < lanes ? l : 0] + 4 * k);
            TURN
            for (int n = 0; n < W / 4 && k + n <= segments; ++n) {
                factor[k + n].axis = V3{r[4 * n], r[4 * n + 1], r[4 * n + 2]};
                factor[k + n].impulse = r[4 * n + 3];
            }
        }
        const T h = numbers.data[6 * of];
        const auto& g = d.groups.data[of];
        const V none = V(T(0)), one = V(T(1));
        const V3 nothing = V3{none, none, none};
        FACTOR_NUMBERS
        FACTOR_BEGIN
        for (int k = 0; k <= segments; ++k) {
            const V3 n = factor[k].axis;
            const V rho = factor[k].impulse;
            FACTOR_NODE
            factor[k] = Factor{pd, po, q, s, l0, l1, l2, lt, nothing, none, n};
            FACTOR_NEXT
        }
"""
FACTORS_TEXT = """
    struct Factor { V3 d, o, q; V s; V3 l0, l1, l2, lt, move; V impulse; V3 axis; };
    constexpr int numbers_of = sizeof(Factor) / sizeof(V);
    static_assert(sizeof(factors.data[0]) == numbers_of * sizeof(T), "");
    auto factors_at = [&](int f) -> Factor* {
        const long long whole = gathered.shape[0] / d.parts;
        T* const from = gathered.data + d.fiber_part.data[f] * whole;
        const auto over = (unsigned long long)from % sizeof(V);
        return (Factor*)((char*)from + (over ? sizeof(V) - over : 0));
    };
    auto paces = [&](int lanes, const int* fiber) -> V {
        V pace;
        for (int l = 0; l < W; ++l) pace[l] = fiber_pace.data[fiber[l < lanes ? l : 0]];
        return pace;
    };
    auto ready_factors = [&](int lanes, const int* fiber) __attribute__((noinline)) {
        const int of = d.fiber_group.data[fiber[0]], segments = d.groups.data[of].segments;
        Factor* const factor = factors_at(fiber[0]);
        const V pace = paces(lanes, fiber);
FACTORS_OF    };
"""
FILL = """
    auto fill = [&](int lanes, const int* fiber, const int* row, const int* side,
            T* const* columnKINDS) __attribute__((noinline)) {
        const int of = d.fiber_group.data[fiber[0]];
        const auto& group = d.groups.data[of];
        const int segments = group.segments;
        const T* const number = numbers.data + 6 * of;
        const Factor* const factor = factors_at(fiber[0]);
        const V pace = paces(lanes, fiber);
        const V h = pace * number[0], kappa = pace * number[1];
        const T drag_end = number[2], drag_inner = number[3];
        const V drag_off = V(number[4]);
        const T strength = number[5];
        const T weight = group.weight, weight_excess = group.weight_excess;
        V3 z[MOST_NODES];
        V b[MOST_NODES];
        auto times = [](const Factor& row, const V3& v) -> V3 {
            const V3 &d = row.d, &o = row.o;
            return V3{d.x * v.x + o.x * v.y + o.y * v.z, o.x * v.x + d.y * v.y + o.z * v.z,
                      o.y * v.x + o.z * v.y + d.z * v.z};
        };
        const V3 none = same3(T(0), T(0), T(0));
        V at = V(T(-9)), share = V(T(0));LANE_PUSH
        for (int again = 0; again < 2; ++again) {
            V3 y1 = none, v1 = none, v2 = none, couple = none, z0 = none, z1 = none;
            V yt1 = V(T(0));
            if (again == 1) z1 = z[0];
            for (int k = 0; k <= segments; ++k) {
                const Factor& row = factor[k];
NODE_PUSH
                if (again == 1) {
                    const V drag = V(k == 0 || k == segments ? drag_end : drag_inner);
                    r = r + z1 * drag + z0 * drag_off + couple;
                    if (k < segments) {
                        const V3 z2 = z[k + 1], turn = z2 - z1;
                        const T s = strength * (weight + (k == 0 ? weight_excess : T(0))
                            + (k == segments - 1 ? weight_excess : T(0)));
                        couple = (turn - row.axis * row.axis.dot(turn)) * V(s);
                        r = r + z2 * drag_off - couple;
                        z0 = z1;
                        z1 = z2;
                    }
                }
                V3 y = r - V3{row.l0.dot(y1), row.l1.dot(y1), row.l2.dot(y1)};
                y = y - row.lt * yt1 - v2 * kappa;
                const V yt = k == 0 ? V(T(0)) : factor[k - 1].axis.dot(v1);
                v2 = v1;
                v1 = times(row, y) + row.q * yt;
                z[k] = v1;
                b[k] = row.q.dot(y) + yt * row.s;
                y1 = y;
                yt1 = yt;
            }
            V3 behind = none, beyond = none;
            V impulse = V(T(0));
            for (int k = segments; k >= 0; --k) {
                const Factor& row = factor[k];
                V3 p = none;
                if (k < segments) p = row.axis * impulse - beyond * kappa;
                V3 x = z[k] + times(row, p);
                V pulled = b[k] + row.q.dot(p);
                if (k < segments) {
                    const Factor& next = factor[k + 1];
                    x = x - next.l0 * behind.x - next.l1 * behind.y - next.l2 * behind.z;
                    pulled = pulled - next.lt.dot(behind);
                }
                impulse = pulled;
                beyond = behind;
                behind = x;
                z[k] = x;
                b[k] = pulled;
            }
        }
LANE_SPIN
        const int size = size_of(fiber[0]);
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
            for (int l = 0; l < lanes; ++l)
                if (column[l] != nullptr) *(U*)(column[l] + 4 * k) = r[l];
        }
    };
"""
