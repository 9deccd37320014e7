"""Normal contact of one pair of segments among the others of their two fibers.

One contact per local minimum of the distance; along a line where fibers are nearly parallel, there
every pair of segments takes its part; shares where a kink has two minima within one patch.
Source: law `capsule_contact`; `is_local_minimum` of `pairs`.
"""

from functools import cache

import warp as wp

from warpfiber.laws.capsule_contact import LINE_COSINE, LINE_PART, SMALLEST_SINE
from warpfiber.laws.capsule_contact import make_capsule_contact as make_contact
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.pairs import END_TOLERANCE, PairFeatures, make_pair_geometry
from warpfiber.passes.ring_nodes import make_ring_minimum, make_ring_nodes


@cache
def make_capsule_touch(name: str, periodic: bool, has_energy: bool = False, closed: bool = False):
    """`normal_contact`: (force, stiffness, s, t), depth for memories, energy if wanted."""
    p = precision(name)
    real, vec2, vec3, vec4 = p.real, p.vec2, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    geometry = PairFeatures(repulsion=False, periodic=periodic)
    _, _, is_local_minimum, _ = make_pair_geometry(name, geometry)
    is_ring_minimum = make_ring_minimum(name)
    has_before, has_after, node_before, node_after, node_beyond, _ = make_ring_nodes(closed)
    curvatures, hertz_factor, side_by_side, line_overlap, line_depth, line_square = make_contact(
        name
    )
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    near = real(END_TOLERANCE[name])
    line_cosine, line_part, least_sine = real(LINE_COSINE), real(LINE_PART), real(SMALLEST_SINE)
    two_thirds, two_fifths = real(2.0 / 3.0), real(0.4)

    @wp.func
    def effective_modulus(gi: BondGroup, gj: BondGroup) -> real:
        return one / (gi.compliance + gj.compliance)

    @wp.func
    def normal_contact(
        gi: BondGroup,
        gj: BondGroup,
        at_i: wp.int32,
        at_j: wp.int32,
        node_i: wp.int32,
        node_j: wp.int32,
        delta: vec3,
        a: vec3,
        b: vec3,
        st: vec2,
        node_pos: wp.array(dtype=vec3),
    ):
        """No force where another pair of segments has the contact."""
        reach = gi.radius + gj.radius
        modulus = effective_modulus(gi, gj)
        c = delta + st[1] * b - st[0] * a
        la = wp.length(a)
        lb = wp.length(b)
        cosine = wp.abs(wp.dot(a, b)) / (la * lb)
        sine = wp.max(wp.length(wp.cross(a, b)) / (la * lb), least_sine)
        ki = one / gi.radius
        kj = one / gj.radius

        line = vec4(zero, zero, zero, zero)
        deepest = zero
        line_energy = zero
        is_line = wp.bool(False)
        if cosine > line_cosine:
            beside = side_by_side(delta, a, b)
            d0 = delta + beside[2] * b
            d1 = delta + beside[3] * b - a
            over = line_overlap(d0, d1, reach, beside[0], beside[1])
            patch = line_part * wp.min(la, lb) * sine
            is_line = two * reach * over[3] >= patch * patch
            if is_line and over[0] > zero:
                factor = hertz_factor(curvatures(0, ki, kj, sine))
                # common length of a along the mean direction
                length = la * wp.sqrt(half * (one + cosine))
                # c pi/4 E* of the law: with it a whole patch has the force of Hertz
                stiffness = modulus * factor * sine * length / wp.sqrt(two * reach)
                t = wp.clamp(beside[2] + over[1] * (beside[3] - beside[2]), zero, one)
                line = vec4(stiffness * over[0], stiffness * over[2], over[1], t)
                deepest = line_depth(d0, d1, reach, beside[2], beside[3], lb / la)
                if wp.static(has_energy):
                    square = line_square(d0, d1, reach, beside[0], beside[1])
                    line_energy = half * stiffness * square

        ends = wp.int32(0)
        ring_i = gi.closed * (gi.segments + 1)
        ring_j = gj.closed * (gj.segments + 1)
        if st[0] <= near and not has_before(at_i, ring_i):
            ends += 1
        elif st[0] >= one - near and not has_after(at_i, gi.segments, ring_i):
            ends += 1
        if st[1] <= near and not has_before(at_j, ring_j):
            ends += 2
        elif st[1] >= one - near and not has_after(at_j, gj.segments, ring_j):
            ends += 2
        if is_line and ends == 0:
            return line, deepest, line_energy
        is_minimum = wp.bool(False)
        if wp.static(closed):
            is_minimum = is_ring_minimum(
                st,
                c,
                node_i,
                at_i,
                gi.segments,
                ring_i,
                node_j,
                at_j,
                gj.segments,
                ring_j,
                node_pos,
            )
        else:
            is_minimum = is_local_minimum(
                st, c, node_i, at_i, gi.segments, node_j, at_j, gj.segments, node_pos
            )
        if not is_minimum:
            return line, deepest, line_energy
        depth = wp.max(reach - wp.length(c), zero)
        factor = hertz_factor(curvatures(ends, ki, kj, sine))
        patch = wp.sqrt(two * reach * depth) / sine
        factor *= share_of_contact(
            gi, gj, at_i, at_j, node_i, node_j, delta, a, b, st, patch, node_pos
        )
        stiffness = two * modulus * factor * wp.sqrt(depth)
        force = two_thirds * stiffness * depth
        if line[0] >= force:
            return line, deepest, line_energy
        return vec4(force, stiffness, st[0], st[1]), depth, two_fifths * force * depth

    @wp.func
    def is_hollow(vertex: vec3, from_other: vec3, other: vec3, onward: vec3) -> wp.bool:
        """Whether a fiber comes nearer again to another segment beyond one of its nodes.

        vertex: the node, and from_other the other segment's start, in one frame; onward: the edge
        beyond.
        """
        part = wp.dot(vertex - from_other, other) / wp.dot(other, other)
        away = from_other + wp.clamp(part, zero, one) * other - vertex
        return wp.dot(away, onward) > near * wp.dot(onward, onward)

    @wp.func
    def share_of_contact(
        gi: BondGroup,
        gj: BondGroup,
        at_i: wp.int32,
        at_j: wp.int32,
        node_i: wp.int32,
        node_j: wp.int32,
        delta: vec3,
        a: vec3,
        b: vec3,
        st: vec2,
        patch: real,
        node_pos: wp.array(dtype=vec3),
    ) -> real:
        """Part of Hertz's force that one of several minima within a patch takes.

        In the hollow of a kink both neighbors have one: halves while they coincide, wholes when
        they are half a patch from the node.
        """
        la = wp.length(a)
        lb = wp.length(b)
        nothing = vec3(zero, zero, zero)
        share = one
        ring_i = gi.closed * (gi.segments + 1)
        ring_j = gj.closed * (gj.segments + 1)
        far = st[0] * la
        if has_before(at_i, ring_i) and far < patch:
            onward = node_pos[node_before(node_i, at_i, ring_i)] - node_pos[node_i]
            if is_hollow(nothing, delta, b, onward):
                share *= half + half * far / patch
        far = (one - st[0]) * la
        if has_after(at_i, gi.segments, ring_i) and far < patch:
            second = node_after(node_i, at_i, ring_i)
            onward = node_pos[node_beyond(node_i, at_i, ring_i)] - node_pos[second]
            if is_hollow(a, delta, b, onward):
                share *= half + half * far / patch
        far = st[1] * lb
        if has_before(at_j, ring_j) and far < patch:
            onward = node_pos[node_before(node_j, at_j, ring_j)] - node_pos[node_j]
            if is_hollow(delta, nothing, a, onward):
                share *= half + half * far / patch
        far = (one - st[1]) * lb
        if has_after(at_j, gj.segments, ring_j) and far < patch:
            second = node_after(node_j, at_j, ring_j)
            onward = node_pos[node_beyond(node_j, at_j, ring_j)] - node_pos[second]
            if is_hollow(delta + b, nothing, a, onward):
                share *= half + half * far / patch
        return share

    return normal_contact
