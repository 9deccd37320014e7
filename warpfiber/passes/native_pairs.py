"""The pair sweep on the CPU: many distances at once, then the law of the few pairs within reach.

A native block computes the closest points of 64 listed pairs in vector registers, in the order of
operations of `segment_distance`, and says which pairs are within the largest reach of the scene.
Those take the law of the plain sweep (`pairs.apply_pair_law`), so that it has one source; only
their lubrication is computed in vectors as well (`native_beads`). The results are those of the
plain sweep to the last bit. Pairs are independent of one another, so they do not depend on how the
list is cut into blocks or workers.

Limits: CPU only (clang vector types); every other device takes `pairs.make_pair_sweep`.
"""

from functools import cache
from string import Template

import warp as wp

from warpfiber.laws.lubrication import OUTER
from warpfiber.laws.repulsion import RANGE
from warpfiber.model import HALT, PAIR_COUNT, precision
from warpfiber.passes.native import PREFETCH_NODES
from warpfiber.passes.native_beads import squeeze_text
from warpfiber.passes.pairs import (
    IMAGE_BITS,
    NO_IMAGE,
    PairFeatures,
    make_pair_geometry,
    make_pair_law,
)
from warpfiber.passes.precision import group_struct

BLOCK = 64  # pairs whose answers fit into the bits of one integer
LANES = 8  # pairs in one vector: as fast as 16 in float32, 15 % faster than 4 in float64
CHUNK_SEGMENTS = 64  # segments per launch index: workers share blocks in such portions
CLEAR_ACTS = "__builtin_memset(pair_acts.data + first, 0, count);"
# Pairs that acted in the last step, or others in their places before the list changed, mostly act
# now: their law reads more, and they alone write a force.
FETCH_ACTING = """
        for (int k = first + 64; k < first + 2 * 64 && k + 8 <= capacity; k += 8) {
            unsigned long long acting;
            __builtin_memcpy(&acting, pair_acts.data + k, sizeof(acting));
            for (; acting; acting &= acting - 1) {
                const int next = k + __builtin_ctzll(acting) / 8;
                const real* force = (const real*)pair_force.data + 3 * (long long)next;
                __builtin_prefetch(force, 1, 2);
                __builtin_prefetch(force + 2, 1, 2);
                __builtin_prefetch(segment_fiber.data + pair_i.data[next], 0, 2);
                __builtin_prefetch(segment_fiber.data + pair_j.data[next], 0, 2);
            }
        }
"""

# Rows (x, y, z, unused) of the pairs are loaded as they lie in memory and transposed to one
# vector per component. The second row of a segment is read from its end, so that nothing behind
# the last node is touched. Arguments as of `pair_block` below.
NEAR_PAIRS = Template("""
    $head
    typedef $real real;
    typedef real row_t __attribute__((ext_vector_type(4)));
    typedef real lane_t __attribute__((ext_vector_type($lanes)));
    typedef bool bits_t __attribute__((ext_vector_type($lanes)));
    struct rows_t { row_t r[$lanes]; };
    struct point_t { lane_t x, y, z; };
    auto load = [](const real* from) { row_t r; __builtin_memcpy(&r, from, sizeof(r)); return r; };
    auto transpose = [](const rows_t& m) {
        point_t p;
        for (int q = 0; q < $lanes; q += 4) {
            row_t lo0 = __builtin_shufflevector(m.r[q], m.r[q + 1], 0, 4, 2, 6);
            row_t hi0 = __builtin_shufflevector(m.r[q], m.r[q + 1], 1, 5, 3, 7);
            row_t lo1 = __builtin_shufflevector(m.r[q + 2], m.r[q + 3], 0, 4, 2, 6);
            row_t hi1 = __builtin_shufflevector(m.r[q + 2], m.r[q + 3], 1, 5, 3, 7);
            row_t x = __builtin_shufflevector(lo0, lo1, 0, 1, 4, 5);
            row_t y = __builtin_shufflevector(hi0, hi1, 0, 1, 4, 5);
            row_t z = __builtin_shufflevector(lo0, lo1, 2, 3, 6, 7);
            __builtin_memcpy((real*)&p.x + q, &x, sizeof(x));
            __builtin_memcpy((real*)&p.y + q, &y, sizeof(y));
            __builtin_memcpy((real*)&p.z + q, &z, sizeof(z));
        }
        return p;
    };
    auto dot = [](const point_t& u, const point_t& v) {
        return u.x * v.x + u.y * v.y + u.z * v.z;
    };
    auto larger = [](lane_t u, lane_t v) { return u > v ? u : v; };
    auto clamp = [](lane_t u) {
        u = u > real(0) ? u : lane_t(real(0));
        return u < real(1) ? u : lane_t(real(1));
    };
    auto bits = [](auto test) -> unsigned long long {
        bits_t is = __builtin_convertvector(test, bits_t);
        unsigned long long word = 0;
        __builtin_memcpy(&word, &is, sizeof(is));
        return word & ((1ull << $lanes) - 1);
    };
    auto any = [&](auto test) { return bits(test) != 0; };
    const int none = $none;
    auto shift_of = [&](int k) {
        int code = pair_image.data[k];
        auto number = [&](int place) { return real(((code >> place) & $mask) - $half); };
        wp::vec_t<3, real> n(number(0), number($bits), number(2 * $bits));
        return wp::mul(lattice.data[0], n);
    };
    const real* nodes = (const real*)node_pos.data;
    const int* segment = segment_node.data;
    auto gather = [&](const int* ks, point_t& a, point_t& b, point_t& delta) {
        rows_t rows_a, rows_b, rows_delta;
        for (int q = 0; q < $lanes; ++q) {
            int k = ks[q];
            const real* i = nodes + 3 * (long long)segment[pair_i.data[k]];
            const real* j = nodes + 3 * (long long)segment[pair_j.data[k]];
            row_t xi = load(i), xj = load(j);
            rows_a.r[q] = load(i + 2).yzww - xi;
            rows_b.r[q] = load(j + 2).yzww - xj;
            row_t d = xj - xi;
            $shift
            rows_delta.r[q] = d;
        }
        a = transpose(rows_a);
        b = transpose(rows_b);
        delta = transpose(rows_delta);
    };
    if (node_pos.shape[0] > fetch_from) {
        // what a cache does not hold is asked for two blocks ahead, its addresses four ahead; into
        // the second cache: the first one keeps few requests, and stands still when they are many.
        // Owners are read one after the other: of a small cell only their partners are asked for
        const int capacity = pair_j.shape[0];
        const int until = first + 3 * 64 < capacity ? first + 3 * 64 : capacity;
        auto ask = [&](const int* of) {
            for (int k = first + 2 * 64; k < until; ++k) {
                const real* x = nodes + 3 * (long long)segment[of[k]];
                __builtin_prefetch(x, 0, 2);
                __builtin_prefetch(x + 5, 0, 2);
            }
        };
        ask(pair_j.data);
        if (node_pos.shape[0] > $many) {
            ask(pair_i.data);
            for (int k = first + 4 * 64; k < until + 2 * 64 && k < capacity; ++k)
                __builtin_prefetch(segment + pair_j.data[k], 0, 2);
        }
        $fetch
    }
    unsigned long long near = 0, touch = 0;
    for (int group = 0; group < count; group += $lanes) {
        int ks[$lanes];
        for (int q = 0; q < $lanes; ++q)
            ks[q] = first + (group + q < count ? group + q : count - 1);
        point_t a, b, delta;
        gather(ks, a, b, delta);
        lane_t aa = larger(dot(a, a), real($tiny)), bb = larger(dot(b, b), real($tiny));
        lane_t ab = dot(a, b), da = dot(delta, a), db = dot(delta, b);
        lane_t den = larger(aa * bb - ab * ab, real($eps) * aa * bb);
        lane_t s = clamp((da * bb - db * ab) / den);
        lane_t t = clamp((s * ab - db) / bb);
        s = clamp((t * ab + da) / aa);
        point_t c = {
            delta.x + t * b.x - s * a.x, delta.y + t * b.y - s * a.y, delta.z + t * b.z - s * a.z
        };
        lane_t dd = dot(c, c);
        near |= bits(dd <= reach_bound * reach_bound) << group;
        touch |= bits(dd <= touch_bound * touch_bound) << group;
    }
    if (count < 64) {
        near &= (1ull << count) - 1;
        touch &= near;
    }
    $rest
""")
# an image of the partner is rare, and in periodic boxes only
SHIFT = """if (pair_image.data[k] != none) {
                auto v = shift_of(k);
                d += row_t{v.c[0], v.c[1], v.c[2], real(0)};
            }"""


def native_chunks(segment_count: int) -> int:
    """Launch dimension of the native sweep; every index takes an equal share of the blocks."""
    return max(1, segment_count // CHUNK_SEGMENTS)


def near_text(name: str, periodic: bool, *, head: str = "", fetch: str = "", rest: str) -> str:
    """Statements that find the near ones of a block of pairs, up to what `rest` does with them.

    From `fetch_from` nodes on, what later blocks need is asked for.
    """
    return NEAR_PAIRS.substitute(
        real={"float32": "float", "float64": "double"}[name],
        lanes=LANES,
        none=NO_IMAGE,
        bits=IMAGE_BITS,
        mask=(1 << IMAGE_BITS) - 1,
        half=1 << (IMAGE_BITS - 1),
        shift=SHIFT if periodic else "",
        tiny="1.0e-30",
        eps=precision(name).eps,
        head=head,
        fetch=fetch,
        rest=rest,
        many=PREFETCH_NODES,
    )


@cache
def make_pair_block(name: str, features: PairFeatures):
    """`pair_block(...)` -> bits of the pairs first ... first + count - 1 that are left to the law.

    Clears their `pair_acts`. Without lubrication the bits are the pairs within `reach_bound`; else
    these are lubricated here, and the bits are those within `touch_bound`, which repel as well.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    rest = "return near;"
    if features.lubrication != "none":
        rest = squeeze_text(name, LANES, features.lubrication, features.sheared)
    snippet = near_text(name, features.periodic, fetch=FETCH_ACTING, rest=f"{CLEAR_ACTS} {rest}")

    @wp.func_native(snippet)
    def pair_block(
        first: wp.int32,
        count: wp.int32,
        fetch_from: wp.int32,
        dt: real,
        reach_bound: real,
        touch_bound: real,
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        lattice: wp.array(dtype=mat33),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_arm_i: wp.array(dtype=vec3),
        pair_arm_j: wp.array(dtype=vec3),
    ) -> wp.uint64: ...

    return pair_block


@wp.func_native("return __builtin_ctzll(bits);")
def _lowest_bit(bits: wp.uint64) -> wp.int32: ...


@cache
def make_native_pair_sweep(name: str, features: PairFeatures):
    """Kernel like `pairs.pair_sweep`; index t of `chunks` takes its share of the pair blocks."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    closest_fractions, image_shift, _, _ = make_pair_geometry(name, features)
    apply_pair_law = make_pair_law(name, features, is_squeezed=features.lubrication != "none")
    pair_block = make_pair_block(name, features)
    touch_share = real(RANGE / OUTER)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def native_pair_sweep(
        offset: wp.int32,
        chunks: wp.int32,
        fetch_from: wp.int32,
        dt: real,
        strength: real,
        decay: real,
        reach_bound: real,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        lattice: wp.array(dtype=mat33),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        pair_acts_out: wp.array(dtype=wp.uint8),
        pair_force_out: wp.array(dtype=vec3),
        pair_closest_out: wp.array(dtype=vec2),
        pair_arm_i_out: wp.array(dtype=vec3),
        pair_arm_j_out: wp.array(dtype=vec3),
    ):
        if status[wp.static(HALT)] != 0:
            return
        chunk = wp.tid() + offset
        total = status[wp.static(PAIR_COUNT)]
        blocks = (total + wp.static(BLOCK - 1)) / wp.static(BLOCK)
        begin = wp.int32(wp.int64(blocks) * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(wp.int64(blocks) * wp.int64(chunk + 1) / wp.int64(chunks))
        for block in range(begin, end):
            first = block * wp.static(BLOCK)
            left = pair_block(
                first,
                wp.min(total - first, wp.static(BLOCK)),
                fetch_from,
                dt,
                reach_bound,
                touch_share * reach_bound,
                groups,
                fiber_group,
                segment_node,
                segment_fiber,
                gradient,
                lattice,
                pair_i,
                pair_j,
                pair_image,
                node_pos,
                node_velocity,
                pair_acts_out,
                pair_force_out,
                pair_arm_i_out,
                pair_arm_j_out,
            )
            while left != wp.uint64(0):
                k = first + _lowest_bit(left)
                left = left & (left - wp.uint64(1))
                i = pair_i[k]
                j = pair_j[k]
                node_i = segment_node[i]
                node_j = segment_node[j]
                xi = node_pos[node_i]
                xj = node_pos[node_j]
                a = node_pos[node_i + 1] - xi
                b = node_pos[node_j + 1] - xj
                shift = image_shift(pair_image[k], lattice[0])
                delta = xj - xi + shift
                st = closest_fractions(delta, a, b)
                apply_pair_law(
                    k,
                    i,
                    j,
                    node_i,
                    node_j,
                    a,
                    b,
                    delta,
                    shift,
                    st,
                    dt,
                    strength,
                    decay,
                    groups,
                    fiber_node_start,
                    fiber_group,
                    segment_fiber,
                    gradient,
                    node_pos,
                    node_velocity,
                    pair_acts_out,
                    pair_force_out,
                    pair_closest_out,
                    pair_arm_i_out,
                    pair_arm_j_out,
                )

    return native_pair_sweep
