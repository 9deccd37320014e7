"""Near pairs of a list: those that may touch before some node has moved by its own skin.

The skin of a node grows with its speed, so that a fast one does not make the list short-lived for
all. Near pairs are found among the listed ones, which have a large skin; memories of friction stay
where the listed pairs have them.
Source: a point of a segment moves no farther than one of its two nodes; with the larger skin of
    these as the segment's, no pair farther apart than its reach and both skins touches while no
    node has moved by its skin. Listed are all pairs nearer than reach + skin less what nodes have
    moved since, so a node's skin ends at half of that skin less its own move.
Limits: CPU only (`native_capsules`).
"""

import math
from functools import cache

import numpy as np
import warp as wp

from warpfiber.model import precision
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.native_bonds_source import LANES
from warpfiber.passes.native_capsules_source import PARTS
from warpfiber.passes.native_near_source import near_list_source

# Trials on a bed of 500 fibers of 26 segments under a plate: LEAST from 0.012 to 0.05 and LASTING
# from 12 to 20 cost the same to the scatter of 5 %; lists at a PAIR_COST of 0.3 half of those at 1.
LEAST = 0.025  # skin of a node at rest, diameters
LASTING = 20.0  # steps that a skin is made for
ENOUGH = 5.0  # steps; where the list leaves less, it is built anew
ONE_STEP = 1.5  # steps that any skin must last
PAIR_COST = 0.3  # as `skin.PAIR_COST`: a listed pair is looked at when near ones are found
# Arguments of `list_near` that are arrays.
ARRAYS = """
    segment_node segment_tips lattice out_start part_start pair_i pair_j pair_image place near_skin
    near_pair near_i near_j near_image near_count
""".split()


def part_starts(segment_count: int) -> np.ndarray:
    """(PARTS + 1,) first segments of parts with about as many pairs: those of i are with j > i."""
    parts = [1.0 - math.sqrt(1.0 - part / PARTS) for part in range(PARTS + 1)]
    return np.asarray(np.rint(segment_count * np.asarray(parts)), dtype=np.int32)


@cache
def make_near_pairs(name: str, features: CapsuleFeatures):
    """Kernels `choose_skins` (over nodes) and `list_near` (over the PARTS of the list)."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    half = real(0.5)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def choose_skins(
        offset: wp.int32,
        dt: real,
        least: real,
        list_sizes: wp.array(dtype=real),
        list_pos: wp.array(dtype=vec3),
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        near_pos_out: wp.array(dtype=wp.vec3d),
        near_skin_out: wp.array(dtype=real),
        node_slot: wp.array(dtype=wp.int32),
        block_pos_out: wp.array(dtype=wp.float64),
        block_skin_out: wp.array(dtype=real),
        short_out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid() + offset
        x = place[i]
        pace = dt * wp.length(node_velocity[i])
        room = half * list_sizes[1] - wp.length(vec3(x) - list_pos[i])
        skin = wp.min(least + real(wp.static(LASTING)) * pace, room)
        if not (skin > real(wp.static(ENOUGH)) * pace):
            short_out[0] = 1
        if not (skin > real(wp.static(ONE_STEP)) * pace):
            short_out[1] = 1
        near_pos_out[i] = x
        near_skin_out[i] = wp.max(skin, real(0.0))
        slot = node_slot[i]
        first = 3 * slot - 2 * (slot % wp.static(LANES))
        for axis in range(3):
            block_pos_out[first + wp.static(LANES) * axis] = x[axis]
        block_skin_out[slot] = near_skin_out[i]

    @wp.func_native(near_list_source(name, features, ARRAYS))
    def find_near(
        part: wp.int32,
        largest_reach: real,
        segment_node: wp.array(dtype=wp.int32),
        segment_tips: wp.array(dtype=wp.uint8),
        lattice: wp.array(dtype=mat33),
        out_start: wp.array(dtype=wp.int32),
        part_start: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        place: wp.array(dtype=wp.vec3d),
        near_skin: wp.array(dtype=real),
        near_pair: wp.array(dtype=wp.int32),
        near_i: wp.array(dtype=wp.int32),
        near_j: wp.array(dtype=wp.int32),
        near_image: wp.array(dtype=wp.int32),
        near_count: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def list_near(
        offset: wp.int32,
        largest_reach: real,
        segment_node: wp.array(dtype=wp.int32),
        segment_tips: wp.array(dtype=wp.uint8),
        lattice: wp.array(dtype=mat33),
        out_start: wp.array(dtype=wp.int32),
        part_start: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        near_pos: wp.array(dtype=wp.vec3d),
        near_skin: wp.array(dtype=real),
        near_pair_out: wp.array(dtype=wp.int32),
        near_i_out: wp.array(dtype=wp.int32),
        near_j_out: wp.array(dtype=wp.int32),
        near_image_out: wp.array(dtype=wp.int32),
        near_count_out: wp.array(dtype=wp.int32),
    ):
        find_near(
            wp.tid() + offset,
            largest_reach,
            segment_node,
            segment_tips,
            lattice,
            out_start,
            part_start,
            pair_i,
            pair_j,
            pair_image,
            near_pos,
            near_skin,
            near_pair_out,
            near_i_out,
            near_j_out,
            near_image_out,
            near_count_out,
        )

    return choose_skins, list_near
