"""Rows of contact between two segments: where they act, which of them count, normal and gap.

Slot 0 is the pair of closest points, slots 1 and 2 are the last and first node of segment i against
the nearest point of segment j, 3 and 4 those of j against i. The ends of an overlap between
parallel fibers block the turning about a single point.

Source: closed forms on lines. A row within one radius of a row already kept, along both fibers, is
    left out, unless it is nearer. In a chain a joint belongs to the segment that ends there, so
    that it gives one row per place of the other fiber that is nearest to it, whatever number of
    segments meet.
Symbols: D = `delta` from the start of a to the start of b, s and t fractions of a and b; relative
    motion over the step w(s, t) = w_0 + t w_b - s w_a; gap g = |c| - a_i - a_j, c = D + t b - s a.
Limits: center lines that cross exactly have the normal a x b, whatever side they came from.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision
from warpfiber.passes.pairs import END_TOLERANCE

SLOTS = 5
PARALLEL = 1e-9  # sin^2 of the angle below which closest points are not unique
# Distance (run units) below which rounding decides on the direction between closest points.
CLOSER = 0.999  # a place stands for one beside it unless that is nearer, by more than this share
CROSSING = {"float32": 1e-5, "float64": 1e-12}


@cache
def make_closest_points(name: str):
    """`closest_points(D, a, b)` -> (s, t), for parallel segments as near the middle of a as any."""
    p = precision(name)
    real, vec2, vec3 = p.real, p.vec2, p.vec3
    zero, one, half, tiny = real(0.0), real(1.0), real(0.5), real(1e-30)
    parallel = real(PARALLEL)

    @wp.func
    def closest_points(delta: vec3, a: vec3, b: vec3) -> vec2:
        # products of cross products: nearly parallel lines lose no digits in single precision
        aa = wp.max(wp.dot(a, a), tiny)
        bb = wp.max(wp.dot(b, b), tiny)
        ab = wp.dot(a, b)
        db = wp.dot(delta, b)
        normal = wp.cross(a, b)
        area2 = wp.dot(normal, normal)
        s = half
        if area2 >= parallel * aa * bb:
            s = wp.clamp(wp.dot(wp.cross(delta, b), normal) / area2, zero, one)
        t = wp.clamp((s * ab - db) / bb, zero, one)
        s = wp.clamp((t * ab + wp.dot(delta, a)) / aa, zero, one)
        return vec2(s, t)

    return closest_points


@cache
def make_row_geometry(name: str):
    """`largest_motion`, `row_fractions`, `row_normal_gap`, `kept_slots`."""
    p = precision(name)
    real, vec2, vec3 = p.real, p.vec2, p.vec3
    closest_points = make_closest_points(name)
    zero, one, half = real(0.0), real(1.0), real(0.5)
    near = real(END_TOLERANCE[name])
    crossing = real(CROSSING[name])
    closer = real(CLOSER * CLOSER)

    @wp.func
    def largest_motion(w: vec3, wa: vec3, wb: vec3) -> real:
        """Largest |w(s, t)|: that of a corner."""
        most = wp.max(wp.length_sq(w), wp.length_sq(w - wa))
        return wp.sqrt(wp.max(most, wp.max(wp.length_sq(w + wb), wp.length_sq(w + wb - wa))))

    @wp.func
    def row_fractions(slot: wp.int32, delta: vec3, a: vec3, b: vec3) -> vec2:
        if slot == 0:
            return closest_points(delta, a, b)
        if slot <= 2:
            s = real(2 - slot)
            return vec2(s, wp.clamp(-wp.dot(delta - s * a, b) / wp.dot(b, b), zero, one))
        t = real(4 - slot)
        return vec2(wp.clamp(wp.dot(delta + t * b, a) / wp.dot(a, a), zero, one), t)

    @wp.func
    def row_normal_gap(st: vec2, delta: vec3, a: vec3, b: vec3, contact: real):
        """Unit normal from i to j and gap."""
        c = delta + st[1] * b - st[0] * a
        distance = wp.length(c)
        if distance > crossing:
            return c / distance, distance - contact
        normal = wp.cross(a, b)
        if not (wp.length_sq(normal) > crossing * wp.length_sq(a) * wp.length_sq(b)):
            # any normal of a: that of the axis which it is farthest from
            axis = vec3(one, zero, zero)
            if wp.abs(a[1]) < wp.abs(a[0]) and wp.abs(a[1]) <= wp.abs(a[2]):
                axis = vec3(zero, one, zero)
            elif wp.abs(a[2]) < wp.abs(a[0]):
                axis = vec3(zero, zero, one)
            normal = wp.cross(a, axis)
        return wp.normalize(normal), distance - contact

    @wp.func
    def is_close(
        st: vec2,
        delta: vec3,
        a: vec3,
        b: vec3,
        w: vec3,
        wa: vec3,
        wb: vec3,
        contact: real,
        keep: real,
        near_now: real,
    ) -> wp.bool:
        """Predicted gap below `keep`, or the gap itself below `near_now`."""
        normal, gap = row_normal_gap(st, delta, a, b, contact)
        return gap < near_now or gap + wp.dot(normal, w + st[1] * wb - st[0] * wa) < keep

    @wp.func
    def freedom(s: real, at: wp.int32, segments: wp.int32, least: real) -> real:
        """1 at a free end of the fiber, `least` far from it."""
        free = least
        if at == 0:
            free = wp.max(free, one - s)
        if at == segments - 1:
            free = wp.max(free, s)
        return free

    @wp.func
    def is_joint(s: real, at: wp.int32, segments: wp.int32) -> wp.bool:
        return (s <= near and at > 0) or (s >= one - near and at < segments - 1)

    @wp.func
    def is_same(st: vec2, other: vec2, length_a: real, length_b: real, arc: real) -> wp.bool:
        return (
            wp.abs(st[0] - other[0]) * length_a < arc and wp.abs(st[1] - other[1]) * length_b < arc
        )

    @wp.func
    def is_nearest(
        t: real,
        apart: vec3,
        edge: vec3,
        arc: real,
        node: wp.int32,
        at: wp.int32,
        segments: wp.int32,
        nodes: wp.array(dtype=vec3),
    ) -> wp.bool:
        """Whether t is a place of its fiber that is nearest to a point, counted only here.

        `apart`: from the point to the place, which lies on `edge`. Of the two places on the hollow
        side of a joint that are within `arc` the nearer counts, which is further from the joint.
        """
        if t <= near and at > 0:
            return False
        if t >= one - near and at < segments - 1:
            following = nodes[node + 2] - nodes[node + 1]
            return wp.dot(apart, following) >= -near * wp.dot(following, following)
        along = t * wp.length(edge)
        if at > 0 and along < arc:
            before = nodes[node] - nodes[node - 1]
            size2 = wp.dot(before, before)
            back = wp.dot(apart - t * edge, before) / size2
            away = back * wp.sqrt(size2)
            if back > near and away + along < arc and away >= along:
                return False
        along = (one - t) * wp.length(edge)
        if at < segments - 1 and along < arc:
            following = nodes[node + 2] - nodes[node + 1]
            size2 = wp.dot(following, following)
            ahead = -wp.dot(apart + (one - t) * edge, following) / size2
            away = ahead * wp.sqrt(size2)
            if ahead > near and away + along < arc and away > along:
                return False
        return True

    @wp.func
    def is_beside_next(
        delta: vec3,
        edge: vec3,
        other: vec3,
        at: wp.int32,
        segments: wp.int32,
        at_other: wp.int32,
        segments_other: wp.int32,
        t: real,
        arc: real,
    ) -> wp.bool:
        """Whether a joint lies within `arc` of the closest points of the segment that it starts.

        delta: from the joint to the start of the other segment, t: the place nearest to the joint.
        """
        st = closest_points(delta, edge, other)
        if is_joint(st[0], at, segments) or is_joint(st[1], at_other, segments_other):
            return False
        return is_same(st, vec2(zero, t), wp.length(edge), wp.length(other), arc)

    @wp.func
    def is_counted_i(
        slot: wp.int32,
        place: vec2,
        has_first: wp.bool,
        st: vec2,
        delta: vec3,
        a: vec3,
        b: vec3,
        c: vec3,
        arc: real,
        node_i: wp.int32,
        at_i: wp.int32,
        segments_i: wp.int32,
        node_j: wp.int32,
        at_j: wp.int32,
        segments_j: wp.int32,
        nodes: wp.array(dtype=vec3),
    ) -> wp.bool:
        """Whether the row of a node of i is made, and here."""
        if slot == 2 and at_i > 0:
            return False
        if has_first and is_same(place, st, wp.length(a), wp.length(b), arc):
            return False
        if not is_nearest(place[1], c, b, arc, node_j, at_j, segments_j, nodes):
            return False
        if slot == 1 and at_i < segments_i - 1:
            edge = nodes[node_i + 2] - nodes[node_i + 1]
            if is_beside_next(
                delta - a, edge, b, at_i + 1, segments_i, at_j, segments_j, place[1], arc
            ):
                return False
        return True

    @wp.func
    def is_counted_j(
        slot: wp.int32,
        place: vec2,
        has_first: wp.bool,
        st: vec2,
        delta: vec3,
        a: vec3,
        b: vec3,
        c: vec3,
        arc: real,
        node_i: wp.int32,
        at_i: wp.int32,
        segments_i: wp.int32,
        node_j: wp.int32,
        at_j: wp.int32,
        segments_j: wp.int32,
        nodes: wp.array(dtype=vec3),
    ) -> wp.bool:
        """Whether the row of a node of j is made, and here; the nodes of i come first."""
        if slot == 4 and at_j > 0:
            return False
        length_a = wp.length(a)
        length_b = wp.length(b)
        if has_first and is_same(place, st, length_a, length_b, arc):
            return False
        for end in range(1, 3):
            other = row_fractions(end, delta, a, b)
            if is_same(place, other, length_a, length_b, arc):
                # made by whichever segment owns the node, unless the closest points stand for it
                if has_first:
                    if not is_same(other, st, length_a, length_b, arc):
                        return False
                else:
                    beside = delta + other[1] * b - other[0] * a
                    if wp.length_sq(c) >= closer * wp.length_sq(beside):
                        return False
        if not is_nearest(place[0], -c, a, arc, node_i, at_i, segments_i, nodes):
            return False
        if slot == 3 and at_j < segments_j - 1:
            edge = nodes[node_j + 2] - nodes[node_j + 1]
            if is_beside_next(
                -(delta + b), edge, a, at_j + 1, segments_j, at_i, segments_i, place[0], arc
            ):
                return False
        return True

    @wp.func
    def kept_slots(
        st: vec2,
        delta: vec3,
        a: vec3,
        b: vec3,
        w: vec3,
        wa: vec3,
        wb: vec3,
        contact: real,
        keep: real,
        near_now: real,
        far: real,
        arc: real,
        node_i: wp.int32,
        at_i: wp.int32,
        segments_i: wp.int32,
        node_j: wp.int32,
        at_j: wp.int32,
        segments_j: wp.int32,
        nodes: wp.array(dtype=vec3),
    ) -> wp.int32:
        """One bit per slot whose row counts and is close (`is_close`); st: slot 0.

        `near_now` is for free ends, which spring farthest; half of it inside a fiber.
        """
        slots = wp.int32(0)
        # closest points at a joint are those of a node, which its owner reports
        has_first = not (is_joint(st[0], at_i, segments_i) or is_joint(st[1], at_j, segments_j))
        if has_first:
            free = freedom(st[1], at_j, segments_j, freedom(st[0], at_i, segments_i, half))
            now = near_now * free
            if is_close(st, delta, a, b, w, wa, wb, contact, keep, now):
                slots = 1
        inverse_aa = one / wp.dot(a, a)
        inverse_bb = one / wp.dot(b, b)
        for slot in range(1, 5):
            place = vec2(real(2 - slot), real(4 - slot))
            if slot <= 2:
                c0 = delta - place[0] * a
                place[1] = wp.clamp(-wp.dot(c0, b) * inverse_bb, zero, one)
            else:
                c0 = delta + place[1] * b
                place[0] = wp.clamp(wp.dot(c0, a) * inverse_aa, zero, one)
            c = delta + place[1] * b - place[0] * a
            # most ends are far from the other fiber
            if wp.length_sq(c) < far * far:
                free = freedom(place[0], at_i, segments_i, half)
                now = near_now * freedom(place[1], at_j, segments_j, free)
                if is_close(place, delta, a, b, w, wa, wb, contact, keep, now):
                    if slot <= 2:
                        counts = is_counted_i(
                            slot,
                            place,
                            has_first,
                            st,
                            delta,
                            a,
                            b,
                            c,
                            arc,
                            node_i,
                            at_i,
                            segments_i,
                            node_j,
                            at_j,
                            segments_j,
                            nodes,
                        )
                    else:
                        counts = is_counted_j(
                            slot,
                            place,
                            has_first,
                            st,
                            delta,
                            a,
                            b,
                            c,
                            arc,
                            node_i,
                            at_i,
                            segments_i,
                            node_j,
                            at_j,
                            segments_j,
                            nodes,
                        )
                    if counts:
                        slots |= 1 << slot
        return slots

    return largest_motion, row_fractions, row_normal_gap, kept_slots


@cache
def make_wall_gap(name: str, walls: tuple[bool, bool, bool]):
    """`has_wall(axis)` and `wall_gap(x, axis, side, low, high)`."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    wall_x, wall_y, wall_z = walls

    @wp.func
    def has_wall(axis: wp.int32) -> wp.bool:
        found = wp.bool(wp.static(wall_x))
        if axis == 1:
            found = wp.bool(wp.static(wall_y))
        if axis == 2:
            found = wp.bool(wp.static(wall_z))
        return found

    @wp.func
    def wall_gap(x: vec3, axis: wp.int32, side: wp.int32, low: vec3, high: vec3) -> real:
        """Distance of a point from a wall; side 0 is the low one."""
        if side == 0:
            return x[axis] - low[axis]
        return high[axis] - x[axis]

    return has_wall, wall_gap
