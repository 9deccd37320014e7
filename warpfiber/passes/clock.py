"""Begin of a step: time, strain, the flow's gradient, the lattice and the list's deformation.

Source: d(lattice)/dt = L lattice for a box whose lattice moves with the flow; exp(L dt) by its
    series to fourth order where L dt is small (exact for simple shear, where L L = 0).
"""

from functools import cache

import warp as wp

from warpfiber.model import EXPIRED, HALT, TORN, precision
from warpfiber.passes.exponential import make_exponential

SERIES_SIZE = 0.03  # row sum of L dt up to which the fourth order is enough


@cache
def make_flow_history():
    """`rate_factor(strain, schedule)` and `lattice_push(L dt)` = exp(L dt), in float64."""
    largest_row_sum, exponential_change = make_exponential()

    @wp.func
    def rate_factor(strain: wp.float64, schedule: wp.array(dtype=wp.vec2d)) -> wp.float64:
        """Linear between the rows (strain, factor), constant beyond them."""
        n = schedule.shape[0]
        if strain <= schedule[0][0]:
            return schedule[0][1]
        for k in range(1, n):
            if strain < schedule[k][0]:
                w = (strain - schedule[k - 1][0]) / (schedule[k][0] - schedule[k - 1][0])
                return (wp.float64(1.0) - w) * schedule[k - 1][1] + w * schedule[k][1]
        return schedule[n - 1][1]

    @wp.func
    def lattice_push(x: wp.mat33d) -> wp.mat33d:
        one = wp.identity(n=3, dtype=wp.float64)
        if largest_row_sum(x) > wp.float64(wp.static(SERIES_SIZE)):
            change, _unused = exponential_change(x)
            return one + change
        return one + x * (
            one
            + (x * (one + (x * (one + x * wp.float64(0.25))) * wp.float64(1.0 / 3.0)))
            * wp.float64(0.5)
        )

    return rate_factor, lattice_push


@cache
def make_clock(name: str, sheared: bool, scheduled: bool, module: str = "unique"):
    """Kernel `clock_step` (one thread)."""
    p = precision(name)
    mat33 = p.mat33

    rate_factor, lattice_push = make_flow_history()

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def clock_step(
        dt: wp.float64,
        rate: wp.float64,
        full_gradient: wp.mat33d,
        schedule: wp.array(dtype=wp.vec2d),
        status: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int64),
        time: wp.array(dtype=wp.float64),
        strain: wp.array(dtype=wp.float64),
        gradient_out: wp.array(dtype=mat33),
        lattice: wp.array(dtype=wp.mat33d),
        lattice_now_out: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
    ):
        if status[wp.static(EXPIRED)] + status[wp.static(TORN)] != 0:
            status[wp.static(HALT)] = 1
            return
        status[wp.static(HALT)] = 0
        factor = wp.float64(1.0)
        if wp.static(scheduled):
            factor = rate_factor(strain[0], schedule)
        gradient = factor * full_gradient
        gradient_out[0] = mat33(gradient)
        lattice_now_out[0] = mat33(lattice[0])
        push = lattice_push(dt * gradient)
        if wp.static(sheared):
            lattice[0] = push * lattice[0]
        deformation[0] = push * deformation[0]
        time[0] = time[0] + dt
        strain[0] = strain[0] + dt * rate * factor
        step[0] = step[0] + wp.int64(1)

    return clock_step
