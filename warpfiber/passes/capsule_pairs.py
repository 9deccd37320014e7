"""One sweep over pairs of segments of bonded spheres that may touch: push, dashpot, friction.

The pairs are those that `capsule_hits` packed. What a pair does is stored, and the sweep over bonds
gathers it: nothing is added atomically, so the result does not depend on the number of workers. A
pair that does not act keeps stale values. Friction has a memory per listed pair (`contact_memory`).
Source: laws `capsule_contact` and `friction`; dashpot of law `hertz`.
Limits: where another contact of the same two fibers acts on a neighboring segment, a new one begins
    with its memory.
"""

from functools import cache

import warp as wp

from warpfiber.laws.friction import make_friction
from warpfiber.laws.hertz import DASHPOT
from warpfiber.model import HALT, PAIR_COUNT, precision
from warpfiber.passes.array_items import make_fetch, make_items
from warpfiber.passes.bond_groups import bond_group_struct, pair_group_struct
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.capsule_hits import part_begin
from warpfiber.passes.capsule_touch import make_capsule_touch
from warpfiber.passes.contact_losses import RECORD
from warpfiber.passes.contact_memory import make_hand_over
from warpfiber.passes.kernel_module import FUSED
from warpfiber.passes.pairs import PairFeatures, make_pair_geometry
from warpfiber.passes.ring_nodes import make_ring_nodes


@cache
def make_capsule_pairs(name: str, features: CapsuleFeatures):
    """Kernel `capsule_pairs`: what every listed pair does now; memories move on by dt."""
    p = precision(name)
    real, vec2, vec3, vec4, mat33 = p.real, p.vec2, p.vec3, p.vec4, p.mat33
    BondGroup, PairGroup = bond_group_struct(name), pair_group_struct(name)
    geometry = PairFeatures(repulsion=False, periodic=features.periodic)
    _, image_shift, _, _ = make_pair_geometry(name, geometry)
    normal_contact = make_capsule_touch(name, features.closed)
    _, _, _, node_after, _, segment_over = make_ring_nodes(features.closed)
    neighbors_memory = make_hand_over(name, features.closed)
    carried_memory, friction_force = make_friction(name)
    has_dashpot, has_friction = features.dashpot, features.friction
    is_recorded = features.recorded and (has_dashpot or has_friction)
    zero, half, one = real(0.0), real(0.5), real(1.0)
    dashpot = real(DASHPOT)
    number, set_number = make_items(wp.int32)
    point, _ = make_items(wp.vec3d)
    vector, set_vector = make_items(vec3)
    pair_of, _ = make_items(vec2)
    _, set_four = make_items(vec4)
    _, set_flag = make_items(wp.uint8)
    fetch_place, fetch_vector = make_fetch(wp.vec3d, 2), make_fetch(vec3, 2)

    @wp.func
    def ring_of(g: BondGroup) -> wp.int32:
        """Nodes of a ring, 0 of an open fiber."""
        return g.closed * (g.segments + 1)

    @wp.func
    def segment_beside(g: BondGroup, i: wp.int32, at: wp.int32, s: real) -> wp.int32:
        """The next segment over the nearer node; i itself where the fiber ends."""
        return segment_over(i, at, g.segments, ring_of(g), s >= half)

    @wp.func
    def node_between(
        s: real,
        node: wp.int32,
        end: wp.int32,
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
    ):
        """Velocity and spin at the part s of the segment that begins with a node."""
        v = (one - s) * vector(node_velocity, node) + s * vector(node_velocity, end)
        w = (one - s) * vector(node_spin, node) + s * vector(node_spin, end)
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
        return ((one - s) * (one - s) * second + s * s * first) / (first * second)

    @wp.kernel(module="unique", module_options=FUSED, enable_backward=False, grid_stride=False)
    def capsule_pairs(
        offset: wp.int32,
        parts: wp.int32,
        dt: real,
        beta: real,
        friction: real,
        groups: wp.array(dtype=BondGroup),
        pair_groups: wp.array2d(dtype=PairGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        out_start: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        hit_pair: wp.array(dtype=wp.int32),
        hit_closest: wp.array(dtype=vec2),
        hit_count: wp.array(dtype=wp.int32),
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
        step: wp.array(dtype=wp.int64),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force_out: wp.array(dtype=vec3),
        pair_arms_out: wp.array(dtype=vec4),
        pair_hit_out: wp.array(dtype=wp.int32),
        hit_moment_out: wp.array(dtype=vec3),
        hit_beside_out: wp.array(dtype=vec3),
        pair_record_out: wp.array(dtype=vec4),
        pair_memory: wp.array2d(dtype=vec4),
        pair_step: wp.array2d(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        part = wp.tid() + offset
        begin = part_begin(part, parts, status[wp.static(PAIR_COUNT)])
        end = begin + hit_count[part]
        for hit in range(begin, end):
            # nodes of partners lie anywhere
            k = number(hit_pair, wp.min(hit + 2, end - 1))
            node_j = number(segment_node, number(pair_j, k))
            fetch_place(place, node_j)
            if wp.static(has_dashpot or has_friction):
                fetch_vector(node_velocity, node_j)
                fetch_vector(node_spin, node_j)
            k = number(hit_pair, hit)
            st = pair_of(hit_closest, hit)
            i = number(pair_i, k)
            j = number(pair_j, k)
            node_i = number(segment_node, i)
            node_j = number(segment_node, j)
            fiber_i = number(segment_fiber, i)
            fiber_j = number(segment_fiber, j)
            group_i = number(fiber_group, fiber_i)
            group_j = number(fiber_group, fiber_j)
            gi = groups[group_i]
            gj = groups[group_j]
            both = pair_groups[group_i, group_j]
            at_i = node_i - number(fiber_node_start, fiber_i)
            at_j = node_j - number(fiber_node_start, fiber_j)
            end_i = node_after(node_i, at_i, ring_of(gi))
            end_j = node_after(node_j, at_j, ring_of(gj))
            xi = point(place, node_i)
            xj = point(place, node_j)
            a = vec3(point(place, end_i) - xi)
            b = vec3(point(place, end_j) - xj)
            delta = vec3(xj - xi) + image_shift(number(pair_image, k), lattice[0])
            c = delta + st[1] * b - st[0] * a
            if wp.length_sq(c) >= both.reach * both.reach:
                continue
            push, felt, n, springs, on_i, on_j = normal_contact(
                both, gi, gj, at_i, at_j, delta, a, b, st, c
            )
            if felt[2] <= zero:
                continue
            depth = felt[0]
            s = push[2]
            t = push[3]
            arm_i = half * (felt[3] + gi.radius - gj.radius)
            arm_j = felt[3] - arm_i
            size = push[0]
            force = vec3(zero, zero, zero)
            if wp.static(has_dashpot or has_friction):
                v_i, w_i = node_between(s, node_i, end_i, node_velocity, node_spin)
                v_j, w_j = node_between(t, node_j, end_j, node_velocity, node_spin)
                slip = v_i - v_j + wp.cross(arm_i * w_i + arm_j * w_j, n)
                approach = wp.dot(slip, n)
                mass = one / (inverse_mass(gi, at_i, s) + inverse_mass(gj, at_j, t))
                resistance = dashpot * beta * wp.sqrt(felt[1] * mass)
                if wp.static(has_dashpot):
                    size = wp.max(size + resistance * approach, zero)
                if wp.static(has_friction):
                    stiffness = both.shear_part * push[1]
                    slide = slip - approach * n
                    turn = half * dt * wp.dot(w_i + w_j, n)
                    now = wp.int32(step[0])
                    last = now - 1
                    kept = pair_memory[last & 1, k]
                    if pair_step[last & 1, k] != last:
                        kept = neighbors_memory(
                            i,
                            j,
                            number(pair_image, k),
                            last,
                            s,
                            t,
                            wp.length(vec3(point(place, end_i) - point(place, node_i))),
                            wp.length(vec3(point(place, end_j) - point(place, node_j))),
                            segment_beside(gi, i, at_i, s),
                            segment_beside(gj, j, at_j, t),
                            out_start,
                            pair_j,
                            pair_image,
                            pair_memory,
                            pair_step,
                        )
                    h = carried_memory(vec3(kept[0], kept[1], kept[2]), kept[3], depth, n, turn)
                    damping = both.root_shear * resistance
                    force, h = friction_force(
                        h + dt * slide, stiffness, damping, slide, friction * size
                    )
                    pair_memory[now & 1, k] = vec4(h[0], h[1], h[2], depth)
                    pair_step[now & 1, k] = now
            set_flag(pair_acts, k, wp.uint8(1))
            set_vector(pair_force_out, k, force - (size - push[0]) * n + springs)
            set_number(pair_hit_out, k, hit)
            set_vector(hit_moment_out, hit, wp.cross(n, force))
            set_vector(hit_beside_out, 2 * hit, on_i)
            set_vector(hit_beside_out, 2 * hit + 1, on_j)
            set_four(pair_arms_out, k, vec4(s, t, arm_i, arm_j))
            if wp.static(is_recorded):
                first = wp.static(RECORD) * k
                set_four(pair_record_out, first, vec4(n[0], n[1], n[2], size - push[0]))
                set_four(pair_record_out, first + 1, vec4(force[0], force[1], force[2], arm_i))
                set_four(pair_record_out, first + 2, vec4(s, t, arm_j, zero))

    return capsule_pairs


@cache
def make_gather(name: str, closed: bool):
    """`gather_pairs(fiber's segments and nodes, ...)`: adds what its pairs do to its nodes.

    Pairs that act are packed first, without a branch: a loop per segment that skips the others
    takes three times as long, most of it for ends of loops that no processor foresees.
    """
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    one = real(1.0)
    number, set_number = make_items(wp.int32)
    vector, set_vector = make_items(vec3)
    four, _ = make_items(vec4)
    flag, _ = make_items(wp.uint8)
    fetch_vector, fetch_two, fetch_four = make_fetch(vec3), make_fetch(vec3, 2), make_fetch(vec4)

    @wp.func
    def gather_pairs(
        first_segment: wp.int32,
        end_segment: wp.int32,
        first: wp.int32,
        last: wp.int32,
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_force: wp.array(dtype=vec3),
        pair_arms: wp.array(dtype=vec4),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_hit: wp.array(dtype=wp.int32),
        hit_moment: wp.array(dtype=vec3),
        hit_beside: wp.array(dtype=vec3),
        acting: wp.array(dtype=wp.int32),
        node_force: wp.array(dtype=vec3),
        node_moment: wp.array(dtype=vec3),
    ):
        begin = out_start[first_segment] + in_start[first_segment]
        found = begin
        for k in range(out_start[first_segment], out_start[end_segment]):
            set_number(acting, found, k)
            found += wp.where(flag(pair_acts, k) != wp.uint8(0), 1, 0)
        incoming = found
        for slot in range(in_start[first_segment], in_start[end_segment]):
            k = number(in_pair, slot)
            set_number(acting, found, k)
            found += wp.where(flag(pair_acts, k) != wp.uint8(0), 1, 0)
        for slot in range(begin, found):
            # those of incoming pairs lie anywhere
            k = number(acting, wp.min(slot + 2, found - 1))
            fetch_four(pair_arms, k)
            fetch_vector(pair_force, k)
            fetch_vector(hit_moment, number(pair_hit, k))
            fetch_two(hit_beside, 2 * number(pair_hit, k))
            k = number(acting, slot)
            segment = number(pair_i, k)
            if slot >= incoming:
                segment = number(pair_j, k)
            node = first + segment - first_segment
            end = node + 1
            if wp.static(closed):
                if node == last:
                    end = first
            hit = number(pair_hit, k)
            arms = four(pair_arms, k)
            force = vector(pair_force, k)
            part = arms[0]
            arm = arms[2]
            beside = 2 * hit
            if slot >= incoming:
                force = -force
                part = arms[1]
                arm = arms[3]
                beside += 1
            couple = vector(hit_beside, beside)  # one end feels its reverse
            moment = arm * vector(hit_moment, hit)
            rest = one - part
            set_vector(node_force, node, vector(node_force, node) + (rest * force + couple))
            set_vector(node_moment, node, vector(node_moment, node) + rest * moment)
            set_vector(node_force, end, vector(node_force, end) + (part * force - couple))
            set_vector(node_moment, end, vector(node_moment, end) + part * moment)

    return gather_pairs
