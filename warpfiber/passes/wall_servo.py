"""A wall that is loaded instead of led: a plate with a mass under a load that grows at a rate.

Source: M du/dt = load - push, leapfrog as the nodes: the push of the step before changes the speed
    with which the wall goes through the next one. |u| stays below a bound.
Symbols: u speed inwards, push = force of all fibers on the wall, load(t) = first + rate t, never
    below 0. All in float64 and run units.
Limits: what the plate takes to accelerate is missing in the push: over stiffness k a steady ramp is
    followed to rate / sqrt(k / M); at the speed bound the push says nothing of the load.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT

# side of the wall (-1: led by the stage), its direction inwards, mass, bound of the speed, load at
# the begin of the stage, its rate, time of the begin
SIDE, INWARD, MASS, BOUND, FIRST, RATE, BEGIN = range(7)
SERVO_SIZE = 7


@cache
def make_wall_servo():
    """Kernel `steer_wall` (one thread): velocity of the loaded wall for this step."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def steer_wall(
        dt: wp.float64,
        status: wp.array(dtype=wp.int32),
        time: wp.array(dtype=wp.float64),
        servo: wp.array(dtype=wp.float64),
        wall_push: wp.array(dtype=wp.vec2d),
        wall_velocity: wp.array(dtype=wp.vec2d),
    ):
        if status[wp.static(HALT)] != 0 or servo[wp.static(SIDE)] < wp.float64(0.0):
            return
        past = time[0] - dt - servo[wp.static(BEGIN)]  # the clock is ahead of the push
        load = servo[wp.static(FIRST)] + servo[wp.static(RATE)] * past
        load = wp.max(load, wp.float64(0.0))
        v = wall_velocity[0]
        push = wall_push[0]
        is_low = servo[wp.static(SIDE)] == wp.float64(0.0)
        u = servo[wp.static(INWARD)] * wp.where(is_low, v[0], v[1])
        u += dt * (load - wp.where(is_low, push[0], push[1])) / servo[wp.static(MASS)]
        bound = servo[wp.static(BOUND)]
        u = servo[wp.static(INWARD)] * wp.clamp(u, -bound, bound)
        wall_velocity[0] = wp.where(is_low, wp.vec2d(u, v[1]), wp.vec2d(v[0], u))

    return steer_wall
