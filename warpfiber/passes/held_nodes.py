"""Nodes whose motion is given: the velocity they are held at, and fibers that are moved whole.

Source: a held node of an implicit step x = base + h v has v = V. A stored image of a fiber in a
    box that the flow deforms moves at V - L s with s = lattice * image, where s grows with the
    flow; s at the stages of SDIRK2 to first order in dt, so the motion to second.
Symbols: V prescribed velocity, L velocity gradient of a stage, c dt time of a stage.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.elimination import elimination_row

FREE, HELD, FROZEN = range(3)  # what `node_hold` says of a node


@cache
def make_held(name: str, sheared: bool):
    """`held_velocity` of a stored image and `held_impulse`, what is left of a held node's block."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    zero, one = real(0.0), real(1.0)

    @wp.func
    def held_velocity(
        given: vec3, gradient: mat33, lattice: wp.mat33d, image: wp.vec3i, time: real
    ) -> vec3:
        """V of the image in the box, `time` after the start of the step."""
        if wp.static(sheared):
            numbers = wp.vec3d(wp.float64(image[0]), wp.float64(image[1]), wp.float64(image[2]))
            away = vec3(lattice * numbers)
            away += time * (gradient * away)
            return given - gradient * away
        return given

    @wp.func
    def held_impulse(slack: real) -> real:
        """Inverse pivot of the impulse behind a held node; 0 between two that keep their length."""
        if slack > zero:
            return -one / slack
        return zero

    return held_velocity, held_impulse


@cache
def make_carry_fibers(name: str, sheared: bool, chi: float):
    """Kernel `carry_fibers`: every frozen fiber by dt ((1 - chi) V_1 + chi V_2), V at the stages.

    `row_stride` > 0: rows of the elimination that are looked at after it, of what no force moves.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Row = elimination_row(name)
    held_velocity, _ = make_held(name, sheared)
    early, late = real(chi), real(1.0 - chi)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def carry_fibers(
        offset: wp.int32,
        keeps: wp.int32,
        row_stride: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        stage_gradient: wp.array(dtype=mat33),
        fiber_node_start: wp.array(dtype=wp.int32),
        node_hold: wp.array(dtype=wp.uint8),
        node_load: wp.array(dtype=vec3),
        fiber_image: wp.array(dtype=wp.vec3i),
        lattice: wp.array(dtype=wp.mat33d),
        rows: wp.array(dtype=Row),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_motion: wp.array(dtype=vec3),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        first = fiber_node_start[fiber]
        if wp.int32(node_hold[first]) != wp.static(FROZEN):
            return
        given, image = node_load[first], fiber_image[fiber]
        dt = real(step_size[0])
        end = held_velocity(given, stage_gradient[1], lattice[0], image, dt)
        move = dt * end
        if wp.static(sheared):
            begin = held_velocity(given, stage_gradient[0], lattice[0], image, early * dt)
            move = dt * (late * begin + early * end)
        for i in range(first, fiber_node_start[fiber + 1]):
            x = node_pos[i]
            if keeps != 0:
                node_back[i] = x
                velocity_back[i] = node_velocity[i]
            node_pos[i] = x + move
            node_velocity[i] = end
            node_motion[i] = move
            if row_stride > 0:
                rows[row_stride * fiber + i - first] = Row()

    return carry_fibers
