"""The node sweep of `nodes` for the CPU: one block of fibers of one group at a time, SIMD.

A lane is a fiber. The block's positions and velocities are transposed from the state arrays into a
scratch of vectors on the stack, the two walks of `nodes` run on all lanes at once, and the fibers
that are not torn are transposed back. Nothing in a lane depends on the other lanes, so it does not
matter which fibers share a block. The work array `node_force` is not written.

Laws: those of `nodes`, repeated. theta / sin(theta) is the series of `laws.bending` up to a right
    angle and (pi - theta') / sin(theta) beyond, with theta' = pi - theta from the same series.
Limits: closures `none` and `consistent`; fibers of up to MOST_NODES nodes (stack); sums are in
    another order than in `nodes` and multiplications and additions are fused: equal to rounding.
"""

from functools import cache

import numpy as np
import warp as wp

from warpfiber.laws.bending import SMALLEST_SINE, bending_series
from warpfiber.laws.repulsion import RANGE
from warpfiber.model import BAD_FIBER, EXPIRED, HALT, STRETCHED, TORN, Model, precision
from warpfiber.passes.native import LANES, lane_types, transpose
from warpfiber.passes.nodes import TEAR_STRETCH, NodeFeatures
from warpfiber.passes.precision import group_struct

MOST_NODES = 512
# A block costs about as much as this many fibers of the plain sweep.
FIBERS_PER_BLOCK = 3
# Terms of the bending series up to a right angle, multiples of four: errors 2e-17 and 3e-10.
SERIES_TERMS = {"float32": 12, "float64": 24}


def fiber_blocks(fiber_group: np.ndarray, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Fibers (B, lanes) of every block, all of one group, and how many of them (B,) are its own.

    The last fiber of a group fills the lanes that are left over.
    """
    rows, counts = [], []
    for group in np.unique(fiber_group):
        mine = np.flatnonzero(fiber_group == group)
        for begin in range(0, len(mine), lanes):
            part = mine[begin : begin + lanes]
            rows.append(np.concatenate([part, np.full(lanes - len(part), mine[-1])]))
            counts.append(len(part))
    return np.asarray(rows, dtype=np.int32), np.asarray(counts, dtype=np.int32)


def native_nodes_apply(model: Model, features: NodeFeatures) -> bool:
    """Whether the native sweep can do this model and is the faster one."""
    if not model.device.startswith("cpu") or features.closure == "paper":
        return False
    if max(row["segments"] for row in model.group_rows) >= MOST_NODES:
        return False
    counts = np.bincount(model.host["fiber_group"])
    blocks = int(np.ceil(counts / LANES[model.precision.name]).sum())
    return model.fiber_count >= FIBERS_PER_BLOCK * blocks


def _constants(name: str, features: NodeFeatures) -> str:
    """Features and numbers that are fixed when the sweep is compiled."""
    flags = {
        "HAS_PAIRS": features.pairs != "none",
        "HAS_ARMS": features.pairs == "arms",
        "HAS_GRAVITY": features.gravity,
        "HAS_WALLS": any(features.walls),
        "IS_CONSISTENT": features.closure == "consistent",
    }
    lines = [f"constexpr bool {key} = {str(value).lower()};" for key, value in flags.items()]
    walls = ", ".join(str(value).lower() for value in features.walls)
    lines.append(f"constexpr bool WALL[3] = {{{walls}}};")
    numbers = {
        "TEAR": TEAR_STRETCH,
        "WALL_RANGE": RANGE,
        "SMALLEST_SINE": SMALLEST_SINE,
        "PI": np.pi,
    }
    lines += [f"constexpr T {key} = T({float(value)!r});" for key, value in numbers.items()]
    terms = SERIES_TERMS[name]
    series = ", ".join(f"T({value!r})" for value in bending_series(1.0, terms))
    lines.append(f"constexpr int TERMS = {terms};")
    lines.append(f"constexpr T SERIES[TERMS] = {{{series}}};")
    slots = {
        "SLOT_EXPIRED": EXPIRED,
        "SLOT_TORN": TORN,
        "SLOT_STRETCHED": STRETCHED,
        "SLOT_HALT": HALT,
        "SLOT_BAD_FIBER": BAD_FIBER,
    }
    lines += [f"constexpr int {key} = {value};" for key, value in slots.items()]
    return "\n".join(lines)


# Between the state arrays (three numbers per node, fibers anywhere) and the scratch (three vectors
# per node): squares of W numbers of W fibers. The last square overlaps the one before.
_TRANSFER = """
    auto load = [&](V* to, const T* from) {
        if (size < W) {
            for (int l = 0; l < W; ++l)
                for (int c = 0; c < size; ++c)
                    ((T*)(to + c))[l] = from[3 * first[l] + c];
            return;
        }
        for (int next = 0; next < size; next += W) {
            const int at = next < size - W ? next : size - W;
            V r[W];
            #pragma unroll
            for (int l = 0; l < W; ++l) r[l] = *(const U*)(from + 3 * first[l] + at);
            TRANSPOSE
            #pragma unroll
            for (int l = 0; l < W; ++l) to[at + l] = r[l];
        }
    };
    auto store = [&](T* to, const V* from, unsigned keep) {
        if (size < W) {
            for (int l = 0; l < W; ++l)
                if (keep >> l & 1)
                    for (int c = 0; c < size; ++c) to[3 * first[l] + c] = ((const T*)(from + c))[l];
            return;
        }
        for (int next = 0; next < size; next += W) {
            const int at = next < size - W ? next : size - W;
            V r[W];
            #pragma unroll
            for (int l = 0; l < W; ++l) r[l] = from[at + l];
            TRANSPOSE
            #pragma unroll
            for (int l = 0; l < W; ++l)
                if (keep >> l & 1) *(U*)(to + 3 * first[l] + at) = r[l];
        }
    };
"""

_GATHER = """
    for (int c = 0; c < size; ++c) f[c] = V(T(0));
    if constexpr (HAS_PAIRS) {
        auto add = [&](int l, int k, int segment, T sign, T share, const T* arm) {
            T* to = (T*)(f + 3 * segment) + l;
            const T* force = (const T*)pair_force.data + 3 * k;
            #pragma unroll
            for (int c = 0; c < 3; ++c) {
                const T whole = sign * force[c];
                const T second = HAS_ARMS ? sign * arm[3 * k + c] : share * whole;
                to[c * W] += whole - second;
                to[(3 + c) * W] += second;
            }
        };
        const unsigned char* acts = pair_acts.data;
        const T* closest = (const T*)pair_closest.data;
        for (int l = 0; l < own; ++l) {
            const int begin = first[l] - fiber[l];
            const int end = begin + segments;
            for (int k = out_start.data[begin]; k < out_start.data[end]; ++k)
                if (acts[k])
                    add(l, k, pair_i.data[k] - begin, T(1), HAS_ARMS ? T(0) : closest[2 * k],
                        (const T*)pair_arm_i.data);
            for (int slot = in_start.data[begin]; slot < in_start.data[end]; ++slot) {
                const int k = in_pair.data[slot];
                if (acts[k])
                    add(l, k, pair_j.data[k] - begin, T(-1), HAS_ARMS ? T(0) : closest[2 * k + 1],
                        (const T*)pair_arm_j.data);
            }
        }
    }
"""

_FORCES = """
    auto bending_factor = [&](const V3& n0, const V3& n1, V cosine) -> V {
        const M blunt = cosine < T(0);
        const V y = T(1) - (blunt ? -cosine : cosine);
        const V y2 = y * y, y4 = y2 * y2;
        V s0 = V(SERIES[TERMS - 4]), s1 = V(SERIES[TERMS - 3]);
        V s2 = V(SERIES[TERMS - 2]), s3 = V(SERIES[TERMS - 1]);
        #pragma unroll
        for (int t = TERMS - 8; t >= 0; t -= 4) {
            s0 = s0 * y4 + SERIES[t];
            s1 = s1 * y4 + SERIES[t + 1];
            s2 = s2 * y4 + SERIES[t + 2];
            s3 = s3 * y4 + SERIES[t + 3];
        }
        V factor = (s0 + s1 * y) + (s2 + s3 * y) * y2;
        if (__builtin_expect(any(blunt), 0)) {
            const V3 normal = n0.cross(n1);
            const V sine = __builtin_elementwise_sqrt(normal.dot(normal));
            const V held = sine > SMALLEST_SINE ? sine : V(SMALLEST_SINE);
            factor = blunt ? (PI - factor * sine) / held : factor;
        }
        return factor;
    };
    auto wall_push = [&](T y) -> T {
        if (y > WALL_RANGE * g.radius) return T(0);
        return strength * wp::exp(-decay * (y / g.radius - T(1)));
    };
    auto wall_force = [&](const V3& x, V3& force) {
        #pragma unroll
        for (int axis = 0; axis < 3; ++axis) {
            if (!WALL[axis]) continue;
            const V at = axis == 0 ? x.x : axis == 1 ? x.y : x.z;
            V& push = axis == 0 ? force.x : axis == 1 ? force.y : force.z;
            const V low = at - wall_low[axis], high = wall_high[axis] - at;
            if (!any((low <= WALL_RANGE * g.radius) | (high <= WALL_RANGE * g.radius))) continue;
            for (int l = 0; l < W; ++l) push[l] += wall_push(low[l]) - wall_push(high[l]);
        }
    };
    const T* pivot = pivots.data + g.pivot_start;
    V3 y = same3(0, 0, 0);
    auto finish = [&](int k, V3 force) {
        if constexpr (HAS_WALLS) wall_force(get(x, k), force);
        if constexpr (IS_CONSISTENT) {
            y = (force - y * V(g.coupling)) * V(pivot[k]);
            force = y;
        }
        put(f, k, force);
    };
    const auto& L = gradient.data[0].data;
    const V3 spin = same3(
        T(0.5) * (L[2][1] - L[1][2]), T(0.5) * (L[0][2] - L[2][0]), T(0.5) * (L[1][0] - L[0][1]));
    V3 x0 = get(x, 0), v0 = get(v, 0), n0 = same3(0, 0, 0);
    V3 f_before = same3(0, 0, 0), f_here = get(f, 0);
    V inverse0 = V(T(0)), longest = V(T(0));
    M torn = V(T(1)) < T(0);
    for (int k = 0; k < segments; ++k) {
        const V3 x1 = get(x, k + 1), v1 = get(v, k + 1);
        const V3 edge = x1 - x0;
        const V d1 = __builtin_elementwise_sqrt(edge.dot(edge));
        const V inverse1 = T(1) / d1;
        const V3 n1 = edge * inverse1;
        torn |= ~(d1 < TEAR * g.rest);
        longest = d1 > longest ? d1 : longest;
        const T weight = g.weight + (k == 0 ? g.weight_excess : T(0))
            + (k == segments - 1 ? g.weight_excess : T(0));
        const V3 dv = v1 - v0;
        const V3 turning = (dv - n1 * n1.dot(dv)) * inverse1;
        const V3 couple = (spin.cross(n1) - turning) * (g.torque * weight * inverse1);
        const V3 push = couple - n1 * (g.stretching * (d1 - g.rest));
        f_here = f_here - push;
        V3 f_after = get(f, k + 1) + push;
        if (k > 0) {
            const V cosine = n0.dot(n1);
            const V moment = g.bending * bending_factor(n0, n1, cosine);
            const V3 after = (n0 - n1 * cosine) * (moment * inverse1);
            const V3 before = (n0 * cosine - n1) * (moment * inverse0);
            f_here = f_here - (before + after);
            f_after = f_after + after;
            finish(k - 1, f_before + before);
        }
        f_before = f_here;
        f_here = f_after;
        x0 = x1;
        v0 = v1;
        n0 = n1;
        inverse0 = inverse1;
    }
    finish(segments - 1, f_before);
    finish(segments, f_here);
    unsigned keep = own < 32 ? (1u << own) - 1u : ~0u;
    if (any(torn))
        for (int l = 0; l < own; ++l)
            if (torn[l]) {
                keep &= ~(1u << l);
                status.data[SLOT_TORN] = 1;
                status.data[SLOT_BAD_FIBER] = fiber[l];
            }
"""

_STEP = """
    const T half_drag = T(0.5) * dt * g.drag;
    const T least = g.mass > half_drag ? g.mass : half_drag;
    const T damped = g.mass > half_drag + least ? g.mass : half_drag + least;
    const T kick = dt / damped;
    const V3 origin = same3(flow_origin[0], flow_origin[1], flow_origin[2]);
    V furthest = V(T(0));
    T limit = T(0);
    T A[3][3];
    if constexpr (HAS_PAIRS) {
        T stretch = T(0);
        for (int row = 0; row < 3; ++row)
            for (int col = 0; col < 3; ++col) A[row][col] = T(deformation.data[0].data[row][col]);
        for (int row = 0; row < 3; ++row) {
            T norm = T(0);
            for (int col = 0; col < 3; ++col)
                norm += wp::abs(T(0.5) * (A[row][col] + A[col][row]) - (row == col ? T(1) : T(0)));
            stretch = norm > stretch ? norm : stretch;
        }
        limit = T(0.5) * (skin - stretch * list_reach);
        load(p, (const T*)list_pos.data);
    }
    for (int k = segments; k >= 0; --k) {
        V3 here = get(x, k), speed = get(v, k), force = get(f, k);
        if constexpr (IS_CONSISTENT) {
            if (k < segments) force = force - y * V(g.coupling * pivot[k]);
            y = force;
        }
        const V3 r = here - origin;
        const V3 u = {
            L[0][0] * r.x + L[0][1] * r.y + L[0][2] * r.z,
            L[1][0] * r.x + L[1][1] * r.y + L[1][2] * r.z,
            L[2][0] * r.x + L[2][1] * r.y + L[2][2] * r.z};
        V3 total = (u - speed) * V(g.drag) + force;
        if constexpr (HAS_GRAVITY)
            total = total + same3(g.body_force[0], g.body_force[1], g.body_force[2]);
        speed = speed + total * V(kick);
        here = here + speed * V(dt);
        put(v, k, speed);
        put(x, k, here);
        if constexpr (HAS_PAIRS) {
            const V3 q = get(p, k) - origin;
            const V3 carried = {
                A[0][0] * q.x + A[0][1] * q.y + A[0][2] * q.z,
                A[1][0] * q.x + A[1][1] * q.y + A[1][2] * q.z,
                A[2][0] * q.x + A[2][1] * q.y + A[2][2] * q.z};
            const V3 moved = (here - origin) - carried;
            const V far = moved.dot(moved);
            furthest = far > furthest ? far : furthest;
        }
    }
    if constexpr (HAS_PAIRS) {
        const M expired = furthest > (limit < T(0) ? T(-1) : limit * limit);
        const M stretched = longest > stretch_allowed * g.rest;
        if (any(expired | stretched))
            for (int l = 0; l < own; ++l) {
                if (!(keep >> l & 1)) continue;
                if (expired[l]) status.data[SLOT_EXPIRED] = 1;
                if (stretched[l]) status.data[SLOT_STRETCHED] = 1;
            }
    }
    store((T*)node_pos.data, x, keep);
    store((T*)node_velocity.data, v, keep);
"""

_SWEEP = (
    """
    const int* fiber = block_fiber.data + W * block;
    const int own = block_own.data[block];
    const auto g = groups.data[fiber_group.data[fiber[0]]];
    const int segments = g.segments;
    const int size = 3 * (segments + 1);
    int first[W];
    for (int l = 0; l < W; ++l) first[l] = fiber_node_start.data[fiber[l]];
    V* x = (V*)__builtin_alloca_with_align(4 * size * sizeof(V), 8 * sizeof(V));
    V* v = x + size;
    V* f = v + size;
    V* p = f + size;
    auto get = [](const V* a, int k) -> V3 { return V3{a[3 * k], a[3 * k + 1], a[3 * k + 2]}; };
    auto put = [](V* a, int k, const V3& b) {
        a[3 * k] = b.x;
        a[3 * k + 1] = b.y;
        a[3 * k + 2] = b.z;
    };
"""
    + _TRANSFER
    + """
    load(x, (const T*)node_pos.data);
    load(v, (const T*)node_velocity.data);
"""
    + _GATHER
    + _FORCES
    + _STEP
)


@cache
def make_native_node_sweep(name: str, features: NodeFeatures):
    """Kernel `native_node_sweep` over blocks of fibers."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    sweep = _SWEEP.replace("TRANSPOSE", transpose(LANES[name]))
    # one copy of the code, whatever calls it
    snippet = f"""
    auto sweep = [&]() __attribute__((noinline)) {{
    #pragma clang fp contract(fast)
    {lane_types(name)}
    {_constants(name, features)}
    if (status.data[SLOT_HALT] != 0) return;
    {sweep}
    }};
    sweep();
    """

    @wp.func_native(snippet)
    def sweep_block(
        block: wp.int32,
        dt: real,
        flow_origin: vec3,
        wall_low: vec3,
        wall_high: vec3,
        strength: real,
        decay: real,
        list_reach: real,
        skin: real,
        stretch_allowed: real,
        groups: wp.array(dtype=Group),
        pivots: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_closest: wp.array(dtype=vec2),
        pair_arm_i: wp.array(dtype=vec3),
        pair_arm_j: wp.array(dtype=vec3),
        list_pos: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        block_fiber: wp.array(dtype=wp.int32),
        block_own: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def native_node_sweep(
        offset: wp.int32,
        dt: real,
        flow_origin: vec3,
        wall_low: vec3,
        wall_high: vec3,
        strength: real,
        decay: real,
        list_reach: real,
        skin: real,
        stretch_allowed: real,
        groups: wp.array(dtype=Group),
        pivots: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_closest: wp.array(dtype=vec2),
        pair_arm_i: wp.array(dtype=vec3),
        pair_arm_j: wp.array(dtype=vec3),
        list_pos: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_force_out: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        block_fiber: wp.array(dtype=wp.int32),
        block_own: wp.array(dtype=wp.int32),
    ):
        sweep_block(
            wp.tid() + offset,
            dt,
            flow_origin,
            wall_low,
            wall_high,
            strength,
            decay,
            list_reach,
            skin,
            stretch_allowed,
            groups,
            pivots,
            fiber_node_start,
            fiber_group,
            gradient,
            deformation,
            out_start,
            in_start,
            in_pair,
            pair_acts,
            pair_force,
            pair_closest,
            pair_arm_i,
            pair_arm_j,
            list_pos,
            node_pos,
            node_velocity,
            status,
            pair_i,
            pair_j,
            block_fiber,
            block_own,
        )

    return native_node_sweep
