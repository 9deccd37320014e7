"""Rows of contact written out: place, normal, predicted gap, and the force they start from.

One thread owns a segment and writes its rows in the order of pair and slot, those of walls last,
so that the rows do not depend on the workers.

Source: b = g + n.w(s, t) with the gap at the start of the step; lubrication b = n.w, compliance
    dt / c. A row starts from the force that the same row (partner, slot or beads, image) had in
    the last step.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.array_rows import PLACES, make_array_rows
from warpfiber.passes.bead_rows import make_bead_rows
from warpfiber.passes.pairs import PairFeatures, make_image, make_pair_geometry
from warpfiber.passes.portions import PORTION, portioned
from warpfiber.passes.precision import group_struct
from warpfiber.passes.row_count import RowFeatures
from warpfiber.passes.row_geometry import SLOTS, make_row_geometry, make_wall_gap

WALL = -1  # partner of a row with a plane wall
# A row is found again by partner and key: slot, or pair of beads, and image. Equal keys of
# different rows would only be a worse start of the solution.
KEY_IMAGE = (16, 16 * 1021, 16 * 1021 * 1021)
KEY_BEADS = (7, 8209, 131101)


@cache
def make_row_fill(name: str, features: RowFeatures, module: str = "unique"):
    """Kernel `fill_rows` in the given precision with the given features, over segments."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    _, row_fractions, row_normal_gap, _ = make_row_geometry(name)
    is_shifted = features.lubrication == "shifted"
    owned_beads, bead_range, bead_resistance = make_bead_rows(name, is_shifted)
    _, image_shift, _, _ = make_pair_geometry(name, PairFeatures(periodic=features.periodic))
    unpack_image = make_image(name)
    has_wall, wall_gap = make_wall_gap(name, features.walls)
    is_near_array, array_place, array_key = make_array_rows(name)
    has_arrays = features.arrays
    zero = real(0.0)
    periodic = features.periodic
    has_lubrication = features.lubrication != "none"
    has_walls = any(features.walls)

    @wp.func
    def image_key(code: wp.int32, image_i: wp.vec3i, image_j: wp.vec3i) -> wp.int32:
        """Same number for one pair of images however often both fibers were wrapped."""
        m = unpack_image(code)
        x = wp.int32(m[0]) - image_j[0] + image_i[0]
        y = wp.int32(m[1]) - image_j[1] + image_i[1]
        z = wp.int32(m[2]) - image_j[2] + image_i[2]
        return (
            wp.static(KEY_IMAGE[0]) * x + wp.static(KEY_IMAGE[1]) * y + wp.static(KEY_IMAGE[2]) * z
        )

    @wp.func
    def carried_row_force(
        j: wp.int32,
        key: wp.int32,
        begin: wp.int32,
        end: wp.int32,
        carried_j: wp.array(dtype=wp.int32),
        carried_key: wp.array(dtype=wp.int32),
        carried_force: wp.array(dtype=real),
    ) -> real:
        for q in range(begin, end):
            if carried_j[q] == j and carried_key[q] == key:
                return carried_force[q]
        return zero

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def fill_rows(
        offset: wp.int32,
        keep: real,
        near_now: real,
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
        fiber_image: wp.array(dtype=wp.vec3i),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_foreseen: wp.array(dtype=vec3),
        step_size: wp.array(dtype=wp.float64),
        carried_start: wp.array(dtype=wp.int32),
        carried_j: wp.array(dtype=wp.int32),
        carried_key: wp.array(dtype=wp.int32),
        carried_force: wp.array(dtype=real),
        row_need: wp.array(dtype=wp.int32),
        pair_slots: wp.array(dtype=wp.uint8),
        pair_row_count: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        pair_row_out: wp.array(dtype=wp.int32),
        row_i_out: wp.array(dtype=wp.int32),
        row_j_out: wp.array(dtype=wp.int32),
        row_key_out: wp.array(dtype=wp.int32),
        row_s_out: wp.array(dtype=real),
        row_t_out: wp.array(dtype=real),
        row_normal_out: wp.array(dtype=vec3),
        row_base_out: wp.array(dtype=real),
        row_compliance_out: wp.array(dtype=real),
        row_force_out: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        i = portioned(wp.tid() + offset, segment_node.shape[0], wp.static(PORTION))
        if row_need[0] > 0:  # rows that do not fit are none
            row_out_start[i + 1] = 0
            for k in range(out_start[i], out_start[i + 1]):
                pair_row_count[k] = 0
            return
        if wp.static(features.filled and not has_walls):
            return
        r = row_out_start[i]
        if r == row_out_start[i + 1]:
            return
        first_carried = carried_start[i]
        last_carried = carried_start[i + 1]
        node_i = segment_node[i]
        xi = node_back[node_i]
        a = node_back[node_i + 1] - xi
        move_i = node_pos[node_i] - xi
        wa = node_pos[node_i + 1] - node_back[node_i + 1] - move_i
        fiber_i = segment_fiber[i]
        gi = groups[fiber_group[fiber_i]]
        for k in range(out_start[i], out_start[i + 1]):
            if wp.static(features.filled):
                r += pair_row_count[k]
                continue
            if pair_row_count[k] == 0:
                continue
            pair_row_out[k] = r
            j = pair_j[k]
            node_j = segment_node[j]
            fiber_j = segment_fiber[j]
            gj = groups[fiber_group[fiber_j]]
            contact = gi.radius + gj.radius
            xj = node_back[node_j]
            b = node_back[node_j + 1] - xj
            code = pair_image[k]
            shift = image_shift(code, lattice_back[0])
            delta = xj - xi + shift
            move_j = node_pos[node_j] - xj
            w = move_j - move_i
            base_key = wp.int32(0)
            if wp.static(periodic):
                w += image_shift(code, lattice_now[0]) - shift
                base_key = image_key(code, fiber_image[fiber_i], fiber_image[fiber_j])
            wb = node_pos[node_j + 1] - node_back[node_j + 1] - move_j
            slots = wp.int32(pair_slots[k])
            for slot in range(wp.static(SLOTS)):
                if ((slots >> slot) & 1) != 0:
                    st = row_fractions(slot, delta, a, b)
                    normal, gap = row_normal_gap(st, delta, a, b, contact)
                    key = base_key + slot
                    row_i_out[r] = i
                    row_j_out[r] = j
                    row_key_out[r] = key
                    row_s_out[r] = st[0]
                    row_t_out[r] = st[1]
                    row_normal_out[r] = normal
                    row_base_out[r] = gap + wp.dot(normal, w + st[1] * wb - st[0] * wa)
                    row_compliance_out[r] = zero
                    row_force_out[r] = carried_row_force(
                        j, key, first_carried, last_carried, carried_j, carried_key, carried_force
                    )
                    r += 1
            if wp.static(has_lubrication):
                at_i = node_i - fiber_node_start[fiber_i]
                at_j = node_j - fiber_node_start[fiber_j]
                count_i = owned_beads(gi, at_i)
                count_j = owned_beads(gj, at_j)
                for m in range(count_i):
                    s = real(m) / real(gi.inner_beads + 1)
                    c0 = delta - s * a
                    near = bead_range(c0, b, gj, count_j, contact)
                    for n in range(near[0], near[1] + 1):
                        t = real(n) / real(gj.inner_beads + 1)
                        c = c0 + t * b
                        distance = wp.length(c)
                        resistance = bead_resistance(gi, gj, m, n, distance)
                        if resistance > zero:
                            normal = c / distance
                            key = base_key + wp.static(KEY_BEADS[0])
                            key += wp.static(KEY_BEADS[1]) * m + wp.static(KEY_BEADS[2]) * n
                            row_i_out[r] = i
                            row_j_out[r] = j
                            row_key_out[r] = key
                            row_s_out[r] = s
                            row_t_out[r] = t
                            row_normal_out[r] = normal
                            row_base_out[r] = wp.dot(normal, w + t * wb - s * wa)
                            row_compliance_out[r] = real(step_size[0]) / resistance
                            row_force_out[r] = carried_row_force(
                                j,
                                key,
                                first_carried,
                                last_carried,
                                carried_j,
                                carried_key,
                                carried_force,
                            )
                            r += 1
        if wp.static(has_walls):
            first = wp.int32(1)
            if node_i == fiber_node_start[fiber_i]:
                first = 0
            for node in range(node_i + first, node_i + 2):
                for axis in range(3):
                    if has_wall(axis):
                        for side in range(2):
                            if wp.static(has_arrays):
                                if wall_array[2 * axis + side][1] > zero:
                                    continue
                            gap = wall_gap(node_foreseen[node], axis, side, wall_low, wall_high)
                            now = wall_gap(node_back[node], axis, side, wall_low, wall_high)
                            closes = gap - gi.radius < keep * gi.radius
                            if closes or now - gi.radius < near_now * gi.radius:
                                gap = wall_gap(node_pos[node], axis, side, wall_low, wall_high)
                                normal = vec3(zero, zero, zero)
                                normal[axis] = real(2 * side - 1)
                                key = 4 * axis + 2 * side + (node - node_i)
                                row_i_out[r] = i
                                row_j_out[r] = wp.static(WALL)
                                row_key_out[r] = key
                                row_s_out[r] = real(node - node_i)
                                row_t_out[r] = zero
                                row_normal_out[r] = normal
                                row_base_out[r] = gap - gi.radius
                                row_compliance_out[r] = zero
                                row_force_out[r] = carried_row_force(
                                    wp.static(WALL),
                                    key,
                                    first_carried,
                                    last_carried,
                                    carried_j,
                                    carried_key,
                                    carried_force,
                                )
                                r += 1
            if wp.static(has_arrays):
                seen_i = node_foreseen[node_i] - xi
                seen_a = node_foreseen[node_i + 1] - xi - a - seen_i
                moved = wp.max(wp.length(seen_i), wp.length(seen_i + seen_a))
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
                            (real(1.0) + wp.max(keep, near_now)) * gi.radius + moved,
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
                                gi.radius,
                            )
                            gap_next = gap - wp.dot(normal, seen_i + t * seen_a)
                            if gap_next < keep * gi.radius or gap < near_now * gi.radius:
                                base = gap - wp.dot(normal, move_i + t * wa)
                                key = array_key(place, xi, xi + a, axis, side, wall_low, shape)
                                row_i_out[r] = i
                                row_j_out[r] = wp.static(WALL)
                                row_key_out[r] = key
                                row_s_out[r] = t
                                row_t_out[r] = zero
                                row_normal_out[r] = normal
                                row_base_out[r] = base
                                row_compliance_out[r] = zero
                                row_force_out[r] = carried_row_force(
                                    wp.static(WALL),
                                    key,
                                    first_carried,
                                    last_carried,
                                    carried_j,
                                    carried_key,
                                    carried_force,
                                )
                                r += 1

    return fill_rows
