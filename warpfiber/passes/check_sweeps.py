"""Sweeps over the end of a step: overlaps, center lines that passed through each other, the list.

One thread per segment looks at its outgoing pairs that may have met and at its nodes; runs of
segments are reduced in order, so the result does not depend on the workers.

Source: four points that move in straight lines are in one plane where a cubic of the time is 0; the
    lines pass through each other there if they meet between their ends. The cubic is split at its
    extrema, its roots are found by bisection. Where it is 0 throughout (motion in a plane, parallel
    lines) the distance is looked at in small steps of the time instead.
Symbols: tau in [0, 1] time within the step; D(tau) from the start of a to the start of b, an image
    with its box vector; V(tau) = D.(a x b); overlap (a_i + a_j - d) / min(a_i, a_j).
Limits: all that moves, moves in a straight line over the step.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.pairs import PairFeatures, make_pair_geometry
from warpfiber.passes.precision import group_struct
from warpfiber.passes.row_geometry import make_closest_points, make_wall_gap

BISECTIONS = 52
PLANAR_STEPS = 64
# Volumes of less than this share of contact distance and lengths are only rounding.
PLANAR = {"float32": 1e-5, "float64": 1e-9}
INSIDE = 1e-9  # of a segment: a crossing at a joint is one of both segments
NEAR_ZERO = 0.1  # of the contact distance: center lines this near in a plane have met


@dataclass(frozen=True)
class CheckFeatures:
    """What the check of a scene contains."""

    periodic: bool = False
    walls: tuple[bool, bool, bool] = (False, False, False)
    frozen: bool = False  # some fibers are; nothing moves two of them, or one from a wall
    shifted: bool = False  # it is known how near pairs come but for contact, and what that adds
    again: bool = False  # twice


@cache
def make_crossing(planar: float):
    """`has_crossed(D, a, b, w, wa, wb, contact)`: whether two moving lines met; float64."""
    closest_points = make_closest_points("float64")
    zero, one, rounding = wp.float64(0.0), wp.float64(1.0), wp.float64(planar)
    low, high = wp.float64(-INSIDE), wp.float64(1.0 + INSIDE)

    @wp.func
    def cubic(c: wp.vec4d, tau: wp.float64) -> wp.float64:
        return c[0] + tau * (c[1] + tau * (c[2] + tau * c[3]))

    @wp.func
    def meet(
        tau: wp.float64,
        delta: wp.vec3d,
        a: wp.vec3d,
        b: wp.vec3d,
        w: wp.vec3d,
        wa: wp.vec3d,
        wb: wp.vec3d,
    ) -> wp.bool:
        """Whether the lines, in one plane at tau, meet between their ends."""
        d = delta + tau * w
        p = a + tau * wa
        q = b + tau * wb
        normal = wp.cross(p, q)
        area2 = wp.dot(normal, normal)
        if not (area2 > zero):
            return False
        s = wp.dot(wp.cross(d, q), normal) / area2
        t = wp.dot(wp.cross(d, p), normal) / area2
        return s >= low and s <= high and t >= low and t <= high

    @wp.func
    def has_crossed(
        delta: wp.vec3d,
        a: wp.vec3d,
        b: wp.vec3d,
        w: wp.vec3d,
        wa: wp.vec3d,
        wb: wp.vec3d,
        contact: wp.float64,
    ) -> wp.bool:
        n0 = wp.cross(a, b)
        n1 = wp.cross(wa, b) + wp.cross(a, wb)
        n2 = wp.cross(wa, wb)
        c = wp.vec4d(
            wp.dot(delta, n0),
            wp.dot(delta, n1) + wp.dot(w, n0),
            wp.dot(delta, n2) + wp.dot(w, n1),
            wp.dot(w, n2),
        )
        size = wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2]) + wp.abs(c[3])
        scale = rounding * contact * (wp.length(a) + wp.length(wa))
        if size <= scale * (wp.length(b) + wp.length(wb)):
            before = zero
            for step in range(wp.static(PLANAR_STEPS + 1)):
                tau = wp.float64(step) / wp.float64(wp.static(PLANAR_STEPS))
                d = delta + tau * w
                p = a + tau * wa
                q = b + tau * wb
                st = closest_points(d, p, q)
                distance = wp.length(d + st[1] * q - st[0] * p)
                if step == 0:
                    before = distance
                near = wp.float64(wp.static(NEAR_ZERO)) * contact
                if distance < near and before >= near:
                    return True
            return False
        # ends of the monotonic parts of the cubic
        first = one
        second = one
        if wp.abs(c[3]) > wp.float64(1e-14) * size:
            root = c[2] * c[2] - wp.float64(3.0) * c[3] * c[1]
            if root > zero:
                # the root without cancellation, and the other by their product
                sum_of = -c[2] - wp.sqrt(root)
                if c[2] < zero:
                    sum_of = -c[2] + wp.sqrt(root)
                first = sum_of / (wp.float64(3.0) * c[3])
                second = first
                if sum_of != zero:
                    second = c[1] / sum_of
        elif wp.abs(c[2]) > zero:
            first = -c[1] / (wp.float64(2.0) * c[2])
            second = first
        left = wp.clamp(wp.min(first, second), zero, one)
        right = wp.clamp(wp.max(first, second), zero, one)
        begin = zero
        for part in range(3):
            end = left
            if part == 1:
                end = right
            if part == 2:
                end = one
            u = begin
            v = end
            begin = end
            at_u = cubic(c, u)
            at_v = cubic(c, v)
            if at_u * at_v <= zero and u < v:
                for _step in range(wp.static(BISECTIONS)):
                    middle = wp.float64(0.5) * (u + v)
                    value = cubic(c, middle)
                    if value * at_u > zero:
                        u = middle
                    else:
                        v = middle
                if meet(v, delta, a, b, w, wa, wb):
                    return True
        return False

    return has_crossed


@cache
def make_check_sweeps(name: str, features: CheckFeatures, module: str = "unique"):
    """`check_segments`, `reduce_check`, `finish_check` in launch order, as a dict by name."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    closest_points = make_closest_points(name)
    has_crossed = make_crossing(PLANAR[name])
    _, image_shift, _, _ = make_pair_geometry(name, PairFeatures(periodic=features.periodic))
    has_wall, wall_gap = make_wall_gap(name, features.walls)
    zero = real(0.0)
    lost = real(1e30)
    periodic = features.periodic
    has_walls = any(features.walls)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def check_segments(
        offset: wp.int32,
        widest: real,
        wall_low: vec3,
        wall_high: vec3,
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
        status: wp.array(dtype=wp.int32),
        overlap_out: wp.array(dtype=real),
        overlap_partner_out: wp.array(dtype=wp.int32),
        crossed_out: wp.array(dtype=wp.int32),
        crossed_partner_out: wp.array(dtype=wp.int32),
    ):
        """Largest overlap of a segment, and how many it passed through; a wall is partner -1."""
        if status[wp.static(HALT)] != 0:
            return
        i = wp.tid() + offset
        node_i = segment_node[i]
        xi = node_pos[node_i]
        a = node_pos[node_i + 1] - xi
        back_i = node_back[node_i]
        wa = a - (node_back[node_i + 1] - back_i)
        move_i = xi - back_i
        largest = zero
        partner = wp.int32(-1)
        crossed = wp.int32(0)
        crossed_partner = wp.int32(-1)
        if not (wp.length_sq(xi) < lost and wp.length_sq(a) < lost):
            largest = lost
        mine = zero
        if wp.static(features.shifted):
            mine = segment_shift[i]
            if wp.static(features.again):
                mine += shift_again[i]
        for k in range(out_start[i], out_start[i + 1]):
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
                            overlap = (radius - y) / radius
                            if overlap > largest:
                                largest = overlap
                                partner = -1
                            if y < zero:
                                crossed += 1
                                crossed_partner = -1
        overlap_out[i] = largest
        overlap_partner_out[i] = partner
        crossed_out[i] = crossed
        crossed_partner_out[i] = crossed_partner

    @wp.kernel(**options)
    def reduce_check(
        chunks: wp.int32,
        segment_overlap: wp.array(dtype=real),
        segment_crossed: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        overlap_at_out: wp.array(dtype=wp.int32),
        crossed_out: wp.array(dtype=wp.int32),
        crossed_at_out: wp.array(dtype=wp.int32),
    ):
        """Segment with the largest overlap of every run of segments, and its crossings."""
        if status[wp.static(HALT)] != 0:
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
