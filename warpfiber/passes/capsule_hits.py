"""Which listed pairs of segments may touch now, packed for the sweep over contacts.

Most listed pairs are apart. Which ones are not can hardly be foreseen by a processor, so nothing
branches here: every pair writes itself, and the place of the next one moves on only behind those
that may touch. Pairs are cut into parts, one per thread; on CUDA a part is a pair.
Source: law `segment_distance`.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, PAIR_COUNT, precision
from warpfiber.passes.array_items import make_items
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.kernel_module import FUSED
from warpfiber.passes.pairs import PairFeatures, make_pair_geometry

# Packing coordinates into short vectors costs more shuffles than it saves: a tenth of the time.
SCALAR = {"cpu_compiler_flags": FUSED["cpu_compiler_flags"] + " -fno-slp-vectorize"}
PART = 64  # pairs of a part on the CPU, where the list is full


def part_count(capacity: int, device: str) -> int:
    """Parts of a list with room for so many pairs."""
    return max(1, capacity // PART) if device.startswith("cpu") else capacity


@wp.func
def part_begin(part: wp.int32, parts: wp.int32, pairs: wp.int32) -> wp.int32:
    """First pair of a part: parts are as long as each other."""
    return wp.int32(wp.int64(part) * wp.int64(pairs) / wp.int64(parts))


@cache
def make_capsule_hits(name: str, features: CapsuleFeatures):
    """Kernel `capsule_hits`: numbers and closest points of pairs that may touch; none acts yet."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    geometry = PairFeatures(repulsion=False, periodic=features.periodic)
    closest_fractions, image_shift, _, _ = make_pair_geometry(name, geometry)
    is_closed = features.closed
    number, set_number = make_items(wp.int32)
    point, _ = make_items(wp.vec3d)
    _, set_flag = make_items(wp.uint8)
    _, set_closest = make_items(vec2)

    @wp.kernel(module="unique", module_options=SCALAR, enable_backward=False, grid_stride=False)
    def capsule_hits(
        offset: wp.int32,
        parts: wp.int32,
        largest_reach: real,
        segment_node: wp.array(dtype=wp.int32),
        segment_end: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        place: wp.array(dtype=wp.vec3d),
        status: wp.array(dtype=wp.int32),
        pair_acts_out: wp.array(dtype=wp.uint8),
        hit_pair_out: wp.array(dtype=wp.int32),
        hit_closest_out: wp.array(dtype=vec2),
        hit_count_out: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        part = wp.tid() + offset
        begin = part_begin(part, parts, status[wp.static(PAIR_COUNT)])
        end = part_begin(part + 1, parts, status[wp.static(PAIR_COUNT)])
        found = begin
        for k in range(begin, end):
            i = number(pair_i, k)
            j = number(pair_j, k)
            node_i = number(segment_node, i)
            node_j = number(segment_node, j)
            end_i = node_i + 1
            end_j = node_j + 1
            if wp.static(is_closed):
                end_i = number(segment_end, i)
                end_j = number(segment_end, j)
            xi = point(place, node_i)
            xj = point(place, node_j)
            a = vec3(point(place, end_i) - xi)
            b = vec3(point(place, end_j) - xj)
            delta = vec3(xj - xi) + image_shift(number(pair_image, k), lattice[0])
            st = closest_fractions(delta, a, b)
            c = delta + st[1] * b - st[0] * a
            set_flag(pair_acts_out, k, wp.uint8(0))
            set_number(hit_pair_out, found, k)
            set_closest(hit_closest_out, found, st)
            found += wp.where(wp.length_sq(c) < largest_reach * largest_reach, 1, 0)
        hit_count_out[part] = found - begin

    return capsule_hits
