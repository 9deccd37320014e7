"""C++ text of the SIMD sweep over bonded spheres: what one block of fibers does (`native_bonds`).

The laws of `bond` (`native_bond_law`) and `rotation`, one lane per fiber. Positions are float64 in
every precision.
Symbols: as in `bond`; T real, V and P vectors of T and double; x, v, w, a, b scratch of positions,
    velocities, spins, loads (then accelerations) and moments, one vector per number of a node;
    what only this sweep needs lies in memory like that: q quaternions, axis and length of bonds,
    near and skin positions of the near list and skins of nodes.
"""

import math

from warpfiber.laws.rotation import LARGEST_HALF_ANGLE
from warpfiber.model import BAD_FIBER, EXPIRED, HALT, TORN
from warpfiber.passes.bonds import CLAMPED, END_SPEED, FREE, LOWER, SETTLING, BondFeatures
from warpfiber.passes.native import lane_types, transfers, transpose
from warpfiber.passes.native_bond_law import BONDS, bond_constants
from warpfiber.passes.native_capsules_source import PARTS

LANES = 8  # fibers, in both precisions
LARGE = 1_000  # nodes: no cache holds from step to step what is read of so many
LOADS, END, BEGIN = 1, 2, 4
"""What a launch does, in this order: accelerations, half kick, half kick with drift."""
FROM_NODES, TO_NODES = 8, 16
"""Turns are taken from the nodes before, and given to them after; else the blocks keep them."""


def _constants(features: BondFeatures) -> str:
    """Features and numbers that are fixed when the sweep is compiled."""
    flags = {
        "HAS_DASHPOTS": features.dashpots,
        "HAS_LOADS": features.loads,
        "HAS_WALLS": any(features.walls),
        "HAS_PAIRS": features.pairs,
        "HAS_GRIPS": features.grips,
    }
    lines = [f"constexpr bool {key} = {str(value).lower()};" for key, value in flags.items()]
    walled = ", ".join(str(wall).lower() for wall in features.walls)
    lines.append(f"constexpr bool IS_WALLED[3] = {{{walled}}};")
    tables = {
        "COSINE": [(-1.0) ** n / math.factorial(2 * n) for n in range(6)],
        "SINE": [(-1.0) ** n / math.factorial(2 * n + 1) for n in range(6)],
    }
    for key, values in tables.items():
        text = ", ".join(f"T({float(value)!r})" for value in values)
        lines.append(f"constexpr T {key}[{len(values)}] = {{{text}}};")
    lines.append(f"constexpr T LARGEST = T({LARGEST_HALF_ANGLE**2!r});")
    slots = {
        "SLOT_EXPIRED": EXPIRED,
        "SLOT_TORN": TORN,
        "SLOT_HALT": HALT,
        "SLOT_BAD_FIBER": BAD_FIBER,
        "SLOT_SETTLING": SETTLING,
        "SLOT_END_SPEED": END_SPEED,
        "IS_FREE": FREE,
        "IS_CLAMPED": CLAMPED,
        "IS_LOWER": LOWER,
        "PARTS": PARTS,
        "LOADS": LOADS,
        "END": END,
        "BEGIN": BEGIN,
        "FROM_NODES": FROM_NODES,
        "TO_NODES": TO_NODES,
    }
    lines += [f"constexpr int {key} = {value};" for key, value in slots.items()]
    return "\n".join(lines)


# Loads of contacts: the parts of the pair sweep in turn; a node without any has the first line, of
# zeros.
_GATHER = """
    for (int k = 0; k < nodes; ++k) {
        V r[W];
        #pragma unroll
        for (int l = 0; l < W; ++l) {
            const long node = first[l] + k;
            r[l] = load_lines[(1 + node) * contact_touch[node]];
            for (int p = 1; p < PARTS; ++p) {
                const long line = 1 + node + (long)node_count * p;
                r[l] += load_lines[line * contact_touch[line - 1]];
            }
        }
        TRANSPOSE
        #pragma unroll
        for (int c = 0; c < 3; ++c) {
            a[3 * k + c] = r[c];
            b[3 * k + c] = r[3 + c];
        }
    }
    for (int l = 0; l < own; ++l)
        for (int p = 0; p < PARTS; ++p)
            __builtin_memset(contact_touch + first[l] + (long)node_count * p, 0, nodes);
"""

_RATES = """
    if (any(torn))
        for (int l = 0; l < own; ++l)
            if (torn[l]) {
                status[SLOT_TORN] = 1;
                status[SLOT_BAD_FIBER] = fiber[l];
            }
    if constexpr (HAS_GRIPS)
        for (int l = 0; l < own; ++l)
            for (int k = 0; k < nodes; ++k)
                if (node_hold[first[l] + k] >= IS_LOWER)
                    for (int c = 0; c < 3; ++c)
                        ((T*)node_grip)[3L * (first[l] + k) + c] = ((T*)(a + 3 * k + c))[l];
    if constexpr (HAS_WALLS)
        for (int l = 0; l < own; ++l)
            for (int k = 0; fiber_touches[fiber[l]] && k < nodes; ++k)
                if (node_touches[first[l] + k])
                    for (int c = 0; c < 3; ++c) {
                        const long from = 3L * (first[l] + k) + c;
                        ((T*)(a + 3 * k + c))[l] += ((const T*)node_push)[from];
                        ((T*)(b + 3 * k + c))[l] += ((const T*)node_couple)[from];
                    }
    const V3 weight = same3(g.weight[0], g.weight[1], g.weight[2]);
    const V settling = V(stage[SLOT_SETTLING]);
    for (int k = 0; k < nodes; ++k) {
        const bool tip = k == 0 || k == segments;
        const V mass = V(T(1) / (tip ? g.end_mass : g.mass));
        const V inertia = V(T(1) / (tip ? g.end_inertia : g.inertia));
        if constexpr (HAS_LOADS)
            for (int l = 0; l < own; ++l)
                if (node_hold[first[l] + k] == IS_FREE)
                    for (int c = 0; c < 3; ++c)
                        ((T*)(a + 3 * k + c))[l] += ((const T*)node_load)[3L * (first[l] + k) + c];
        put(a, k, get(a, k) * mass + weight - get(v, k) * settling);
        put(b, k, get(b, k) * inertia - get(w, k) * settling);
    }
"""

# A held node has no acceleration; its velocity is set where the first half kick ends a step.
_HOLD = """
            if constexpr (HAS_LOADS)
                for (int l = 0; l < own; ++l) {
                    const int hold = node_hold[first[l] + k];
                    if (hold == IS_FREE) continue;
                    for (int c = 0; c < 3; ++c) {
                        ((T*)(a + 3 * k + c))[l] = T(0);
                        ((T*)&speed)[c * W + l] =
                            ((const T*)node_load)[3L * (first[l] + k) + c];
                        if (hold >= IS_CLAMPED) {
                            ((T*)(b + 3 * k + c))[l] = T(0);
                            ((T*)&spin)[c * W + l] = T(0);
                        }
                    }
                }
"""

_MOVE = """
    const V kick = V(T(0.5) * dt);
    V fastest2 = V(T(0));
    M expired = V(T(1)) < T(0);
    P lowest[3], highest[3];
    for (int c = 0; c < 3; ++c) {
        lowest[c] = P(1e30);
        highest[c] = P(-1e30);
    }
    for (int k = 0; k < nodes; ++k) {
        V3 speed = get(v, k), spin = get(w, k);
        if (loads) {
            if (ends) {
                speed = speed + get(a, k) * kick;
                spin = spin + get(b, k) * kick;
            }
            HOLD
            const V size2 = speed.dot(speed);
            fastest2 = size2 > fastest2 ? size2 : fastest2;
        }
        if (begins) {
            speed = speed + get(a, k) * kick;
            spin = spin + get(b, k) * kick;
            P3 at = get_P(x, k);
            at.x += widen(speed.x * dt);
            at.y += widen(speed.y * dt);
            at.z += widen(speed.z * dt);
            x[3 * k] = at.x;
            x[3 * k + 1] = at.y;
            x[3 * k + 2] = at.z;
            #pragma unroll
            for (int c = 0; c < 3; ++c)
                if (IS_WALLED[c]) {
                    const P here = x[3 * k + c];
                    lowest[c] = here < lowest[c] ? here : lowest[c];
                    highest[c] = here > highest[c] ? here : highest[c];
                }
            const V3 turn = spin * kick;
            const V z = turn.dot(turn);
            V cosine = COSINE[3] + z * (COSINE[4] + z * COSINE[5]);
            cosine = T(1) + z * (COSINE[1] + z * (COSINE[2] + z * cosine));
            V sine = SINE[3] + z * (SINE[4] + z * SINE[5]);
            sine = T(1) + z * (SINE[1] + z * (SINE[2] + z * sine));
            if (__builtin_expect(any(z > LARGEST), 0))
                for (int l = 0; l < W; ++l)
                    if (z[l] > LARGEST) {
                        const T h = wp::sqrt(T(z[l]));
                        cosine[l] = wp::cos(h);
                        sine[l] = wp::sin(h) / h;
                    }
            const V4 old = get4(q, k);
            const V3 r = turn * sine;
            V3 vector = old.v * cosine + r * old.s + r.cross(old.v);
            V scalar = cosine * old.s - r.dot(old.v);
            const V back = T(1.5) - T(0.5) * (vector.dot(vector) + scalar * scalar);
            q[4 * k] = vector.x * back;
            q[4 * k + 1] = vector.y * back;
            q[4 * k + 2] = vector.z * back;
            q[4 * k + 3] = scalar * back;
            if constexpr (HAS_PAIRS) {
                const P3 was = get_P(near, k);
                const V3 moved = {
                    narrow(at.x - was.x), narrow(at.y - was.y), narrow(at.z - was.z)};
                const V far = __builtin_elementwise_sqrt(moved.dot(moved))
                    + dt * __builtin_elementwise_sqrt(speed.dot(speed));
                expired |= ~(far <= skin[k]);
                if (IS_SINGLE) put(listed, k, V3{narrow(at.x), narrow(at.y), narrow(at.z)});
            }
        }
        put(v, k, speed);
        put(w, k, spin);
    }
"""

_STORE = """
    store_V(3, (T*)node_velocity, v);
    store_V(3, (T*)node_spin, w);
    if (phase & TO_NODES) store_V(4, (T*)node_turn, q);
    if (begins) {
        store_P(3, (double*)place, x);
        if (IS_SINGLE && HAS_PAIRS) store_V(3, (T*)node_pos, listed);
        if constexpr (HAS_WALLS)
            for (int l = 0; l < own; ++l)
                for (int c = 0; c < 3; ++c) {
                    fiber_extent[6 * fiber[l] + c] = ((const double*)(lowest + c))[l];
                    fiber_extent[6 * fiber[l] + 3 + c] = ((const double*)(highest + c))[l];
                }
        if (any(expired))
            for (int l = 0; l < own; ++l)
                if (expired[l]) status[SLOT_EXPIRED] = 1;
    } else {
        store_V(3, (T*)node_rate, a);
        store_V(3, (T*)node_spin_rate, b);
    }
    if (ends)
        for (int l = 0; l < own; ++l)
            still_steps[fiber[l]] =
                fastest2[l] < stage[SLOT_END_SPEED] ? still_steps[fiber[l]] + 1 : 0;
"""

_SWEEP = """
    const int* fiber = block_fiber + W * block;
    const int own = block_own[block];
    const auto g = groups[fiber_group[fiber[0]]];
    const int segments = g.segments, nodes = segments + 1;
    int first[W];
    for (int l = 0; l < W; ++l) first[l] = fiber_node_start[fiber[l]];
    const V* const load_lines = (const V*)contact_load;
    const bool loads = phase & LOADS, ends = phase & END, begins = phase & BEGIN;

    P* x = (P*)__builtin_alloca_with_align(3 * nodes * sizeof(P), 512);
    V* v = (V*)__builtin_alloca_with_align(15 * nodes * sizeof(V), 512);
    V* w = v + 3 * nodes;
    V* a = w + 3 * nodes;
    V* b = a + 3 * nodes;
    V* listed = b + 3 * nodes;
    const long place_in = block_start[block];
    const P* near = (const P*)block_pos + 3 * place_in;
    const V* skin = (const V*)block_skin + place_in;
    const V* axis = (const V*)block_axis + 3 * place_in;
    const V* length = (const V*)block_length + place_in;
    V* q = (V*)block_turn + 4 * place_in;
    struct P3 { P x, y, z; };
    struct V4 { V3 v; V s; };
    auto get = [](const V* u, int k) -> V3 { return V3{u[3 * k], u[3 * k + 1], u[3 * k + 2]}; };
    auto get_P = [](const P* u, int k) -> P3 { return P3{u[3 * k], u[3 * k + 1], u[3 * k + 2]}; };
    auto get4 = [](const V* u, int k) -> V4 {
        return V4{V3{u[4 * k], u[4 * k + 1], u[4 * k + 2]}, u[4 * k + 3]};
    };
    auto put = [](V* u, int k, const V3& values) {
        u[3 * k] = values.x;
        u[3 * k + 1] = values.y;
        u[3 * k + 2] = values.z;
    };
    auto narrow = [](P values) -> V { return __builtin_convertvector(values, V); };
    auto widen = [](V values) -> P { return __builtin_convertvector(values, P); };
"""

# Caches hold no such bed from step to step: what the next block reads is fetched while this one is
# computed, a line of zeros instead of loads that are not there.
_FETCH = """
    if (node_count > LARGE && block + 1 < block_count) {
        const int* others = block_fiber + W * (block + 1);
        const long from = fiber_node_start[others[0]];
        const long to = fiber_node_start[others[block_own[block + 1] - 1] + 1];
        auto fetch = [&](const void* start, long bytes) {
            const char* const from_byte = (const char*)start;
            for (long at = 0; at < bytes; at += 64) __builtin_prefetch(from_byte + at, 0, 2);
        };
        if (to - from <= W * nodes) {
            fetch((const double*)place + 3 * from, 3 * sizeof(double) * (to - from));
            fetch((const T*)node_velocity + 3 * from, 3 * sizeof(T) * (to - from));
            fetch((const T*)node_spin + 3 * from, 3 * sizeof(T) * (to - from));
            if (loads)
                for (int p = 0; p < PARTS; ++p)
                    for (long node = from; node < to; ++node) {
                        const long line = 1 + node + (long)node_count * p;
                        __builtin_prefetch(load_lines + line * contact_touch[line - 1], 0, 2);
                    }
        }
    }
"""

_LOAD = """
    load_P(3, x, (const double*)place);
    load_V(3, v, (const T*)node_velocity);
    load_V(3, w, (const T*)node_spin);
    if (phase & FROM_NODES) load_V(4, q, (const T*)node_turn);
    if (loads) {
        GATHER
        BONDS
    } else {
        load_V(3, a, (const T*)node_rate);
        load_V(3, b, (const T*)node_spin_rate);
    }
"""


def bond_sweep_source(name: str, features: BondFeatures, arrays: list[str]) -> str:
    """Body of a function with the arguments of the sweep, `arrays` those that are arrays."""
    addresses = ", ".join(f"{array} = {array}.data" for array in arrays)
    work = _FETCH.replace("LARGE", str(LARGE))
    work += _LOAD.replace("GATHER", _GATHER.replace("TRANSPOSE", transpose(LANES))).replace(
        "BONDS", BONDS + _RATES
    )
    work += _MOVE.replace("HOLD", _HOLD) + _STORE
    types = lane_types(name, LANES)
    places = "auto& load_P = load_V; auto& store_P = store_V;"
    if name == "float32":
        places = transfers("P", LANES)
    return f"""
    const int node_count = place.shape[0], block_count = block_own.shape[0];
    auto sweep = [=, {addresses}]() __attribute__((noinline)) {{
    #pragma clang fp contract(fast)
    {types}
    typedef double P __attribute__((ext_vector_type(W)));
    constexpr bool IS_SINGLE = sizeof(T) == 4;
    {_constants(features)}
    {bond_constants()}
    if (status[SLOT_HALT] != 0) return;
    {_SWEEP}
    {transfers("V", LANES)}
    {places}
    {work}
    }};
    sweep();
    """
