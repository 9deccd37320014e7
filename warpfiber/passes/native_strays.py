"""Segments too far off their listed lines, each against all others: C++ text for `list_bound`.

A few fibers that others push would end any list. As long as they are few, and none of them is
within the reach of a segment that is not listed with it, the list still holds every pair.
First the midpoints of all segments are compared with the line of a stray, in float32 and in the
nearest image; then those that pass by the distance of the two segments.

Source: unlisted pairs of segments that are not off their lines are apart (`list_bound`); two
    midpoints nearer than half the least height of the box have one image that near.
Symbols: `most` strays; `reach` of the list; `wary` beyond it what may come within reach in the next
    step, so that the list is built before that.
Limits: segments that are long against the box, or one that is not finite, end the list.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.native import lane_types
from warpfiber.passes.pair_motion import CHUNK_SEGMENTS
from warpfiber.passes.pairs import IMAGE_BITS, NO_IMAGE

PLANES = 4  # midpoint and half length of every segment
LANES = 16
ROUNDING = 1e-5  # of float32, of the largest number that is compared

TEXT = """
    typedef float F __attribute__((ext_vector_type(LANES)));
    typedef int I __attribute__((ext_vector_type(LANES)));
    constexpr int L = LANES;
    struct P { T x, y, z; };
    auto sum = [](P a, P b, T s) -> P { return P{a.x + s * b.x, a.y + s * b.y, a.z + s * b.z}; };
    auto dot = [](P a, P b) -> T { return a.x * b.x + a.y * b.y + a.z * b.z; };
    auto node_of = [&](int node) -> P {
        const auto& p = node_pos.data[node];
        return P{p[0], p[1], p[2]};
    };
    auto clip = [](T s) -> T { return s > T(0) ? (s < T(1) ? s : T(1)) : T(0); };
    list_share.data[0] = T(0);
    int count = 0;
    for (int c = 0; c < chunks; ++c) count += __builtin_popcountll(part_short.data[c]);
    if (count == 0) return 0;
    if (count > most) return 1;
    list_share.data[0] = T(count) / T(most + 1);

    // heights of the box, and rows of its inverse, along the axes that repeat
    const auto& box = lattice.data[0];
    P column[3], inverse[3];
    for (int a = 0; a < 3; ++a) column[a] = P{box.data[0][a], box.data[1][a], box.data[2][a]};
    auto cross = [](P a, P b) -> P {
        return P{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    };
    T height = T(1e30);
    for (int a = 0; a < 3; ++a) {
        const P side = cross(column[(a + 1) % 3], column[(a + 2) % 3]);
        const T volume = dot(side, column[a]);
        const T part = wraps[a] != 0 ? T(1) / volume : T(0);
        inverse[a] = P{side.x * part, side.y * part, side.z * part};
        const T mine = wp::abs(volume) / wp::sqrt(dot(side, side));
        if (wraps[a] != 0 && mine < height) height = mine;
    }
    const int stride = (segments + L - 1) / L * L;
    float* const planes = (float*)stray_planes.data;
    T longest = T(0), widest = T(0);
    for (int s = 0; s < stride; ++s) {
        const int node = segment_node.data[s < segments ? s : segments - 1];
        const P x = node_of(node), along = sum(node_of(node + 1), x, T(-1));
        const P middle = sum(x, along, T(0.5));
        const T half = T(0.5) * wp::sqrt(dot(along, along));
        const T size = wp::abs(middle.x) + wp::abs(middle.y) + wp::abs(middle.z);
        if (!(size + half < T(1e6))) return 1;
        longest = half > longest ? half : longest;
        widest = size > widest ? size : widest;
        planes[s] = (float)middle.x;
        planes[stride + s] = (float)middle.y;
        planes[2 * stride + s] = (float)middle.z;
        planes[3 * stride + s] = (float)half;
    }
    const T seen = reach + wary;
    if (!(T(2) * longest + seen < T(0.5) * height)) return 1;
    const float slack = (float)(seen + T(ROUNDING) * (widest + longest));
    bool missing = false, soon = false;
    auto meet = [&](int f, int k) {
        const int i = f < k ? f : k, j = f < k ? k : f;
        const int node_i = segment_node.data[i], node_j = segment_node.data[j];
        const P xi = node_of(node_i), xj = node_of(node_j);
        const P a = sum(node_of(node_i + 1), xi, T(-1)), b = sum(node_of(node_j + 1), xj, T(-1));
        P d = sum(xj, xi, T(-1));
        const P apart = sum(sum(d, b, T(0.5)), a, T(-0.5));
        int code = NONE;
        for (int axis = 0; axis < 3; ++axis) {
            const T n = wp::rint(dot(inverse[axis], apart));
            d = sum(d, column[axis], -n);
            code -= (int)n << (axis * BITS);
        }
        const int between = j - i - 1, fiber = segment_fiber.data[i];
        if (code == NONE && fiber == segment_fiber.data[j] && between < fiber_skip.data[fiber])
            return;
        const T aa = dot(a, a) + T(1e-30), bb = dot(b, b) + T(1e-30), ab = dot(a, b);
        const T da = dot(d, a), db = dot(d, b);
        const T area2 = aa * bb - ab * ab, least = T(1e-12) * aa * bb;
        T s = clip((da * bb - db * ab) / (area2 > least ? area2 : least));
        const T t = clip((s * ab - db) / bb);
        s = clip((t * ab + da) / aa);
        const P c = sum(sum(d, b, t), a, -s);
        const T gap2 = dot(c, c);
        if (!(gap2 <= seen * seen)) return;
        for (int pair = out_start.data[i]; pair < out_start.data[i + 1]; ++pair)
            if (pair_j.data[pair] == j && pair_image.data[pair] == code) return;
        soon = true;
        missing |= gap2 <= reach * reach;
    };
    const float* const X = planes;
    const float* const Y = X + stride;
    const float* const Z = Y + stride;
    const float* const HALF = Z + stride;
    float rows[3][3], columns[3][3];
    for (int a = 0; a < 3; ++a) {
        const T of[2][3] = {{inverse[a].x, inverse[a].y, inverse[a].z},
                            {column[a].x, column[a].y, column[a].z}};
        for (int q = 0; q < 3; ++q) {
            rows[a][q] = (float)of[0][q];
            columns[a][q] = (float)of[1][q];
        }
    }
    for (int chunk = 0; chunk < chunks && !missing; ++chunk)
        for (unsigned long long bits = part_short.data[chunk]; bits; bits &= bits - 1) {
            const int f = chunk * CHUNK + __builtin_ctzll(bits);
            const int node = segment_node.data[f];
            const P along = sum(node_of(node + 1), node_of(node), T(-1));
            const float ax = 0.5f * (float)along.x, ay = 0.5f * (float)along.y;
            const float az = 0.5f * (float)along.z;
            const float inverse_aa = 1.0f / (ax * ax + ay * ay + az * az + 1e-30f);
            for (int k = 0; k < stride; k += L) {
                F x, y, z, far;
                __builtin_memcpy(&x, X + k, sizeof(F));
                __builtin_memcpy(&y, Y + k, sizeof(F));
                __builtin_memcpy(&z, Z + k, sizeof(F));
                __builtin_memcpy(&far, HALF + k, sizeof(F));
                x -= X[f];
                y -= Y[f];
                z -= Z[f];
                for (int a = 0; a < 3; ++a) {
                    if (wraps[a] == 0) continue;
                    const F n = __builtin_elementwise_rint(
                        x * rows[a][0] + y * rows[a][1] + z * rows[a][2]);
                    x -= n * columns[a][0];
                    y -= n * columns[a][1];
                    z -= n * columns[a][2];
                }
                F s = (x * ax + y * ay + z * az) * inverse_aa;
                s = s > -1.0f ? s : (F)-1.0f;
                s = s < 1.0f ? s : (F)1.0f;
                x -= s * ax;
                y -= s * ay;
                z -= s * az;
                far += slack;
                const I near = x * x + y * y + z * z <= far * far;
                if (__builtin_reduce_or(near) == 0) continue;
                for (int l = 0; l < L && k + l < segments; ++l)
                    if (near[l]) meet(f, k + l);
            }
        }
    if (soon) list_share.data[0] = T(2);
    return missing ? 1 : 0;
"""


# Of the segments one in so many may be a stray, and no more than MOST: to look at one costs about a
# ns per segment and step, a list built anew some 700 and lasts three to seven steps.
ONE_IN, MOST = 32, 80
FEWEST = 256  # segments; below that any stray ends the list: little is built anew
WARY = 0.25  # of the skin


def most_strays(segments: int) -> int:
    """How many of the segments may be off their lines while the list holds."""
    return min(segments // ONE_IN, MOST) if segments >= FEWEST else 0


@cache
def make_native_strays(name: str, module: str = "unique") -> Any:
    """Kernel `bound_list` where segments may be off their lines: one thread, after `bound_fibers`.

    `part_short`: a bit for every segment of a run of CHUNK_SEGMENTS that is off its line.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    assert CHUNK_SEGMENTS == 64  # bits
    text = TEXT
    for key, value in {
        "LANES": LANES,
        "ROUNDING": ROUNDING,
        "CHUNK": CHUNK_SEGMENTS,
        "BITS": IMAGE_BITS,
        "NONE": NO_IMAGE,
    }.items():
        text = text.replace(key, str(value))

    @wp.func_native(lane_types(name) + text)
    def look_at_strays(
        chunks: wp.int32,
        most: wp.int32,
        segments: wp.int32,
        reach: real,
        wary: real,
        wraps: wp.vec3i,
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_skip: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        node_pos: wp.array(dtype=vec3),
        part_short: wp.array(dtype=wp.int64),
        stray_planes: wp.array(dtype=wp.float32),
        list_share: wp.array(dtype=real),
    ) -> wp.int32: ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def bound_strays(
        most: wp.int32,
        list_sizes: wp.array(dtype=real),
        wraps: wp.vec3i,
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_skip: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        node_pos: wp.array(dtype=vec3),
        part_short: wp.array(dtype=wp.int64),
        part_use: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        stray_planes: wp.array(dtype=wp.float32),
        list_short_out: wp.array(dtype=wp.int32),
        list_use_out: wp.array(dtype=vec3),
        list_share_out: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        use = vec3()
        for part in range(part_use.shape[0]):
            use = wp.max(use, part_use[part])
        list_short_out[0] = look_at_strays(
            part_short.shape[0],
            most,
            segment_node.shape[0],
            list_sizes[0] - list_sizes[1],
            real(wp.static(WARY)) * list_sizes[1],
            wraps,
            segment_node,
            segment_fiber,
            fiber_skip,
            out_start,
            pair_j,
            pair_image,
            lattice,
            node_pos,
            part_short,
            stray_planes,
            list_share_out,
        )
        if list_share_out[0] > real(0.0):
            use = vec3(use[0], use[2], use[2])  # strays use up all of it
        list_use_out[0] = use

    return bound_strays
