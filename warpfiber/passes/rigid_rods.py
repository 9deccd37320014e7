"""One step of rigid straight rods in a linear flow: an exact map, one thread per rod.

Source: Jeffery 1922, and the balance of bead drag 6 pi eta a and bead torque 8 pi eta a^3 along a
    rigid line of N touching beads. In u = G (x - x0), with p the direction and c the center:
        p -> e^B p / |e^B p|,      B = phi (W + lambda_J S) = phi [(1 - mu) G - mu G^T]
        c - x0 -> e^(phi G) (c - x0) + dt psi v,   psi = integral of e^(phi G t), t = 0 ... 1
    Both are applied as changes, e^B - 1, so that short steps do not drift by rounding. Forces F0,
    F1 on the ends: v = v_s + (F0 + F1)/xi, and a couple (`laws.rod_mobility`) that turns the rod
    for dt/2 before and after e^B.
Symbols: W, S antisymmetric and symmetric part of G; phi = integral of the factor on the rate over
    the step; lambda_J = 1 - 2 mu; v_s settling velocity, weight less buoyancy of a bead over its
    drag; H = l / 2.
Limits: exact in the strain of the step for any step, and for any force in a fluid at rest; where a
    schedule changes the rate within it, settling is taken at the mean rate, where flow and a couple
    turn a rod together, one after the other (both second order). The nodes are put at c -+ H p anew
    every step, so a length cannot drift.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.laws.flow import make_flow
from warpfiber.laws.rod_mobility import make_rod_alignment, make_rod_mobility
from warpfiber.model import BAD_FIBER, HALT, TORN, precision
from warpfiber.passes.exponential import make_exponential
from warpfiber.passes.native_rods import rods_text
from warpfiber.passes.precision import group_struct

CHUNK = 64  # rods per launch index on the CPU


@cache
def rod_map(name: str) -> Any:
    """Warp struct of what a step does to all rods of one shape in one gradient."""
    p = precision(name)
    vec3, mat33 = p.vec3, p.mat33

    @wp.struct
    class RodMap:
        turn: mat33  # e^B - 1
        move: mat33  # e^(phi G) - 1
        drift: mat33  # dt psi
        turning: mat33  # (1 - mu) G - mu G^T at the end of the step
        gradient: mat33  # G there
        settling: vec3  # v_s

    return RodMap


@cache
def make_rod_maps(name: str, module: str = "unique"):
    """Kernel `rod_maps`: the map of every shape, one thread each, in float64.

    `shape_mu`: (1 - lambda_J)/2 of every shape; `shape_settling`: v_s.
    """
    p = precision(name)
    vec3, mat33 = p.vec3, p.mat33
    RodMap = rod_map(name)
    _, exponential_change = make_exponential()

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rod_maps(
        rate: wp.float64,
        full_gradient: wp.mat33d,
        shape_mu: wp.array(dtype=wp.float64),
        shape_settling: wp.array(dtype=wp.vec3d),
        step_size: wp.array(dtype=wp.float64),
        strain: wp.array(dtype=wp.float64),
        strain_next: wp.array(dtype=wp.float64),
        end_gradient: wp.array(dtype=mat33),
        status: wp.array(dtype=wp.int32),
        maps_out: wp.array(dtype=RodMap),
    ):
        if status[wp.static(HALT)] != 0:
            return
        shape = wp.tid()
        dt = step_size[0]
        mu = shape_mu[shape]
        settling = shape_settling[shape]
        phi = wp.float64(0.0)
        if rate > wp.float64(0.0):
            phi = (strain_next[0] - strain[0]) / rate
        one = wp.float64(1.0)
        change = (one - mu) * full_gradient - mu * wp.transpose(full_gradient)
        turn, _unused = exponential_change(phi * change)
        move, mean = exponential_change(phi * full_gradient)
        now = wp.mat33d(end_gradient[1])
        m = RodMap()
        m.turn = mat33(turn)
        m.move = mat33(move)
        m.drift = mat33(dt * mean)
        m.turning = mat33((one - mu) * now - mu * wp.transpose(now))
        m.gradient = end_gradient[1]
        m.settling = vec3(settling)
        maps_out[shape] = m

    return rod_maps


@cache
def make_rod_step(name: str, loaded: bool, module: str = "unique"):
    """Kernel `rod_step`: one step of every rod; rod f has the nodes 2 f and 2 f + 1.

    `keeps`: steps may be rejected, so the start is kept. `rod_shape`: which map moves a rod.
    `node_load`: forces on the nodes, where the scene has any (`loaded`).
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    RodMap = rod_map(name)
    flow_velocity, _ = make_flow(name)
    turning_drag, _ = make_rod_mobility(name)
    align = make_rod_alignment(name)
    half, one, endless = real(0.5), real(1.0), real(1.0e30)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rod_step(
        offset: wp.int32,
        keeps: wp.int32,
        flow_origin: vec3,
        maps: wp.array(dtype=RodMap),
        rod_shape: wp.array(dtype=wp.int32),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        step_size: wp.array(dtype=wp.float64),
        node_load: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        first = 2 * fiber
        m = maps[rod_shape[fiber]]
        x0 = node_pos[first]
        x1 = node_pos[first + 1]
        if keeps != 0:
            node_back[first] = x0
            node_back[first + 1] = x1
            velocity_back[first] = node_velocity[first]
            velocity_back[first + 1] = node_velocity[first + 1]
        g = groups[fiber_group[fiber]]
        half_length = half * g.rest
        drawn = m.settling
        couple = vec3()
        axis = x1 - x0
        if wp.static(loaded):
            f0 = node_load[first]
            f1 = node_load[first + 1]
            beads = g.spacing + one
            drawn = drawn + (one / (g.drag * beads)) * (f0 + f1)
            weight = g.weight + g.weight_excess + g.weight_excess
            couple = (half_length / turning_drag(g.torque, beads, weight)) * (f1 - f0)
            spell = half * real(step_size[0])
            axis = align(wp.normalize(axis), spell * couple)
            axis = axis + m.turn * axis
            axis = align(wp.normalize(axis), spell * couple)
        else:
            axis = axis + m.turn * axis
        arm = (half_length / wp.sqrt(wp.dot(axis, axis))) * axis
        center = half * (x0 + x1)
        center = center + (m.move * (center - flow_origin) + m.drift * drawn)
        node_pos[first] = center - arm
        node_pos[first + 1] = center + arm

        velocity = flow_velocity(m.gradient, flow_origin, center) + drawn
        swing = m.turning * arm + half_length * couple
        swing = swing - (wp.dot(swing, arm) / (half_length * half_length)) * arm
        node_velocity[first] = velocity - swing
        node_velocity[first + 1] = velocity + swing
        # A length comes out of a step as it should be: only what is not a number fails here.
        if not (wp.abs(wp.dot(center, arm)) < endless):
            status[wp.static(TORN)] = 1
            status[wp.static(BAD_FIBER)] = fiber

    return rod_step


@cache
def make_native_rod_step(name: str, module: str = "unique"):
    """Kernel `native_rod_step`: the same of rods of one shape without loads, over CHUNK rods each.

    For the CPU; takes what `rod_step` takes.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    RodMap = rod_map(name)

    @wp.func_native(rods_text(name))
    def step_rods(
        first: wp.int32,
        last: wp.int32,
        keeps: wp.int32,
        half_length: real,
        flow_origin: vec3,
        turn: mat33,
        move: mat33,
        drift: mat33,
        turning: mat33,
        gradient: mat33,
        settling: vec3,
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
    ) -> wp.int32: ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def native_rod_step(
        offset: wp.int32,
        keeps: wp.int32,
        flow_origin: vec3,
        maps: wp.array(dtype=RodMap),
        rod_shape: wp.array(dtype=wp.int32),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        step_size: wp.array(dtype=wp.float64),
        node_load: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        first = wp.static(CHUNK) * (wp.tid() + offset)
        m = maps[0]
        lost = step_rods(
            first,
            wp.min(first + wp.static(CHUNK), fiber_group.shape[0]),
            keeps,
            real(0.5) * groups[0].rest,
            flow_origin,
            m.turn,
            m.move,
            m.drift,
            m.turning,
            m.gradient,
            m.settling,
            node_pos,
            node_velocity,
            node_back,
            velocity_back,
        )
        if lost >= 0:
            status[wp.static(TORN)] = 1
            status[wp.static(BAD_FIBER)] = lost

    return native_rod_step
