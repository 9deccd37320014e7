"""Plane walls that move along their normal: their motion, the force on each, their work.

Fibers write what they push with; chunks of fibers are summed side by side, then one thread adds the
chunks, so a sum is the same for any number of workers. All in float64.
Source: work = sum of force times velocity of the wall, by the trapezoidal rule over a step. Means
    forget: of a step n steps ago they keep (1 - 1/AVERAGED)^n, of forces and distance alike.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT

CHUNK = 32  # fibers per thread
AVERAGED = 50.0  # steps


@cache
def make_wall_motion(axis: int):
    """Kernel `move_walls` (one thread): both walls of an axis move on by dt."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def move_walls(
        dt: wp.float64,
        status: wp.array(dtype=wp.int32),
        wall_velocity: wp.array(dtype=wp.vec2d),
        wall_place: wp.array(dtype=wp.vec3d),
    ):
        if status[wp.static(HALT)] != 0:
            return
        for side in range(2):
            place = wall_place[side]
            place[wp.static(axis)] = place[wp.static(axis)] + dt * wall_velocity[0][side]
            wall_place[side] = place

    return move_walls


@cache
def make_push_sum():
    """Kernel `sum_pushes`: one thread per CHUNK fibers."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def sum_pushes(
        fiber_push: wp.array(dtype=wp.vec2d),
        chunk_push: wp.array(dtype=wp.vec2d),
    ):
        chunk = wp.tid()
        first = chunk * wp.static(CHUNK)
        last = wp.min(first + wp.static(CHUNK), fiber_push.shape[0])
        total = wp.vec2d()
        for fiber in range(first, last):
            total += fiber_push[fiber]
        chunk_push[chunk] = total

    return sum_pushes


@cache
def make_wall_meter(axis: int):
    """Kernel `meter_walls` (one thread): forces, their means with the distance, and the work."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def meter_walls(
        dt: wp.float64,
        status: wp.array(dtype=wp.int32),
        chunk_push: wp.array(dtype=wp.vec2d),
        wall_place: wp.array(dtype=wp.vec3d),
        wall_velocity: wp.array(dtype=wp.vec2d),
        wall_push: wp.array(dtype=wp.vec2d),
        wall_mean: wp.array(dtype=wp.vec3d),
        wall_work: wp.array(dtype=wp.float64),
    ):
        if status[wp.static(HALT)] != 0:
            return
        total = wp.vec2d()
        for chunk in range(chunk_push.shape[0]):
            total += chunk_push[chunk]
        v = wall_velocity[0]
        acted = wp.float64(0.5) * (wall_push[0] + total)
        # fibers are pushed up by the lower wall and down by the upper one
        wall_work[0] = wall_work[0] + dt * (acted[0] * v[0] - acted[1] * v[1])
        wall_push[0] = total
        gap = wall_place[1][wp.static(axis)] - wall_place[0][wp.static(axis)]
        found = wp.vec3d(total[0], total[1], gap)
        share = wp.float64(1.0) / wp.float64(wp.static(AVERAGED))
        wall_mean[0] = wall_mean[0] + share * (found - wall_mean[0])

    return meter_walls
