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


@cache
def make_capsule_touch(name: str, periodic: bool, has_energy: bool = False):
    """`normal_contact`: (force, stiffness, s, t), depth for memories, energy if wanted."""
    p = precision(name)
    real, vec2, vec3, vec4 = p.real, p.vec2, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    geometry = PairFeatures(repulsion=False, periodic=periodic)
    _, _, is_local_minimum, _ = make_pair_geometry(name, geometry)
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
        if (st[0] <= near and at_i == 0) or (st[0] >= one - near and at_i == gi.segments - 1):
            ends += 1
        if (st[1] <= near and at_j == 0) or (st[1] >= one - near and at_j == gj.segments - 1):
            ends += 2
        if is_line and ends == 0:
            return line, deepest, line_energy
        if not is_local_minimum(
            st, c, node_i, at_i, gi.segments, node_j, at_j, gj.segments, node_pos
        ):
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
        far = st[0] * la
        if at_i > 0 and far < patch:
            if is_hollow(nothing, delta, b, node_pos[node_i - 1] - node_pos[node_i]):
                share *= half + half * far / patch
        far = (one - st[0]) * la
        if at_i < gi.segments - 1 and far < patch:
            if is_hollow(a, delta, b, node_pos[node_i + 2] - node_pos[node_i + 1]):
                share *= half + half * far / patch
        far = st[1] * lb
        if at_j > 0 and far < patch:
            if is_hollow(delta, nothing, a, node_pos[node_j - 1] - node_pos[node_j]):
                share *= half + half * far / patch
        far = (one - st[1]) * lb
        if at_j < gj.segments - 1 and far < patch:
            if is_hollow(delta + b, nothing, a, node_pos[node_j + 2] - node_pos[node_j + 1]):
                share *= half + half * far / patch
        return share

    return normal_contact
