"""One step of SDIRK2 of flexible fibers in vectors: a lane is a fiber, for the CPU.

Source: `chain_solve`, which it repeats term by term; fibers of one group that stand one behind the
    other share a block, whose lanes all have the same number of nodes.
Symbols: as in `chain_solve`; T, W, V, M, V3 from `native.lane_types`.
Limits: no held nodes; fibers of fewer than MOST_NODES nodes (stack). Where a pivot of one lane is
    not positive the block repeats the stage, with that lane's negative tensions out of the matrix.
    Additions and multiplications may be fused: equal to `chain_solve` to rounding.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import BAD_FIBER, HALT, TORN, precision
from warpfiber.passes.chain_solve import CHI
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.native import LANES, lane_types, transpose
from warpfiber.passes.native_factor import FACTOR_TEXTS
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.passes.precision import group_struct

MOST_NODES = 64

STEP = """
    struct Node { V3 d, o, q, l0, l1, l2, lt, move, n; V s, impulse, rho; };
    static_assert(sizeof(rows.data[0]) == 29 * sizeof(T), "");
    Node stored[MOST_NODES];
    V3 position[MOST_NODES], motion[MOST_NODES], load[MOST_NODES];
    V tension_at[MOST_NODES];
    const auto& g = groups.data[fiber_group.data[fiber]];
    const int segments = g.segments, nodes = segments + 1;
    const long long first = fiber_node_start.data[fiber], lines = first - fiber;
    const V none = V(T(0)), one = V(T(1));
    const V3 nothing = V3{none, none, none};
    auto lane_of = [&](int l) -> long long { return l < own ? l : own - 1; };
    auto gather = [&](const auto& array, int k) -> V3 {
        V3 v;
        for (int l = 0; l < W; ++l) {
            const auto& p = array.data[first + lane_of(l) * nodes + k];
            v.x[l] = p[0];
            v.y[l] = p[1];
            v.z[l] = p[2];
        }
        return v;
    };
    V pace;
    for (int l = 0; l < W; ++l) pace[l] = fiber_pace.data[fiber + lane_of(l)];
    for (int k = 0; k < nodes; ++k) {
        position[k] = gather(node_pos, k);
        motion[k] = gather(node_velocity, k);
        if (LOADED) load[k] = gather(node_load, k);
        for (int l = 0; l < W && k < segments; ++l)
            tension_at[k][l] = tension.data[lines + lane_of(l) * segments + k];
    }
    for (long long i = first; keeps != 0 && i < first + (long long)own * nodes; ++i) {
        node_back.data[i] = node_pos.data[i];
        velocity_back.data[i] = node_velocity.data[i];
    }
    for (long long i = lines; i < lines + (long long)own * segments; ++i)
        tension_back.data[i] = tension.data[i];

    const T dt = T(step_size.data[0]), h = T(CHI) * dt;
FACTOR_NUMBERS    M clipped = M(clips != 0 ? -1 : 0);
    V longest = none, furthest = none;
    for (int stage = 0; stage < 2;) {
        const V a = V(stage == 0 ? h : T(1.0 / CHI)), b = V(stage == 0 ? h : T(1));
        const auto& G = stage_gradient.data[stage];
        auto velocity = [&](const V3& x) -> V3 {
            const V3 r = x - same3(flow_origin[0], flow_origin[1], flow_origin[2]);
            return V3{G.data[0][0] * r.x + G.data[0][1] * r.y + G.data[0][2] * r.z,
                      G.data[1][0] * r.x + G.data[1][1] * r.y + G.data[1][2] * r.z,
                      G.data[2][0] * r.x + G.data[2][1] * r.y + G.data[2][2] * r.z};
        };
        const T turn = T(0.5) * h;
        const V3 spin = same3(turn * (G.data[2][1] - G.data[1][2]),
            turn * (G.data[0][2] - G.data[2][0]), turn * (G.data[1][0] - G.data[0][1]));
        const T sinks = h / g.drag;
        const V3 settling =
            same3(sinks * g.body_force[0], sinks * g.body_force[1], sinks * g.body_force[2]);
        auto guess = [&](int k) -> V3 { return position[k] + motion[k] * a; };
        auto excess = [&](const V3& x, const V3& w) -> V3 {
            return velocity(x) * V(h) + settling - w;
        };
        V3 x0 = guess(0), x1 = guess(1), w0 = motion[0] * b, w1 = motion[1] * b;
        V3 e0 = excess(x0, w0), e1 = excess(x1, w1), edge = x1 - x0;
        V3 e_before = nothing, c_before = nothing, c_here = nothing, couple_before = nothing;
        V gap_before = none;
FACTOR_BEGIN        V3 v1 = nothing, v2 = nothing;
        V vt1 = none, least = one;
        for (int k = 0; k <= segments; ++k) {
            V3 n = nothing, couple = nothing, c_after = nothing, e_after = nothing;
            V3 edge_after = nothing, x2 = nothing, w2 = nothing, e2 = nothing;
            V rho = none, gap = none;
            if (k < segments) {
                const V length = __builtin_elementwise_sqrt(edge.dot(edge)), inverse = one / length;
                n = edge * inverse;
                const T beads = g.weight + (k == 0 ? g.weight_excess : T(0))
                    + (k == segments - 1 ? g.weight_excess : T(0));
                V pull = tension_at[k];
                pull = clipped && pull < none ? none : pull;
                const V strength = V(g.torque * beads);
                rho = (strength * inverse + h_force * pull) * inverse;
                const V3 dv = w1 - w0;
                couple = (spin.cross(n) - (dv - n * n.dot(dv)) * inverse) * (strength * inverse);
                gap = V(g.rest) - length;
                e_after = e1;
                if (k + 1 < segments) {
                    x2 = guess(k + 2);
                    w2 = motion[k + 2] * b;
                    e2 = excess(x2, w2);
                    edge_after = x2 - x1;
                    c_after = edge_after - edge;
                }
            }
FACTOR_NODE            V3 r = e0 * drag + (e_before + e_after) * drag_off + couple_before - couple;
            r = r - (c_before - c_here * V(T(2)) + c_after) * kappa;
            if (LOADED) r = r + load[k] * h_force;
            V sign = d.x < zz ? d.x : zz;
            const V other = det < whole ? det : whole;
            sign = sign < other ? sign : other;
            sign = det == det && whole == whole ? sign : V(T(-1));
            least = sign >= least ? least : sign;

            V3 y = r - V3{w_0.dot(v1), w_1.dot(v1), w_2.dot(v1)} - wt * vt1 - v2 * kappa;
            const V yt = gap_before + n_before.dot(v1);
            const V3 v = sym(pd, po, y) + q * yt;
            const V vt = q.dot(y) + yt * s;
            stored[k] = Node{pd, po, q, l0, l1, l2, lt, v, n, s, vt, rho};

FACTOR_NEXT            v2 = v1;
            v1 = v;
            vt1 = vt;
            e_before = e0;
            e0 = e1;
            e1 = e2;
            w0 = w1;
            w1 = w2;
            x1 = x2;
            edge = edge_after;
            c_before = c_here;
            c_here = c_after;
            couple_before = couple;
            gap_before = gap;
        }
        const M failed = !(least > none) && !clipped;
        if (any(failed)) {
            clipped = clipped || failed;
            continue;
        }
        V3 z1 = nothing, z2 = nothing, x_after = nothing;
        V impulse = none;
        for (int k = segments; k >= 0; --k) {
            const Node& row = stored[k];
            const V3 push = row.n * impulse - z2 * kappa;
            V3 z = row.move + sym(row.d, row.o, push);
            V pulled = row.impulse + row.q.dot(push);
            if (k < segments) {
                const Node& behind = stored[k + 1];
                z = z - behind.l0 * z1.x - behind.l1 * z1.y - behind.l2 * z1.z;
                pulled = pulled - behind.lt.dot(z1);
            }
            impulse = pulled;
            z2 = z1;
            z1 = z;
            if (k > 0) tension_at[k - 1] = impulse / h_force;
            const V3 m = motion[k];
            const V3 move = m * a + z;
            if (stage == 0) {
                motion[k] = move;
                continue;
            }
            const V3 x = position[k] + move;
            motion[k] = (m * b + z) * V(T(1) / h);
            position[k] = x;
            if (k < segments) {
                const V3 apart = x_after - x;
                const V d2 = apart.dot(apart);
                longest = d2 <= longest ? longest : d2;
            }
            x_after = x;
            const V far2 = z.dot(z);
            furthest = far2 <= furthest ? furthest : far2;
        }
        ++stage;
        clipped = M(clips != 0 ? -1 : 0);
    }
    for (int l = 0; l < own; ++l) {
        const long long from = first + (long long)l * nodes;
        for (int k = 0; k < nodes; ++k) {
            const V3 &x = position[k], &v = motion[k];
            node_pos.data[from + k] = {x.x[l], x.y[l], x.z[l]};
            node_velocity.data[from + k] = {v.x[l], v.y[l], v.z[l]};
            if (k < segments) tension.data[lines + (long long)l * segments + k] = tension_at[k][l];
        }
        T error = wp::sqrt(furthest[l]) / (T(segments) * g.rest);
        if (!(longest[l] < T(TEAR * TEAR) * g.rest * g.rest)) {
            error = T(1.0e30);
            if (keeps < 2) {
                status.data[TORN_AT] = 1;
                status.data[BAD_AT] = fiber + l;
            }
        }
        fiber_error.data[fiber + l] = error;
    }
    // W numbers of all lanes at a time
    for (int k = 0; k < nodes && axes_stride > 0; k += W / 4) {
        V r[W];
        for (int n = 0; n < W / 4; ++n) {
            const Node& from = stored[k + n < nodes ? k + n : segments];
            r[4 * n] = from.n.x;
            r[4 * n + 1] = from.n.y;
            r[4 * n + 2] = from.n.z;
            r[4 * n + 3] = from.rho;
        }
        TURN
        for (int l = 0; l < own; ++l)
            *(U*)(axes.data + (long long)axes_stride * (fiber + l) + 4 * k) = r[l];
    }
    for (int l = 0; l < own; ++l) {
        if (row_stride <= 0) continue;
        for (int k = 0; k < nodes; ++k) {
            const Node& from_node = stored[k];
            T* const to = (T*)&rows.data[(long long)row_stride * (fiber + l) + k];
            const V3* const parts[9] = {&from_node.d, &from_node.o, &from_node.q, &from_node.l0,
                &from_node.l1, &from_node.l2, &from_node.lt, &from_node.move, &from_node.n};
            const int place[9] = {0, 3, 6, 10, 13, 16, 19, 22, 26};
            for (int p = 0; p < 9; ++p) {
                to[place[p]] = parts[p]->x[l];
                to[place[p] + 1] = parts[p]->y[l];
                to[place[p] + 2] = parts[p]->z[l];
            }
            to[9] = from_node.s[l];
            to[25] = from_node.impulse[l];
        }
    }
"""


def chain_blocks(name: str, fiber_group: np.ndarray) -> np.ndarray:
    """First fibers of the blocks, and their number at last: runs of a group of W at most."""
    lanes = LANES[precision(name).name]
    begins = np.flatnonzero(np.diff(fiber_group, prepend=-1))
    ends = np.append(begins[1:], len(fiber_group))
    blocks = [np.arange(begin, end, lanes) for begin, end in zip(begins, ends, strict=True)]
    return np.append(np.concatenate(blocks), len(fiber_group)).astype(np.int32)


@cache
def make_native_chain(name: str, loaded: bool = False) -> Any:
    """Kernel `native_chain_step` over blocks: as `chain_step` of two stages; see its arguments.

    `row_stride` 0: no rows are left; `axes_stride` > 0: axes of every node, see `native_factor`.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    Row = elimination_row(name)
    text = STEP
    for key, value in FACTOR_TEXTS.items():
        text = text.replace(key, value)
    for key, value in {
        "MOST_NODES": MOST_NODES,
        "LOADED": str(loaded).lower(),
        "TEAR": repr(TEAR_STRETCH),
        "TORN_AT": TORN,
        "BAD_AT": BAD_FIBER,
        "CHI": repr(CHI),
        "TURN": transpose(LANES[name]),
    }.items():
        text = text.replace(key, str(value))

    @wp.func_native(lane_types(name) + text)
    def step_block(
        fiber: wp.int32,
        own: wp.int32,
        keeps: wp.int32,
        clips: wp.int32,
        row_stride: wp.int32,
        axes_stride: wp.int32,
        flow_origin: vec3,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        stage_gradient: wp.array(dtype=mat33),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=Row),
        axes: wp.array(dtype=real),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
        tension_back: wp.array(dtype=real),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        fiber_error: wp.array(dtype=real),
        node_load: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def native_chain_step(
        offset: wp.int32,
        block_start: wp.array(dtype=wp.int32),
        keeps: wp.int32,
        clips: wp.int32,
        row_stride: wp.int32,
        axes_stride: wp.int32,
        flow_origin: vec3,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        stage_gradient: wp.array(dtype=mat33),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=Row),
        axes: wp.array(dtype=real),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
        tension_back: wp.array(dtype=real),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        fiber_error: wp.array(dtype=real),
        node_load: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        block = wp.tid() + offset
        step_block(
            block_start[block],
            block_start[block + 1] - block_start[block],
            keeps,
            clips,
            row_stride,
            axes_stride,
            flow_origin,
            step_size,
            fiber_pace,
            stage_gradient,
            groups,
            fiber_node_start,
            fiber_group,
            rows,
            axes,
            node_pos,
            node_velocity,
            tension,
            tension_back,
            node_back,
            velocity_back,
            fiber_error,
            node_load,
            status,
        )

    return native_chain_step
