"""One sweep over fibers: gather pair forces, add drag and internal forces, close, integrate.

One thread walks along one fiber. First walk: stretching, bending, hydrodynamic torque, walls and
the gathered pair forces give the non-distributed force of every node; the Galerkin closure
eliminates forward on the way. Second walk, backward where the closure substitutes: the closure
turns node forces into accelerations and the step (velocity first, with the drag at the middle of
the step, then position with the new velocity) moves the nodes. A fiber that is torn or not finite
is left as it is and reported.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.laws.bending import make_bending
from warpfiber.laws.closure import make_closure
from warpfiber.laws.drag import make_drag
from warpfiber.laws.flow import make_flow
from warpfiber.laws.stretching import make_stretching
from warpfiber.laws.torque import make_torque
from warpfiber.laws.wall import make_wall
from warpfiber.model import BAD_FIBER, EXPIRED, HALT, TORN, precision
from warpfiber.passes.precision import group_struct

# A segment longer than this many rest lengths is no longer a physical state but a diverging step.
TEAR_STRETCH = 2.0
# The second walk runs backward, which no processor foresees, and only it reads these.
FETCH = """
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(list_pos.data + i);
#endif
"""


@dataclass(frozen=True)
class NodeFeatures:
    """What the node sweep of a scene contains; everything else is not compiled."""

    closure: str  # none, paper, consistent
    pairs: str = "none"  # none, closest, arms (see `pairs`)
    walls: tuple[bool, bool, bool] = (False, False, False)
    gravity: bool = False


@cache
def make_skin_limit(name: str):
    """`skin_limit(F, skin, h_list)` -> largest motion beside the flow that a list allows."""
    p = precision(name)
    real, mat33 = p.real, p.mat33
    zero, one, half = real(0.0), real(1.0), real(0.5)

    @wp.func
    def skin_limit(affine: mat33, skin: real, list_reach: real) -> real:
        """Largest |u| (motion beside the flow) with which no unlisted pair can be within reach.

        2 max|u| + (1 - sigma_min(F)) h_list <= skin; 1 - sigma_min is at most the largest row sum
        of |sym(F - I)|.
        """
        stretch = zero
        for row in range(3):
            norm = zero
            for col in range(3):
                identity = zero
                if row == col:
                    identity = one
                norm += wp.abs(half * (affine[row, col] + affine[col, row]) - identity)
            stretch = wp.max(stretch, norm)
        return half * (skin - stretch * list_reach)

    return skin_limit


@cache
def make_node_sweep(name: str, features: NodeFeatures, module: str = "unique"):
    """Kernel `node_sweep` in the given precision with the given features."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    flow_velocity, flow_spin = make_flow(name)
    drag_force, damped_mass = make_drag(name)
    torque_couple = make_torque(name)
    stretching_force = make_stretching(name)
    _, bending_forces = make_bending(name)
    wall_push = make_wall(name)
    skin_limit = make_skin_limit(name)
    (
        split_force,
        translation_factor,
        distributed_translation_factor,
        end_rotation_factor,
        inner_rotation_factor,
    ) = make_closure(name)

    has_pairs = features.pairs != "none"
    has_arms = features.pairs == "arms"
    wall_x, wall_y, wall_z = features.walls
    has_walls = any(features.walls)
    has_gravity = features.gravity
    is_paper = features.closure == "paper"
    is_consistent = features.closure == "consistent"
    zero, one, two, half = real(0.0), real(1.0), real(2.0), real(0.5)
    tear = real(TEAR_STRETCH)

    @wp.func
    def wall_force(
        x: vec3, radius: real, low: vec3, high: vec3, strength: real, decay: real
    ) -> vec3:
        fx, fy, fz = zero, zero, zero
        if wp.static(wall_x):
            fx = wall_push(strength, decay, x[0] - low[0], radius)
            fx -= wall_push(strength, decay, high[0] - x[0], radius)
        if wp.static(wall_y):
            fy = wall_push(strength, decay, x[1] - low[1], radius)
            fy -= wall_push(strength, decay, high[1] - x[1], radius)
        if wp.static(wall_z):
            fz = wall_push(strength, decay, x[2] - low[2], radius)
            fz -= wall_push(strength, decay, high[2] - x[2], radius)
        return vec3(fx, fy, fz)

    @wp.func
    def gather_pairs(
        segment: wp.int32,
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_closest: wp.array(dtype=vec2),
        pair_arm_i: wp.array(dtype=vec3),
        pair_arm_j: wp.array(dtype=vec3),
    ):
        """Total pair force on a segment and its part on the second node.

        Summed by component: the compiler keeps numbers in registers, but not vectors that some
        turns of a loop leave as they are.
        """
        fx, fy, fz = real(0.0), real(0.0), real(0.0)
        sx, sy, sz = real(0.0), real(0.0), real(0.0)
        for k in range(out_start[segment], out_start[segment + 1]):
            if pair_acts[k] != wp.uint8(0):
                force = pair_force[k]
                fx += force[0]
                fy += force[1]
                fz += force[2]
                if wp.static(has_arms):
                    arm = pair_arm_i[k]
                else:
                    arm = pair_closest[k][0] * force
                sx += arm[0]
                sy += arm[1]
                sz += arm[2]
        for slot in range(in_start[segment], in_start[segment + 1]):
            k = in_pair[slot]
            if pair_acts[k] != wp.uint8(0):
                force = pair_force[k]
                fx -= force[0]
                fy -= force[1]
                fz -= force[2]
                if wp.static(has_arms):
                    arm = pair_arm_j[k]
                else:
                    arm = pair_closest[k][1] * force
                sx -= arm[0]
                sy -= arm[1]
                sz -= arm[2]
        return vec3(fx, fy, fz), vec3(sx, sy, sz)

    @wp.func_native(FETCH)
    def fetch(i: wp.int32, list_pos: wp.array(dtype=vec3)): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def node_sweep(
        offset: wp.int32,
        dt: real,
        flow_origin: vec3,
        wall_low: vec3,
        wall_high: vec3,
        strength: real,
        decay: real,
        list_sizes: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        pivots: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_closest: wp.array(dtype=vec2),
        pair_arm_i: wp.array(dtype=vec3),
        pair_arm_j: wp.array(dtype=vec3),
        list_pos: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_force_out: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        g = groups[fiber_group[fiber]]
        first = fiber_node_start[fiber]
        segments = g.segments
        last = first + segments
        flow_gradient = gradient[0]
        spin = flow_spin(flow_gradient)

        # First walk: forces on the nodes before, at and after the joint under way.
        f_before = vec3(zero, zero, zero)
        f_here = vec3(zero, zero, zero)
        x0 = node_pos[first]
        v0 = node_velocity[first]
        n0 = vec3(zero, zero, zero)
        inverse0 = one
        y = vec3(zero, zero, zero)
        longest = zero
        center = x0
        sum_first = vec3(zero, zero, zero)
        sum_last = vec3(zero, zero, zero)
        for k in range(segments):
            i = first + k
            if wp.static(has_pairs):
                fetch(i, list_pos)
            x1 = node_pos[i + 1]
            v1 = node_velocity[i + 1]
            edge = x1 - x0
            d1 = wp.length(edge)
            inverse1 = one / d1
            n1 = inverse1 * edge
            if not (d1 <= longest):
                longest = d1
                if not (d1 < tear * g.rest):
                    longest = two * tear * g.rest

            weight = g.weight
            if k == 0:
                weight += g.weight_excess
            if k == segments - 1:
                weight += g.weight_excess
            couple = torque_couple(g.torque * weight, n1, inverse1, v1 - v0, spin)
            pull = stretching_force(g.stretching, d1, g.rest, n1)
            f_here += pull - couple
            f_after = couple - pull
            if wp.static(has_pairs):
                total, second = gather_pairs(
                    i - fiber,
                    out_start,
                    in_start,
                    in_pair,
                    pair_acts,
                    pair_force,
                    pair_closest,
                    pair_arm_i,
                    pair_arm_j,
                )
                f_here += total - second
                f_after += second
            if k > 0:
                before, after = bending_forces(g.bending, n0, inverse0, n1, inverse1)
                f_before += before
                f_here -= before + after
                f_after += after
                if wp.static(has_walls):
                    f_before += wall_force(
                        node_pos[i - 1], g.radius, wall_low, wall_high, strength, decay
                    )
                if wp.static(is_consistent):
                    y = pivots[g.pivot_start + k - 1] * (f_before - g.coupling * y)
                    f_before = y
                node_force_out[i - 1] = f_before
            if wp.static(is_paper):
                center += x1
                sum_first += real(segments - k) * n1
                sum_last += real(k + 1) * n1
            f_before = f_here
            f_here = f_after
            x0 = x1
            v0 = v1
            n0 = n1
            inverse0 = inverse1
        if wp.static(has_walls):
            f_before += wall_force(
                node_pos[last - 1], g.radius, wall_low, wall_high, strength, decay
            )
            f_here += wall_force(x0, g.radius, wall_low, wall_high, strength, decay)
        if wp.static(is_consistent):
            f_before = pivots[g.pivot_start + segments - 1] * (f_before - g.coupling * y)
            f_here = pivots[g.pivot_start + segments] * (f_here - g.coupling * f_before)
        node_force_out[last - 1] = f_before
        node_force_out[last] = f_here
        if not (longest < tear * g.rest):
            status[wp.static(TORN)] = 1
            status[wp.static(BAD_FIBER)] = fiber
            return

        # Second walk: closure and step.
        n_seg = real(segments)
        alpha_r = one
        alpha_t = one
        if wp.static(is_paper):
            center = center / (n_seg + one)
            alpha_t = translation_factor(g.spacing, n_seg)
            reduced = g.spacing - one
            squares = zero
            beads = zero
            for k in range(segments):
                r = node_pos[first + k] - center
                edge = node_pos[first + k + 1] - node_pos[first + k]
                rr = wp.dot(r, r)
                squares += rr
                beads += rr + two * g.radius * reduced * wp.dot(r, edge) / wp.length(edge)
            r_end = node_pos[last] - center
            rr_end = wp.dot(r_end, r_end)
            squares += rr_end
            alpha_r = (real(3.0) * squares) / (
                real(3.0) * (rr_end + g.spacing * beads)
                + two * g.radius * g.radius * n_seg * reduced * g.spacing * (two * reduced + one)
            )

        half_drag = half * dt * g.drag
        if wp.static(not is_paper):
            kick = dt / damped_mass(g.mass, half_drag)
        affine = mat33(deformation[0])
        limit = zero
        if wp.static(has_pairs):
            limit = skin_limit(affine, list_sizes[1], list_sizes[0])
        furthest = zero
        partial = vec3(zero, zero, zero)
        n_before = vec3(zero, zero, zero)
        n_after = vec3(zero, zero, zero)
        y = vec3(zero, zero, zero)
        for at in range(segments + 1):
            k = at
            if wp.static(is_consistent):
                k = segments - at
            i = first + k
            x = node_pos[i]
            v = node_velocity[i]
            distributed = drag_force(g.drag, flow_velocity(flow_gradient, flow_origin, x), v)
            if wp.static(has_gravity):
                distributed += g.body_force
            force = node_force_out[i]
            if wp.static(is_consistent):
                if at > 0:
                    force -= (g.coupling * pivots[g.pivot_start + k]) * y
                y = force
            if wp.static(is_paper):
                if k < segments:
                    n_after = wp.normalize(node_pos[i + 1] - x)
                inner = partial - sum_first / (n_seg + one)
                rotation = inner_rotation_factor(g.spacing, inner, n_after - n_before)
                is_end = k == 0 or k == segments
                if k == 0:
                    rotation = end_rotation_factor(g.spacing, n_seg, sum_first, n_after)
                if k == segments:
                    rotation = end_rotation_factor(g.spacing, n_seg, sum_last, n_before)
                radial = x - center
                translation = distributed_translation_factor(g.spacing, n_seg, is_end)
                rotation = alpha_r * rotation
                along = dt / damped_mass(g.mass, half_drag * translation)
                across = dt / damped_mass(g.mass, half_drag * rotation)
                v += split_force(force, radial, along * alpha_t, across * alpha_r)
                v += split_force(distributed, radial, along * translation, across * rotation)
                partial += n_after
                n_before = n_after
            else:
                v += kick * (distributed + force)
            x = x + dt * v
            node_velocity[i] = v
            node_pos[i] = x
            if wp.static(has_pairs):
                moved = x - flow_origin - affine * (list_pos[i] - flow_origin)
                distance2 = wp.length_sq(moved)
                if distance2 > furthest:
                    furthest = distance2
        if wp.static(has_pairs):
            if limit < zero or furthest > limit * limit:
                status[wp.static(EXPIRED)] = 1

    return node_sweep
