"""C++ text of the SIMD node sweep: what one block of fibers does (see `native_nodes`).

The two walks and the laws of `nodes`, one lane per fiber. theta / sin(theta) is the series of
`laws.bending` up to a right angle and (pi - theta') / sin(theta) beyond, with theta' = pi - theta
from the same series.
Symbols: as in `nodes`; T, W, V, U, M, V3 from `native.lane_types`; x, v, f, p scratch of positions,
    velocities, forces (then A^-1 F) and positions at the last list build, three vectors per node.
"""

import math

from warpfiber.laws.bending import SMALLEST_SINE, bending_series
from warpfiber.laws.repulsion import RANGE
from warpfiber.model import BAD_FIBER, EXPIRED, HALT, TORN
from warpfiber.passes.native import LANES, lane_types, transpose
from warpfiber.passes.nodes import TEAR_STRETCH, NodeFeatures

# Terms of the bending series up to a right angle, multiples of four: errors 2e-17 and 3e-10.
SERIES_TERMS = {"float32": 12, "float64": 24}


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
        "PI": math.pi,
    }
    lines += [f"constexpr T {key} = T({float(value)!r});" for key, value in numbers.items()]
    terms = SERIES_TERMS[name]
    series = ", ".join(f"T({value!r})" for value in bending_series(1.0, terms))
    lines.append(f"constexpr int TERMS = {terms};")
    lines.append(f"constexpr T SERIES[TERMS] = {{{series}}};")
    slots = {
        "SLOT_EXPIRED": EXPIRED,
        "SLOT_TORN": TORN,
        "SLOT_HALT": HALT,
        "SLOT_BAD_FIBER": BAD_FIBER,
    }
    lines += [f"constexpr int {key} = {value};" for key, value in slots.items()]
    return "\n".join(lines)


# Between the state arrays (three numbers per node, fibers anywhere) and the scratch (three vectors
# per node): squares of W numbers of W fibers. The last square overlaps the one before. A fiber of
# fewer than W numbers is read with what follows it, and written in a row of fibers so that the next
# one overwrites what does not belong to it; where that is impossible, number by number.
_TRANSFER = """
    const long array_end = 3 * (long)node_count;
    bool in_row = true;
    for (int l = 1; l < own; ++l) in_row &= first[l] == first[l - 1] + segments + 1;
    const long row_end = 3L * first[own - 1] + size;
    auto load = [&](V* to, const T* from) __attribute__((noinline)) {
        bool wide = true;
        for (int l = 0; l < W; ++l) wide &= 3L * first[l] + W <= array_end;
        if (size < W && !wide) {
            for (int l = 0; l < W; ++l)
                for (int c = 0; c < size; ++c) ((T*)(to + c))[l] = from[3L * first[l] + c];
            return;
        }
        for (int next = 0; next < size; next += W) {
            const int at = size < W ? 0 : next < size - W ? next : size - W;
            V r[W];
            #pragma unroll
            for (int l = 0; l < W; ++l) r[l] = *(const U*)(from + 3L * first[l] + at);
            TRANSPOSE
            #pragma unroll
            for (int l = 0; l < W; ++l) to[at + l] = r[l];
        }
    };
    auto store = [&](T* to, const V* from, unsigned keep) __attribute__((noinline)) {
        int done = 0;  // short fibers that are written
        if (size >= W || (in_row && keep == all)) {
            if (size < W)
                while (done < own && 3L * first[done] + W <= row_end) ++done;
            const unsigned wide = size < W ? (1u << done) - 1u : keep;
            for (int next = 0; next < size; next += W) {
                const int at = size < W ? 0 : next < size - W ? next : size - W;
                V r[W];
                #pragma unroll
                for (int l = 0; l < W; ++l) r[l] = from[at + l];
                TRANSPOSE
                #pragma unroll
                for (int l = 0; l < W; ++l)
                    if (wide >> l & 1) *(U*)(to + 3L * first[l] + at) = r[l];
            }
        }
        if (size < W)
            for (int l = done; l < own; ++l)
                if (keep >> l & 1)
                    for (int c = 0; c < size; ++c)
                        to[3L * first[l] + c] = ((const T*)(from + c))[l];
    };
"""

_GATHER = """
    for (int c = 0; c < size; ++c) f[c] = V(T(0));
    if constexpr (HAS_PAIRS) {
        auto add = [&](int l, int k, int segment, T sign, T share, const T* arm) {
            T* to = (T*)(f + 3 * segment) + l;
            const T* force = (const T*)pair_force + 3 * k;
            #pragma unroll
            for (int c = 0; c < 3; ++c) {
                const T whole = sign * force[c];
                const T second = HAS_ARMS ? sign * arm[3 * k + c] : share * whole;
                to[c * W] += whole - second;
                to[(3 + c) * W] += second;
            }
        };
        const unsigned char* acts = pair_acts;
        const T* closest = (const T*)pair_closest;
        for (int l = 0; l < own; ++l) {
            const int begin = first[l] - fiber[l];
            const int end = begin + segments;
            for (int k = out_start[begin]; k < out_start[end]; ++k)
                if (acts[k])
                    add(l, k, pair_i[k] - begin, T(1), HAS_ARMS ? T(0) : closest[2 * k],
                        (const T*)pair_arm_i);
            for (int slot = in_start[begin]; slot < in_start[end]; ++slot) {
                const int k = in_pair[slot];
                if (acts[k])
                    add(l, k, pair_j[k] - begin, T(-1), HAS_ARMS ? T(0) : closest[2 * k + 1],
                        (const T*)pair_arm_j);
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
    const T* pivot = pivots + g.pivot_start;
    V3 y = same3(0, 0, 0);
    auto finish = [&](int k, V3 force) {
        if constexpr (HAS_WALLS) wall_force(get(x, k), force);
        if constexpr (IS_CONSISTENT) {
            y = (force - y * V(g.coupling)) * V(pivot[k]);
            force = y;
        }
        put(f, k, force);
    };
    const auto& L = gradient[0].data;
    const V3 spin = same3(
        T(0.5) * (L[2][1] - L[1][2]), T(0.5) * (L[0][2] - L[2][0]), T(0.5) * (L[1][0] - L[0][1]));
    V3 x0 = get(x, 0), v0 = get(v, 0), n0 = same3(0, 0, 0);
    V3 f_before = same3(0, 0, 0), f_here = get(f, 0);
    V inverse0 = V(T(0));
    M torn = V(T(1)) < T(0);
    for (int k = 0; k < segments; ++k) {
        ask(k, node_pos, node_velocity);
        const V3 x1 = get(x, k + 1), v1 = get(v, k + 1);
        const V3 edge = x1 - x0;
        const V d1 = __builtin_elementwise_sqrt(edge.dot(edge));
        const V inverse1 = T(1) / d1;
        const V3 n1 = edge * inverse1;
        torn |= ~(d1 < TEAR * g.rest);
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
    unsigned keep = all;
    if (any(torn))
        for (int l = 0; l < own; ++l)
            if (torn[l]) {
                keep &= ~(1u << l);
                status[SLOT_TORN] = 1;
                status[SLOT_BAD_FIBER] = fiber[l];
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
            for (int col = 0; col < 3; ++col) A[row][col] = T(deformation[0].data[row][col]);
        for (int row = 0; row < 3; ++row) {
            T norm = T(0);
            for (int col = 0; col < 3; ++col)
                norm += wp::abs(T(0.5) * (A[row][col] + A[col][row]) - (row == col ? T(1) : T(0)));
            stretch = norm > stretch ? norm : stretch;
        }
        limit = T(0.5) * (list_sizes[1] - stretch * list_sizes[0]);
        load(p, (const T*)list_pos);
    }
    for (int k = segments; k >= 0; --k) {
        if constexpr (HAS_PAIRS) ask(k, list_pos);
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
        if (any(expired))
            for (int l = 0; l < own; ++l)
                if ((keep >> l & 1) && expired[l]) status[SLOT_EXPIRED] = 1;
    }
    store((T*)node_pos, x, keep);
    store((T*)node_velocity, v, keep);
"""

# Fibers that a cache does not hold are asked for one block ahead, a cache line of each at a time
# along the walks: all at once would be more requests than the processor keeps. Into the second
# cache, whose room they are; the first one would stand still when requests are many.
_COMING = """
    constexpr int LINE = 64 / sizeof(T);
    const bool asks = node_count > fetch_from && block + 1 < block_count;
    long coming[W];
    for (int l = 0; l < W; ++l) coming[l] = asks ? 3L * fiber_node_start[fiber[W + l]] : 0;
    const int lines = asks ? size / LINE + 2 : 0;  // that the numbers of a fiber may touch
    auto ask = [&](int k, auto... arrays) {
        if (k < lines)
            for (int l = 0; l < W; ++l)
                (__builtin_prefetch((const T*)arrays + coming[l] + LINE * k, 0, 2), ...);
    };
"""

_SWEEP = (
    """
    const int* fiber = block_fiber + W * block;
    const int own = block_own[block];
    const auto g = groups[fiber_group[fiber[0]]];
    const int segments = g.segments;
    const int size = 3 * (segments + 1);
    const unsigned all = (1u << own) - 1u;  // a bit per lane with a fiber of its own
    int first[W];
    for (int l = 0; l < W; ++l) first[l] = fiber_node_start[fiber[l]];
"""
    + _COMING
    + """
    const int room = size < W ? W : size;  // a square always fits
    V* x = (V*)__builtin_alloca_with_align(4 * room * sizeof(V), 8 * sizeof(V));
    V* v = x + room;
    V* f = v + room;
    V* p = f + room;
    auto get = [](const V* a, int k) -> V3 { return V3{a[3 * k], a[3 * k + 1], a[3 * k + 2]}; };
    auto put = [](V* a, int k, const V3& b) {
        a[3 * k] = b.x;
        a[3 * k + 1] = b.y;
        a[3 * k + 2] = b.z;
    };
"""
    + _TRANSFER
    + """
    load(x, (const T*)node_pos);
    load(v, (const T*)node_velocity);
"""
    + _GATHER
    + _FORCES
    + _STEP
)


def node_sweep_source(name: str, features: NodeFeatures, arrays: list[str]) -> str:
    """Body of a function with the arguments of the sweep, `arrays` those that are arrays.

    The block is a function that is compiled once, and sees only the addresses of the arrays.
    """
    addresses = ", ".join(f"{array} = {array}.data" for array in arrays)
    return f"""
    const int node_count = node_pos.shape[0], block_count = block_own.shape[0];
    auto sweep = [=, {addresses}]() __attribute__((noinline)) {{
    #pragma clang fp contract(fast)
    {lane_types(name)}
    {_constants(name, features)}
    if (status[SLOT_HALT] != 0) return;
    {_SWEEP.replace("TRANSPOSE", transpose(LANES[name]))}
    }};
    sweep();
    """
