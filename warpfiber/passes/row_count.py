"""How many rows of contact every segment has, and the forces of the last rows put aside.

One thread owns a segment, its outgoing pairs and its nodes (of a joint the segment that ends
there). Which slots of a pair have a row is decided here and stored, for what `pair_motion` left
open; the fill looks at those alone.

Source: rows of `row_geometry`, with the geometry at the start of the step and the motion of the
    step without contact forces; plane walls, one row per node.
Symbols: w(s, t) relative motion, of an image with that of its box vector.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.laws.lubrication import OUTER
from warpfiber.model import HALT, precision
from warpfiber.passes.array_rows import PLACES, make_array_rows
from warpfiber.passes.bead_rows import make_bead_rows
from warpfiber.passes.native_row_slots import LOOK
from warpfiber.passes.pairs import NO_IMAGE, PairFeatures, make_pair_geometry
from warpfiber.passes.portions import PORTION, portioned
from warpfiber.passes.precision import group_struct
from warpfiber.passes.row_geometry import (
    SLOTS,
    make_closest_points,
    make_row_geometry,
    make_wall_gap,
)


@dataclass(frozen=True)
class RowFeatures:
    """What the rows of a scene contain; everything else is not compiled."""

    periodic: bool = False
    walls: tuple[bool, bool, bool] = (False, False, False)
    lubrication: str = "none"  # none, paper, shifted
    arrays: bool = False  # some walls are arrays of fibers
    chosen: bool = False  # rows of some segments alone
    filled: bool = False  # those of pairs are written in vectors


@cache
def make_row_count(name: str, features: RowFeatures, module: str = "unique"):
    """`carry_rows`, `count_rows`, `limit_rows` in launch order, as a dict by name."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    largest_motion, _, _, kept_slots = make_row_geometry(name)
    closest_points = make_closest_points(name)
    is_shifted = features.lubrication == "shifted"
    owned_beads, bead_range, bead_resistance = make_bead_rows(name, is_shifted)
    _, image_shift, _, _ = make_pair_geometry(name, PairFeatures(periodic=features.periodic))
    has_wall, wall_gap = make_wall_gap(name, features.walls)
    is_near_array, array_place, _ = make_array_rows(name)
    has_arrays = features.arrays
    zero = real(0.0)
    outer = real(OUTER)
    periodic = features.periodic
    has_lubrication = features.lubrication != "none"
    has_walls = any(features.walls)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def carry_rows(
        offset: wp.int32,
        run: wp.int32,
        row_out_start: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_key: wp.array(dtype=wp.int32),
        row_force: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        carried_start_out: wp.array(dtype=wp.int32),
        carried_j_out: wp.array(dtype=wp.int32),
        carried_key_out: wp.array(dtype=wp.int32),
        carried_force_out: wp.array(dtype=real),
    ):
        """Rows of a run of segments lie behind each other."""
        if status[wp.static(HALT)] != 0:
            return
        first = (wp.tid() + offset) * run
        last = wp.min(first + run, row_out_start.shape[0] - 1)
        for i in range(first, last):
            carried_start_out[i + 1] = row_out_start[i + 1]
        for r in range(row_out_start[first], row_out_start[last]):
            carried_j_out[r] = row_j[r]
            carried_key_out[r] = row_key[r]
            carried_force_out[r] = row_force[r]

    @wp.kernel(**options)
    def count_rows(
        offset: wp.int32,
        keep: real,
        near_now: real,
        widest: real,
        wall_low: vec3,
        wall_high: vec3,
        wall_array: wp.array(dtype=vec2),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        segment_chosen: wp.array(dtype=wp.uint8),
        segment_look: wp.array(dtype=wp.uint8),
        pair_slots_out: wp.array(dtype=wp.uint8),
        pair_row_count_out: wp.array(dtype=wp.int32),
        segment_rows_out: wp.array(dtype=wp.int32),
    ):
        """`keep`, `near_now` in radii of the thinner fiber, `widest` the largest radius of all.

        `segment_rows`: those decided so far, unless some segments are chosen.
        """
        if status[wp.static(HALT)] != 0:
            return
        i = portioned(wp.tid() + offset, segment_node.shape[0], wp.static(PORTION))
        if wp.static(features.chosen):
            if segment_chosen[i] == wp.uint8(0):  # cleared by `overlap_choice`
                return
        if wp.static(not features.chosen and not has_walls):
            if segment_look[i] == wp.uint8(0):
                return
        node_i = segment_node[i]
        xi = node_back[node_i]
        a = node_back[node_i + 1] - xi
        move_i = node_pos[node_i] - xi
        wa = node_pos[node_i + 1] - node_back[node_i + 1] - move_i
        reach = (real(2.0) + wp.max(keep, near_now)) * widest
        total = wp.int32(0)
        pairs_end = out_start[i + 1]
        if wp.static(not features.chosen):
            total = segment_rows_out[i]
            if segment_look[i] == wp.uint8(0):
                pairs_end = out_start[i]
        for k in range(out_start[i], pairs_end):
            if pair_slots_out[k] != wp.uint8(wp.static(LOOK)):
                if wp.static(features.chosen):
                    pair_row_count_out[k] = 0
                continue
            j = pair_j[k]
            node_j = segment_node[j]
            xj = node_back[node_j]
            xj1 = node_back[node_j + 1]
            b = xj1 - xj
            code = pair_image[k]
            shift = image_shift(code, lattice_back[0])
            delta = xj - xi + shift
            move_j = node_pos[node_j] - xj
            w = move_j - move_i
            if wp.static(periodic):
                w += image_shift(code, lattice_now[0]) - shift
            wb = node_pos[node_j + 1] - xj1 - move_j
            st = closest_points(delta, a, b)
            dd = wp.length_sq(delta + st[1] * b - st[0] * a)
            far = reach + largest_motion(w, wa, wb)
            slots = wp.int32(0)
            rows = wp.int32(0)
            is_near = dd < far * far
            is_wet = wp.bool(False)
            if wp.static(has_lubrication):
                is_wet = dd <= real(4.0) * outer * outer * widest * widest
            if is_near or is_wet:
                fiber_i = segment_fiber[i]
                fiber_j = segment_fiber[j]
                gi = groups[fiber_group[fiber_i]]
                gj = groups[fiber_group[fiber_j]]
                contact = gi.radius + gj.radius
                arc = wp.min(gi.radius, gj.radius)
                at_i = node_i - fiber_node_start[fiber_i]
                at_j = node_j - fiber_node_start[fiber_j]
                if is_near:
                    if fiber_i == fiber_j and code == wp.static(NO_IMAGE):
                        # the list lacks the segments next along the fiber: every pair for itself
                        slots = kept_slots(
                            st,
                            delta,
                            a,
                            b,
                            w,
                            wa,
                            wb,
                            contact,
                            keep * arc,
                            near_now * arc,
                            far,
                            arc,
                            node_i,
                            0,
                            1,
                            node_j,
                            0,
                            1,
                            node_back,
                        )
                    else:
                        slots = kept_slots(
                            st,
                            delta,
                            a,
                            b,
                            w,
                            wa,
                            wb,
                            contact,
                            keep * arc,
                            near_now * arc,
                            far,
                            arc,
                            node_i,
                            at_i,
                            gi.segments,
                            node_j,
                            at_j,
                            gj.segments,
                            node_back,
                        )
                    for slot in range(wp.static(SLOTS)):
                        rows += (slots >> slot) & 1
                if wp.static(has_lubrication):
                    count_i = owned_beads(gi, at_i)
                    count_j = owned_beads(gj, at_j)
                    for m in range(count_i):
                        c0 = delta - (real(m) / real(gi.inner_beads + 1)) * a
                        near = bead_range(c0, b, gj, count_j, contact)
                        for n in range(near[0], near[1] + 1):
                            c = c0 + (real(n) / real(gj.inner_beads + 1)) * b
                            if bead_resistance(gi, gj, m, n, wp.length(c)) > zero:
                                rows += 1
            pair_slots_out[k] = wp.uint8(slots)
            pair_row_count_out[k] = rows
            total += rows
        if wp.static(has_walls):
            fiber = segment_fiber[i]
            radius = groups[fiber_group[fiber]].radius
            first = wp.int32(1)
            if node_i == fiber_node_start[fiber]:
                first = 0
            for node in range(node_i + first, node_i + 2):
                for axis in range(3):
                    if has_wall(axis):
                        for side in range(2):
                            if wp.static(has_arrays):
                                if wall_array[2 * axis + side][1] > zero:
                                    continue
                            y = wall_gap(node_pos[node], axis, side, wall_low, wall_high)
                            now = wall_gap(node_back[node], axis, side, wall_low, wall_high)
                            if y - radius < keep * radius or now - radius < near_now * radius:
                                total += 1
            if wp.static(has_arrays):
                moved = wp.max(wp.length(move_i), wp.length(move_i + wa))
                for axis in range(1, 3):
                    for side in range(2):
                        shape = wall_array[2 * axis + side]
                        if shape[1] == zero or not is_near_array(
                            xi,
                            xi + a,
                            axis,
                            side,
                            wall_low,
                            wall_high,
                            (real(1.0) + wp.max(keep, near_now)) * radius + moved,
                        ):
                            continue
                        for place in range(2 * first, wp.static(PLACES)):
                            t, normal, gap = array_place(
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
                            gap_next = gap - wp.dot(normal, move_i + t * wa)
                            if gap_next < keep * radius or gap < near_now * radius:
                                total += 1
        segment_rows_out[i] = total

    @wp.kernel(**options)
    def limit_rows(
        segments: wp.int32,
        capacity: wp.int32,
        row_out_start: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        row_count_out: wp.array(dtype=wp.int32),
        row_need_out: wp.array(dtype=wp.int32),
        pairs_known_out: wp.array(dtype=wp.int32),
    ):
        """Rows that there are; none, and how many are needed, if they do not fit.

        What is known of the pairs is of the end of the step now, which may be taken back.
        """
        if status[wp.static(HALT)] != 0:
            return
        pairs_known_out[0] = 0
        total = row_out_start[segments]
        row_need_out[0] = 0
        if total > capacity:
            row_need_out[0] = total
            total = 0
        row_count_out[0] = total

    return {"carry_rows": carry_rows, "count_rows": count_rows, "limit_rows": limit_rows}
