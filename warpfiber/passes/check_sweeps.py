"""Sweeps over the end of a step: overlaps, center lines that passed through each other, the list.

One thread per segment looks at its outgoing pairs that may have met and at its nodes; runs of
segments are reduced in order, so the result does not depend on the workers.

Source: overlaps of closest points; crossings by `crossing`.
Symbols: D from the start of a to the start of b, an image with its box vector; overlap
    (a_i + a_j - d) / min(a_i, a_j).
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.array_rows import PLACES, make_array_rows
from warpfiber.passes.crossing import PLANAR, make_crossing
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.passes.pairs import PairFeatures, make_pair_geometry
from warpfiber.passes.portions import PORTION, portioned
from warpfiber.passes.precision import group_struct
from warpfiber.passes.row_geometry import make_closest_points, make_wall_gap

LOST = 1e30  # run units, and their squares: who is there is nowhere


@dataclass(frozen=True)
class CheckFeatures:
    """What the check of a scene contains."""

    periodic: bool = False
    walls: tuple[bool, bool, bool] = (False, False, False)
    frozen: bool = False  # some fibers are; nothing moves two of them, or one from a wall
    shifted: bool = False  # it is known how near pairs come but for contact, and what that adds
    again: bool = False  # twice
    arrays: bool = False  # some walls are arrays of fibers
    tears: bool = False  # a step that tears a segment is as one that ends nowhere
    renewed: bool = False  # only what the second solve moved is looked at again
    picked: bool = False  # overlaps of pairs are known but of segments that are to be looked at


@cache
def make_check_sweeps(name: str, features: CheckFeatures, module: str = "unique"):
    """`check_segments`, `reduce_check`, `finish_check` in launch order, as a dict by name."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    closest_points = make_closest_points(name)
    has_crossed = make_crossing(PLANAR[name])
    _, image_shift, _, _ = make_pair_geometry(name, PairFeatures(periodic=features.periodic))
    has_wall, wall_gap = make_wall_gap(name, features.walls)
    is_near_array, array_place, _ = make_array_rows(name)
    has_arrays = features.arrays
    zero = real(0.0)
    lost = real(LOST)
    tear2 = real(TEAR_STRETCH * TEAR_STRETCH)
    periodic = features.periodic
    has_walls = any(features.walls)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def check_segments(
        offset: wp.int32,
        widest: real,
        wall_low: vec3,
        wall_high: vec3,
        wall_array: wp.array(dtype=vec2),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        pair_clear: wp.array(dtype=real),
        segment_shift: wp.array(dtype=real),
        shift_again: wp.array(dtype=real),
        row_count: wp.array(dtype=wp.int32),
        segment_look: wp.array(dtype=wp.uint8),
        status: wp.array(dtype=wp.int32),
        overlap_out: wp.array(dtype=real),
        overlap_partner_out: wp.array(dtype=wp.int32),
        crossed_out: wp.array(dtype=wp.int32),
        crossed_partner_out: wp.array(dtype=wp.int32),
    ):
        """Largest overlap of a segment, and how many it passed through; a wall is partner -1.

        A segment that tore, or is nowhere, overlaps without end.
        """
        if status[wp.static(HALT)] != 0:
            return
        i = portioned(wp.tid() + offset, segment_node.shape[0], wp.static(PORTION))
        if wp.static(features.renewed):
            if row_count[0] == 0:
                return
            stayed = shift_again[i] == zero
            for k in range(out_start[i], out_start[i + 1]):
                stayed = stayed and shift_again[pair_j[k]] == zero
            if stayed:
                return
        if wp.static(features.picked and not has_walls and not features.tears):
            if segment_look[i] == wp.uint8(0):
                return
        node_i = segment_node[i]
        xi = node_pos[node_i]
        a = node_pos[node_i + 1] - xi
        longest2 = lost
        if wp.static(features.tears):
            rest = groups[fiber_group[segment_fiber[i]]].rest
            longest2 = tear2 * rest * rest
        is_lost = not (wp.length_sq(xi) < lost and wp.length_sq(a) < longest2)
        if wp.static(features.picked and not has_walls and features.tears):
            if segment_look[i] == wp.uint8(0):
                if is_lost:
                    overlap_out[i] = lost
                crossed_out[i] = 0
                crossed_partner_out[i] = -1
                return
        back_i = node_back[node_i]
        wa = a - (node_back[node_i + 1] - back_i)
        move_i = xi - back_i
        largest = zero
        partner = wp.int32(-1)
        crossed = wp.int32(0)
        crossed_partner = wp.int32(-1)
        pairs_end = out_start[i + 1]
        if wp.static(features.picked and has_walls):
            if segment_look[i] == wp.uint8(0):
                largest = overlap_out[i]
                partner = overlap_partner_out[i]
                pairs_end = out_start[i]
        if is_lost:
            largest = lost
        mine = zero
        if wp.static(features.shifted):
            mine = segment_shift[i]
            if wp.static(features.again):
                mine += shift_again[i]
        for k in range(out_start[i], pairs_end):
            j = pair_j[k]
            if wp.static(features.shifted):
                shifted = mine + segment_shift[j]
                if wp.static(features.again):
                    shifted += shift_again[j]
                if pair_clear[k] - shifted > real(2.0) * widest:
                    continue
            node_j = segment_node[j]
            xj = node_pos[node_j]
            b = node_pos[node_j + 1] - xj
            code = pair_image[k]
            shift = image_shift(code, lattice_now[0])
            delta = xj - xi + shift
            st = closest_points(delta, a, b)
            dd = wp.length_sq(delta + st[1] * b - st[0] * a)
            back_j = node_back[node_j]
            w = xj - back_j - move_i
            if wp.static(periodic):
                w += shift - image_shift(code, lattice_back[0])
            wb = b - (node_back[node_j + 1] - back_j)
            # lines that met are no further apart than they moved: the most that a corner did
            moved2 = wp.max(wp.length_sq(w), wp.length_sq(w - wa))
            moved2 = wp.max(moved2, wp.max(wp.length_sq(w + wb), wp.length_sq(w + wb - wa)))
            looked_at = wp.bool(True)
            if wp.static(features.frozen):
                both = fiber_frozen[segment_fiber[i]] & fiber_frozen[segment_fiber[j]]
                looked_at = both == wp.uint8(0)
            if looked_at and (dd <= moved2 or dd < real(4.0) * widest * widest):
                gi = groups[fiber_group[segment_fiber[i]]]
                gj = groups[fiber_group[segment_fiber[j]]]
                contact = gi.radius + gj.radius
                overlap = (contact - wp.sqrt(dd)) / wp.min(gi.radius, gj.radius)
                if overlap > largest:
                    largest = overlap
                    partner = j
                if dd <= moved2:
                    if has_crossed(
                        wp.vec3d(delta - w),
                        wp.vec3d(a - wa),
                        wp.vec3d(b - wb),
                        wp.vec3d(w),
                        wp.vec3d(wa),
                        wp.vec3d(wb),
                        wp.float64(contact),
                    ):
                        crossed += 1
                        crossed_partner = j
        if wp.static(has_walls):
            fiber = segment_fiber[i]
            radius = groups[fiber_group[fiber]].radius
            first = wp.int32(1)
            if node_i == fiber_node_start[fiber]:
                first = 0
            if wp.static(features.frozen):
                if fiber_frozen[fiber] != wp.uint8(0):
                    first = 2
            for node in range(node_i + first, node_i + 2):
                for axis in range(3):
                    if has_wall(axis):
                        for side in range(2):
                            y = wall_gap(node_pos[node], axis, side, wall_low, wall_high)
                            if wp.static(has_arrays):
                                behind = wall_array[2 * axis + side][1]
                                if behind > zero:  # past the middles of its fibers
                                    if y + behind < zero:
                                        crossed += 1
                                        crossed_partner = -1
                                    continue
                            overlap = (radius - y) / radius
                            if overlap > largest:
                                largest = overlap
                                partner = -1
                            if y < zero:
                                crossed += 1
                                crossed_partner = -1
            if wp.static(has_arrays):
                begin = 2 * first
                if first == 2:
                    begin = wp.static(PLACES)
                for axis in range(1, 3):
                    for side in range(2):
                        shape = wall_array[2 * axis + side]
                        if shape[1] == zero or not is_near_array(
                            xi, xi + a, axis, side, wall_low, wall_high, radius
                        ):
                            continue
                        for place in range(begin, wp.static(PLACES)):
                            _t, _n, gap = array_place(
                                place,
                                xi,
                                xi + a,
                                axis,
                                side,
                                wall_low,
                                wall_high,
                                shape,
                                radius,
                            )
                            if -gap / radius > largest:
                                largest = -gap / radius
                                partner = -1
        overlap_out[i] = largest
        overlap_partner_out[i] = partner
        crossed_out[i] = crossed
        crossed_partner_out[i] = crossed_partner

    @wp.kernel(**options)
    def reduce_check(
        chunks: wp.int32,
        segment_overlap: wp.array(dtype=real),
        segment_crossed: wp.array(dtype=wp.int32),
        row_count: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        overlap_at_out: wp.array(dtype=wp.int32),
        crossed_out: wp.array(dtype=wp.int32),
        crossed_at_out: wp.array(dtype=wp.int32),
    ):
        """Segment with the largest overlap of every run of segments, and its crossings."""
        if status[wp.static(HALT)] != 0:
            return
        if wp.static(features.renewed):  # else nothing was looked at again
            if row_count[0] == 0:
                return
        chunk = wp.tid()
        segments = wp.int64(segment_overlap.shape[0])
        begin = wp.int32(segments * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(segments * wp.int64(chunk + 1) / wp.int64(chunks))
        at = begin
        crossed = wp.int32(0)
        crossed_at = wp.int32(-1)
        for i in range(begin, end):
            if segment_overlap[i] > segment_overlap[at]:
                at = i
            if segment_crossed[i] > 0:
                crossed += segment_crossed[i]
                crossed_at = i
        overlap_at_out[chunk] = at
        crossed_out[chunk] = crossed
        crossed_at_out[chunk] = crossed_at

    @wp.kernel(**options)
    def finish_check(
        segment_overlap: wp.array(dtype=real),
        overlap_partner: wp.array(dtype=wp.int32),
        crossed_partner: wp.array(dtype=wp.int32),
        overlap_at: wp.array(dtype=wp.int32),
        crossed_of: wp.array(dtype=wp.int32),
        crossed_at: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        largest_out: wp.array(dtype=wp.float64),
        found_out: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        at = overlap_at[0]
        crossed = wp.int32(0)
        last = wp.int32(-1)
        for chunk in range(overlap_at.shape[0]):
            if segment_overlap[overlap_at[chunk]] > segment_overlap[at]:
                at = overlap_at[chunk]
            if crossed_of[chunk] > 0:
                crossed += crossed_of[chunk]
                last = crossed_at[chunk]
        largest_out[0] = wp.float64(segment_overlap[at])
        found_out[0] = crossed
        found_out[1] = at
        found_out[2] = overlap_partner[at]
        found_out[3] = last
        found_out[4] = -1
        if last >= 0:
            found_out[4] = crossed_partner[last]

    return {
        "check_segments": check_segments,
        "reduce_check": reduce_check,
        "finish_check": finish_check,
    }
