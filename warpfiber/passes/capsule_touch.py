"""Normal contact of one pair of segments among the others of their two fibers.

One contact per local minimum of the distance; along a line where fibers are nearly parallel, there
every pair of segments takes its part. In the hollow of a kink neighbors have a minimum each, which
are one contact while they are within a patch: there the saddle of the distance between them counts
against both, as minima less saddles plus maxima are the number of places that overlap. So their sum
is that of one contact while they coincide and of two when they are apart, and it has a potential.
Source: Hertz of law `capsule_contact` at every extremum, with the signs of Morse theory;
    `is_local_minimum` of `pairs`.
Limits: where the angle to the other fiber jumps at a node, what is stored does too. Along a line
    there are no saddles.
"""

from functools import cache

import warp as wp

from warpfiber.laws.capsule_contact import LINE_COSINE, LINE_PART, SMALLEST_SINE
from warpfiber.laws.capsule_contact import make_capsule_contact as make_contact
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.pairs import END_TOLERANCE, PairFeatures, make_pair_geometry
from warpfiber.passes.ring_nodes import make_ring_minimum, make_ring_nodes

# Of the force at a minimum: what is left of it beside its saddles, for friction and dashpot.
LEAST_PART = 1e-3


@cache
def make_capsule_touch(name: str, periodic: bool, has_energy: bool = False, closed: bool = False):
    """`normal_contact`: (force, stiffness, s, t), depth for memories, energy, and `beside`.

    `beside`: what the nodes feel on top of the force at s and t: rows are the first and second node
    of i and the first one of j; the second one of j takes the rest, so that the sum is zero.
    """
    p = precision(name)
    real, vec2, vec3, vec4, mat33 = p.real, p.vec2, p.vec3, p.vec4, p.mat33
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
    two_thirds, two_fifths, quarter = real(2.0 / 3.0), real(0.4), real(0.25)
    least_part = real(LEAST_PART)

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
                factor = hertz_factor(curvatures(0, ki, kj, sine))[0]
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
            return line, deepest, line_energy, mat33()
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
        if is_line and not is_minimum:
            return line, deepest, line_energy, mat33()
        distance = wp.length(c)
        depth = wp.max(reach - distance, zero)
        patch = wp.where(is_line, zero, wp.sqrt(two * reach * depth) / sine)
        less, extra = saddles(gi, gj, at_i, at_j, node_i, node_j, delta, a, b, st, patch, node_pos)
        if not is_minimum and less[1] == zero:
            return line, deepest, line_energy, mat33()
        form = hertz_factor(curvatures(ends, ki, kj, sine))
        stiffness = two * modulus * form[0]
        scale = two_thirds * stiffness
        whole = depth * wp.sqrt(depth)
        if line[0] >= scale * whole:
            return line, deepest, line_energy, mat33()
        push = vec4(zero, zero, st[0], st[1])
        stored = -less[2]
        if is_minimum:
            net = wp.max(whole - less[1], least_part * whole)
            root = wp.max(wp.sqrt(depth) - less[0], least_part * wp.sqrt(depth))
            push = vec4(scale * net, stiffness * root, st[0], st[1])
            stored += depth * whole
            # of the whole minimum, this is not in the force at s and t
            rest = (whole - net) / distance * c
            extra += wp.matrix_from_rows((st[0] - one) * rest, -st[0] * rest, (one - st[1]) * rest)
        energy = two_fifths * scale * stored
        extra *= scale
        if ends == 0 and sine > least_sine:
            # a wider angle stores less: d ln P = -2 cos d cos / sin^2
            signed = wp.dot(a, b) / (la * lb)
            twist = two * form[1] * energy * signed / (sine * sine)
            on_i = twist / la * (b / lb - signed / la * a)
            on_j = twist / lb * (a / la - signed / lb * b)
            extra += wp.matrix_from_rows(-on_i, on_i, -on_j)
        return push, depth, energy, extra

    @wp.func
    def is_vertex(
        part: real, away: vec3, behind: vec3, has_one_before: wp.bool, has_one_after: wp.bool
    ) -> wp.bool:
        """Vertex rule at the part of a segment, behind whose first node another edge begins."""
        if part >= one - near and has_one_after:
            return False
        if part <= near and has_one_before:
            return wp.dot(away, behind) <= near * wp.dot(behind, behind)
        return True

    @wp.func
    def saddle(
        vertex: vec3,
        inward: vec3,
        onward: vec3,
        from_other: vec3,
        other: vec3,
        behind: vec3,
        has_one_before: wp.bool,
        has_one_after: wp.bool,
        reach: real,
    ):
        """Half of a saddle: pull on a vertex, part of the other segment, powers of the depth.

        inward, onward: edges of the fiber away from the vertex, along which it comes nearer; vertex
        and the other segment's start in one frame; behind: the edge before it, from there on.
        """
        part = wp.clamp(wp.dot(vertex - from_other, other) / wp.dot(other, other), zero, one)
        away = from_other + part * other - vertex
        distance = wp.length(away)
        depth = reach - distance
        if depth <= zero or not is_hollow(away, inward, onward):
            return vec3(), part, vec3()
        if not is_vertex(part, -away, behind, has_one_before, has_one_after):
            return vec3(), part, vec3()
        root = half * wp.sqrt(depth)
        pull = depth * root
        return (pull / distance) * away, part, vec3(root, pull, depth * pull)

    @wp.func
    def is_hollow(away: vec3, inward: vec3, onward: vec3) -> wp.bool:
        """Whether a fiber comes nearer along both edges from a node; away: to what it nears."""
        if wp.dot(away, inward) <= near * wp.dot(inward, inward):
            return False
        return wp.dot(away, onward) > near * wp.dot(onward, onward)

    @wp.func
    def summit(gap: vec3, reach: real):
        """Quarter of the push of a maximum between two nodes, and powers of its depth."""
        distance = wp.length(gap)
        depth = wp.max(reach - distance, zero)
        root = quarter * wp.sqrt(depth)
        push = depth * root
        return (push / distance) * gap, vec3(root, push, depth * push)

    @wp.func
    def saddles(
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
    ):
        """Saddles less maxima of two segments: depths^(1/2), ^(3/2), ^(5/2), and loads of nodes.

        Half of every saddle and a quarter of every maximum at their nodes.
        """
        la = wp.length(a)
        lb = wp.length(b)
        start = vec3(zero, zero, zero)
        reach = gi.radius + gj.radius
        less = vec3()
        # on the first and the second node of i, on those of j
        u0 = vec3()
        u1 = vec3()
        w0 = vec3()
        w1 = vec3()
        is_i0 = st[0] * la < patch
        is_i1 = (one - st[0]) * la < patch
        is_j0 = st[1] * lb < patch
        is_j1 = (one - st[1]) * lb < patch
        # where the nearest point is a node, the distance rises from there along its segment
        is_past_i0 = is_i0 and st[0] > near
        is_past_i1 = is_i1 and one - st[0] > near
        is_past_j0 = is_j0 and st[1] > near
        is_past_j1 = is_j1 and one - st[1] > near
        if not (is_past_i0 or is_past_i1 or is_past_j0 or is_past_j1):
            return less, mat33()
        ring_i = gi.closed * (gi.segments + 1)
        ring_j = gj.closed * (gj.segments + 1)
        before_i = has_before(at_i, ring_i)
        after_i = has_after(at_i, gi.segments, ring_i)
        before_j = has_before(at_j, ring_j)
        after_j = has_after(at_j, gj.segments, ring_j)
        # edges onward from all four nodes
        back_i = vec3()
        ahead_i = vec3()
        back_j = vec3()
        ahead_j = vec3()
        if before_i:
            back_i = node_pos[node_before(node_i, at_i, ring_i)] - node_pos[node_i]
        if after_i:
            second = node_after(node_i, at_i, ring_i)
            ahead_i = node_pos[node_beyond(node_i, at_i, ring_i)] - node_pos[second]
        if before_j:
            back_j = node_pos[node_before(node_j, at_j, ring_j)] - node_pos[node_j]
        if after_j:
            second = node_after(node_j, at_j, ring_j)
            ahead_j = node_pos[node_beyond(node_j, at_j, ring_j)] - node_pos[second]
        if is_past_i0 and before_i:
            pull, part, depths = saddle(
                start, a, back_i, delta, b, back_j, before_j, after_j, reach
            )
            less += depths
            u0 += pull
            w0 -= (one - part) * pull
            w1 -= part * pull
        if is_past_i1 and after_i:
            pull, part, depths = saddle(a, -a, ahead_i, delta, b, back_j, before_j, after_j, reach)
            less += depths
            u1 += pull
            w0 -= (one - part) * pull
            w1 -= part * pull
        if is_past_j0 and before_j:
            pull, part, depths = saddle(
                delta, b, back_j, start, a, back_i, before_i, after_i, reach
            )
            less += depths
            w0 += pull
            u0 -= (one - part) * pull
            u1 -= part * pull
        if is_past_j1 and after_j:
            pull, part, depths = saddle(
                delta + b, -b, ahead_j, start, a, back_i, before_i, after_i, reach
            )
            less += depths
            w1 += pull
            u0 -= (one - part) * pull
            u1 -= part * pull
        for k in range(4):
            on_i = is_i0 and before_i
            on_j = is_j0 and before_j
            u = zero
            w = zero
            inward_i = a
            inward_j = b
            onward_i = back_i
            onward_j = back_j
            if k >= 2:
                on_i = is_i1 and after_i
                u = one
                inward_i = -a
                onward_i = ahead_i
            if k == 1 or k == 3:
                on_j = is_j1 and after_j
                w = one
                inward_j = -b
                onward_j = ahead_j
            if on_i and on_j:
                gap = delta + w * b - u * a
                if is_hollow(gap, inward_i, onward_i) and is_hollow(-gap, inward_j, onward_j):
                    push, depths = summit(gap, reach)
                    less -= depths
                    u0 -= (one - u) * push
                    u1 -= u * push
                    w0 += (one - w) * push
                    w1 += w * push
        return less, wp.matrix_from_rows(u0, u1, w0)

    return normal_contact
