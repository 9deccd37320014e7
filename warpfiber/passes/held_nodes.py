"""Nodes whose motion is given: the velocity they are held at, and fibers that are moved whole.

Source: a held node of an implicit step x = base + h v has v = V. A stored image of a fiber in a
    box that the flow deforms moves at V - L s with s = lattice * image, where s grows with the
    flow; s at the stages of SDIRK2 to first order in dt, so the motion to second.
Symbols: V prescribed velocity, L velocity gradient of a stage, c dt time of a stage.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision

FREE, HELD, FROZEN = range(3)  # what `node_hold` says of a node


@cache
def make_held(name: str, sheared: bool, chi: float):
    """`held_velocity` of one node at a stage and `carry_fiber` of all of them over a step."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    early, late, zero, one = real(chi), real(1.0 - chi), real(0.0), real(1.0)

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
    def carry_fiber(
        first: wp.int32,
        last: wp.int32,
        keeps: wp.int32,
        dt: real,
        given: vec3,
        stage_gradient: wp.array(dtype=mat33),
        lattice: wp.mat33d,
        image: wp.vec3i,
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_motion: wp.array(dtype=vec3),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
    ):
        """All nodes by dt ((1 - chi) V_1 + chi V_2), the end of both stages of SDIRK2."""
        end = held_velocity(given, stage_gradient[1], lattice, image, dt)
        move = dt * end
        if wp.static(sheared):
            begin = held_velocity(given, stage_gradient[0], lattice, image, early * dt)
            move = dt * (late * begin + early * end)
        for i in range(first, last + 1):
            x = node_pos[i]
            if keeps != 0:
                node_back[i] = x
                velocity_back[i] = node_velocity[i]
            node_pos[i] = x + move
            node_velocity[i] = end
            node_motion[i] = move

    @wp.func
    def held_impulse(slack: real) -> real:
        """Inverse pivot of the impulse behind a held node; 0 between two that keep their length."""
        if slack > zero:
            return -one / slack
        return zero

    return held_velocity, carry_fiber, held_impulse
