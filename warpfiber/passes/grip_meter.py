"""Forces on the two gripped groups of nodes of a bed that is pulled or sheared, and their course.

The bond sweep leaves at every gripped node the force of bonds and contacts on it; chunks of nodes
are summed side by side, then one thread adds the chunks, so a sum is the same for any number of
workers. All in float64.
Source: means forget as those of walls do (`wall_press.AVERAGED`) and begin with the first step.
    Mean and deviation of the steady part by Welford's update, work by the trapezoidal rule.
Symbols: stress component c = 0 (x) or 2 (z): minus the force on the upper group, per area.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.bonds import LOWER, UPPER
from warpfiber.passes.wall_press import AVERAGED

CHUNK = 256  # nodes per thread
# what the stage asks for: the component (-1: no grips), step from which it counts as steady, speed
COMPONENT, STEADY_FROM, SPEED = 0, 1, 2
TASK_SIZE = 3
# the course of the stage so far: steps, largest mean force and its step, then of the steady part
# the number of steps, the mean and the sum of squared deviations; the work of all stages
STEPS, PEAK, PEAK_STEP, COUNT, MEAN, DEVIATION, WORK = range(7)
COURSE_SIZE = 7


@cache
def make_grip_sum(name: str):
    """Kernel `sum_grips`: one thread per CHUNK nodes."""
    vec3 = precision(name).vec3

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def sum_grips(
        task: wp.array(dtype=wp.float64),
        node_hold: wp.array(dtype=wp.int32),
        node_grip: wp.array(dtype=vec3),
        chunk_low: wp.array(dtype=wp.vec3d),
        chunk_high: wp.array(dtype=wp.vec3d),
    ):
        if task[wp.static(COMPONENT)] < wp.float64(0.0):
            return
        chunk = wp.tid()
        first = chunk * wp.static(CHUNK)
        last = wp.min(first + wp.static(CHUNK), node_hold.shape[0])
        low = wp.vec3d()
        high = wp.vec3d()
        for i in range(first, last):
            hold = node_hold[i]
            if hold == wp.static(LOWER):
                low += wp.vec3d(node_grip[i])
            if hold == wp.static(UPPER):
                high += wp.vec3d(node_grip[i])
        chunk_low[chunk] = low
        chunk_high[chunk] = high

    return sum_grips


@cache
def make_grip_meter():
    """Kernel `meter_grips` (one thread): forces on both groups, their means, and the course."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def meter_grips(
        dt: wp.float64,
        status: wp.array(dtype=wp.int32),
        task: wp.array(dtype=wp.float64),
        chunk_low: wp.array(dtype=wp.vec3d),
        chunk_high: wp.array(dtype=wp.vec3d),
        grip: wp.array(dtype=wp.vec3d),
        grip_mean: wp.array(dtype=wp.vec3d),
        course: wp.array(dtype=wp.float64),
    ):
        if status[wp.static(HALT)] != 0 or task[wp.static(COMPONENT)] < wp.float64(0.0):
            return
        low = wp.vec3d()
        high = wp.vec3d()
        for chunk in range(chunk_low.shape[0]):
            low += chunk_low[chunk]
            high += chunk_high[chunk]
        is_x = task[wp.static(COMPONENT)] == wp.float64(0.0)
        now = wp.where(is_x, high[0], high[2])
        before = wp.where(is_x, grip[1][0], grip[1][2])
        steps = course[wp.static(STEPS)] + wp.float64(1.0)
        acted = wp.float64(0.5) * (before + now)
        share = wp.float64(1.0) / wp.float64(wp.static(AVERAGED))
        if steps == wp.float64(1.0):
            share = wp.float64(1.0)
            acted = now
        course[wp.static(WORK)] = course[wp.static(WORK)] - dt * acted * task[wp.static(SPEED)]
        grip[0] = low
        grip[1] = high
        grip_mean[0] = grip_mean[0] + share * (low - grip_mean[0])
        grip_mean[1] = grip_mean[1] + share * (high - grip_mean[1])
        force = -wp.where(is_x, grip_mean[1][0], grip_mean[1][2])
        if steps == wp.float64(1.0) or force > course[wp.static(PEAK)]:
            course[wp.static(PEAK)] = force
            course[wp.static(PEAK_STEP)] = steps
        if steps > task[wp.static(STEADY_FROM)]:
            count = course[wp.static(COUNT)] + wp.float64(1.0)
            off = force - course[wp.static(MEAN)]
            mean = course[wp.static(MEAN)] + off / count
            course[wp.static(COUNT)] = count
            course[wp.static(MEAN)] = mean
            course[wp.static(DEVIATION)] = course[wp.static(DEVIATION)] + off * (force - mean)
        course[wp.static(STEPS)] = steps

    return meter_grips
