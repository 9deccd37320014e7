"""One sweep over listed pairs of segments of bonded spheres: normal force, dashpot, friction.

One thread owns a segment and its outgoing pairs. It stores what a pair does, the sweep over bonds
gathers it: nothing is added atomically, so the result does not depend on the number of workers. A
pair that does not act keeps stale values. Friction has a memory per listed pair; a list that is
built anew takes it over by the pair's segments and image.
Limits: a contact that slides from one segment to the next begins a new memory.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from warpfiber.laws.capsule_contact import LINE_COSINE, LINE_PART, SMALLEST_SINE
from warpfiber.laws.capsule_contact import make_capsule_contact as make_contact
from warpfiber.laws.friction import make_friction
from warpfiber.laws.hertz import DASHPOT
from warpfiber.model import HALT, precision
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.pairs import END_TOLERANCE, PairFeatures, make_pair_geometry


@dataclass(frozen=True)
class CapsuleFeatures:
    """What the pair sweep of a scene contains."""

    periodic: bool = False
    dashpot: bool = False
    friction: bool = False


@cache
def make_capsule_pairs(name: str, features: CapsuleFeatures):
    """Kernel `capsule_pairs`: what every listed pair does now; memories move on by dt."""
    p = precision(name)
    real, vec2, vec3, vec4, mat33 = p.real, p.vec2, p.vec3, p.vec4, p.mat33
    BondGroup = bond_group_struct(name)
    geometry = PairFeatures(repulsion=False, periodic=features.periodic)
    closest_fractions, image_shift, is_local_minimum, _ = make_pair_geometry(name, geometry)
    curvatures, hertz_factor, side_by_side, line_overlap = make_contact(name)
    carried_memory, friction_force = make_friction(name)
    has_dashpot, has_friction = features.dashpot, features.friction
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    near = real(END_TOLERANCE[name])
    line_cosine, line_part, least_sine = real(LINE_COSINE), real(LINE_PART), real(SMALLEST_SINE)
    two_thirds, dashpot = real(2.0 / 3.0), real(DASHPOT)

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
    ) -> vec4:
        """(force, stiffness, s, t); no force where another pair of segments has the contact."""
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
        is_line = wp.bool(False)
        if cosine > line_cosine:
            beside = side_by_side(delta, a, b)
            over = line_overlap(
                delta + beside[2] * b, delta + beside[3] * b - a, reach, beside[0], beside[1]
            )
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

        ends = wp.int32(0)
        if (st[0] <= near and at_i == 0) or (st[0] >= one - near and at_i == gi.segments - 1):
            ends += 1
        if (st[1] <= near and at_j == 0) or (st[1] >= one - near and at_j == gj.segments - 1):
            ends += 2
        if is_line and ends == 0:
            return line
        if not is_local_minimum(
            st, c, node_i, at_i, gi.segments, node_j, at_j, gj.segments, node_pos
        ):
            return line
        depth = wp.max(reach - wp.length(c), zero)
        factor = hertz_factor(curvatures(ends, ki, kj, sine))
        patch = wp.sqrt(two * reach * depth) / sine
        factor *= share_of_contact(
            gi, gj, at_i, at_j, node_i, node_j, delta, a, b, st, patch, node_pos
        )
        stiffness = two * modulus * factor * wp.sqrt(depth)
        force = two_thirds * stiffness * depth
        if line[0] >= force:
            return line
        return vec4(force, stiffness, st[0], st[1])

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

    @wp.func
    def node_between(
        s: real,
        node: wp.int32,
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
    ):
        """Velocity and spin at the part s of the segment that begins with a node."""
        v = (one - s) * node_velocity[node] + s * node_velocity[node + 1]
        w = (one - s) * node_spin[node] + s * node_spin[node + 1]
        return v, w

    @wp.func
    def inverse_mass(g: BondGroup, at: wp.int32, s: real) -> real:
        """Of a push at the part s of a segment: (1 - s)^2 / m_0 + s^2 / m_1."""
        first = g.mass
        second = g.mass
        if g.closed == 0:
            if at == 0:
                first = g.end_mass
            if at == g.segments - 1:
                second = g.end_mass
        return (one - s) * (one - s) / first + s * s / second

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def capsule_pairs(
        offset: wp.int32,
        dt: real,
        beta: real,
        friction: real,
        largest_reach: real,
        groups: wp.array(dtype=BondGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        place: wp.array(dtype=wp.vec3d),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force_out: wp.array(dtype=vec3),
        pair_moment_out: wp.array(dtype=vec3),
        pair_arms_out: wp.array(dtype=vec4),
        pair_memory: wp.array(dtype=vec3),
        pair_stiffness: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        i = wp.tid() + offset
        node_i = segment_node[i]
        fiber_i = segment_fiber[i]
        gi = groups[fiber_group[fiber_i]]
        at_i = node_i - fiber_node_start[fiber_i]
        xi = place[node_i]
        a = vec3(place[node_i + 1] - xi)
        for k in range(out_start[i], out_start[i + 1]):
            j = pair_j[k]
            node_j = segment_node[j]
            xj = place[node_j]
            b = vec3(place[node_j + 1] - xj)
            delta = vec3(xj - xi) + image_shift(pair_image[k], lattice[0])
            st = closest_fractions(delta, a, b)
            c = delta + st[1] * b - st[0] * a
            push = vec4(zero, zero, zero, zero)
            # most listed pairs end here: the constants of their groups are not even read
            if wp.length_sq(c) < largest_reach * largest_reach:
                fiber_j = segment_fiber[j]
                other = groups[fiber_group[fiber_j]]
                reach = gi.radius + other.radius
                if wp.length_sq(c) < reach * reach:
                    at = node_j - fiber_node_start[fiber_j]
                    push = normal_contact(
                        gi, other, at_i, at, node_i, node_j, delta, a, b, st, node_pos
                    )
            if push[0] <= zero:
                if pair_acts[k] != wp.uint8(0):
                    pair_acts[k] = wp.uint8(0)
                    if wp.static(has_friction):
                        pair_stiffness[k] = zero
                continue
            gj = groups[fiber_group[segment_fiber[j]]]
            at_j = node_j - fiber_node_start[segment_fiber[j]]
            s = push[2]
            t = push[3]
            c = delta + t * b - s * a
            distance = wp.length(c)
            n = c / distance
            arm_i = half * (distance + gi.radius - gj.radius)
            arm_j = distance - arm_i
            size = push[0]
            force = vec3(zero, zero, zero)
            if wp.static(has_dashpot or has_friction):
                v_i, w_i = node_between(s, node_i, node_velocity, node_spin)
                v_j, w_j = node_between(t, node_j, node_velocity, node_spin)
                slip = v_i - v_j + wp.cross(arm_i * w_i + arm_j * w_j, n)
                approach = wp.dot(slip, n)
                mass = one / (inverse_mass(gi, at_i, s) + inverse_mass(gj, at_j, t))
                if wp.static(has_dashpot):
                    resistance = dashpot * beta * wp.sqrt(push[1] * mass)
                    size = wp.max(size + resistance * approach, zero)
                if wp.static(has_friction):
                    shear = gi.shear_compliance + gj.shear_compliance
                    ratio = real(4.0) * (gi.compliance + gj.compliance) / shear
                    stiffness = ratio * push[1]
                    slide = slip - approach * n
                    turn = half * dt * wp.dot(w_i + w_j, n)
                    memory = carried_memory(pair_memory[k], pair_stiffness[k], stiffness, n, turn)
                    resistance = dashpot * beta * wp.sqrt(stiffness * mass)
                    force, memory = friction_force(
                        memory + dt * slide, stiffness, resistance, slide, friction * size
                    )
                    pair_memory[k] = memory
                    pair_stiffness[k] = stiffness
            force -= size * n
            pair_acts[k] = wp.uint8(1)
            pair_force_out[k] = force
            pair_moment_out[k] = wp.cross(n, force)
            pair_arms_out[k] = vec4(s, t, arm_i, arm_j)

    return capsule_pairs


@cache
def make_gather(name: str):
    """`gather_pairs(segment, ...)`: force and moment of its pairs on both nodes of a segment."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    zero = real(0.0)

    @wp.func
    def gather_pairs(
        segment: wp.int32,
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_moment: wp.array(dtype=vec3),
        pair_arms: wp.array(dtype=vec4),
    ):
        force = vec3(zero, zero, zero)
        moment = vec3(zero, zero, zero)
        second_force = vec3(zero, zero, zero)
        second_moment = vec3(zero, zero, zero)
        for k in range(out_start[segment], out_start[segment + 1]):
            if pair_acts[k] != wp.uint8(0):
                arms = pair_arms[k]
                couple = arms[2] * pair_moment[k]
                force += pair_force[k]
                moment += couple
                second_force += arms[0] * pair_force[k]
                second_moment += arms[0] * couple
        for slot in range(in_start[segment], in_start[segment + 1]):
            k = in_pair[slot]
            if pair_acts[k] != wp.uint8(0):
                arms = pair_arms[k]
                couple = arms[3] * pair_moment[k]
                force -= pair_force[k]
                moment += couple
                second_force -= arms[1] * pair_force[k]
                second_moment += arms[1] * couple
        return force - second_force, moment - second_moment, second_force, second_moment

    return gather_pairs


@cache
def make_carry_memory(name: str):
    """Kernel `carry_memory`: memories of the list before for the pairs of the new one."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def carry_memory(
        old_start: wp.array(dtype=wp.int32),
        old_j: wp.array(dtype=wp.int32),
        old_image: wp.array(dtype=wp.int32),
        old_acts: wp.array(dtype=wp.uint8),
        old_memory: wp.array(dtype=vec3),
        old_stiffness: wp.array(dtype=real),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        acts_out: wp.array(dtype=wp.uint8),
        memory_out: wp.array(dtype=vec3),
        stiffness_out: wp.array(dtype=real),
    ):
        i = wp.tid()
        for k in range(out_start[i], out_start[i + 1]):
            acts = wp.uint8(0)
            memory = vec3()
            stiffness = real(0.0)
            for m in range(old_start[i], old_start[i + 1]):
                if old_acts[m] != wp.uint8(0):
                    if old_j[m] == pair_j[k] and old_image[m] == pair_image[k]:
                        acts = wp.uint8(1)
                        memory = old_memory[m]
                        stiffness = old_stiffness[m]
            acts_out[k] = acts
            memory_out[k] = memory
            stiffness_out[k] = stiffness

    return carry_memory


def carry_memories(
    name: str, segments: int, before: list[Any], after: list[Any], device: str
) -> None:
    """Launch `carry_memory` over all segments; arrays of the list before and of the new one."""
    wp.launch(make_carry_memory(name), dim=segments, inputs=[*before, *after], device=device)
