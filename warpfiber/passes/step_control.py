"""Begin and end of an implicit step: the flow at its stages, acceptance, time, size of the next.

A step that fails (error above the tolerance, contact that was not kept apart) is taken back and
repeated by a smaller one, of contact as `contact_verdict` says; one that the neighbor list or the
rows of contact cannot hold is taken back as it is, and the host enlarges them.

Source: stage strains by the midpoint rule of d(strain)/dt = rate f(strain); the lattice follows the
    gradient of the middle of the step. Step sizes: accept an error up to 1.5 tolerances, then dt
    times clip(0.85 sqrt(tol / error), 0.3, 2); after a rejection max(0.2, 0.8 sqrt(tol / error)).
Symbols: chi = 1 - 1/sqrt 2 (end of stage 1 of SDIRK2); error in fiber lengths, the largest of all
    fibers.
Limits: one size for all fibers.
"""

from functools import cache

import warp as wp

from warpfiber.model import BAD_FIBER, EXPIRED, HALT, TORN, precision
from warpfiber.passes.chain_solve import CHI
from warpfiber.passes.clock import make_flow_history

ERROR_CHUNKS = 64
KEEP, HALVE, AGAIN = range(3)  # verdicts on a step
SMALLEST_SHARE = 1e-9  # of the largest step: below it a fiber that is still rejected is torn


@cache
def make_step_begin(name: str, sheared: bool = False, module: str = "unique"):
    """Kernel `step_begin` (one thread): what the step is made with; halts until the host looked.

    Gradients of both stages; lattice at start and end; deformation of the list's end.
    """
    mat33 = precision(name).mat33
    rate_factor, lattice_push = make_flow_history()

    @wp.func
    def strain_after(
        strain: wp.float64,
        time: wp.float64,
        rate: wp.float64,
        schedule: wp.array(dtype=wp.vec2d),
    ) -> wp.float64:
        half = wp.float64(0.5) * time * rate
        middle = strain + half * rate_factor(strain, schedule)
        return strain + wp.float64(2.0) * half * rate_factor(middle, schedule)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def step_begin(
        rate: wp.float64,
        full_gradient: wp.mat33d,
        schedule: wp.array(dtype=wp.vec2d),
        step_size: wp.array(dtype=wp.float64),
        strain: wp.array(dtype=wp.float64),
        lattice: wp.array(dtype=wp.mat33d),
        deformation: wp.array(dtype=wp.mat33d),
        status: wp.array(dtype=wp.int32),
        rejected_out: wp.array(dtype=wp.int32),
        strain_next_out: wp.array(dtype=wp.float64),
        stage_gradient_out: wp.array(dtype=mat33),
        ends_lattice_out: wp.array(dtype=mat33),
        deformation_next_out: wp.array(dtype=wp.mat33d),
    ):
        rejected_out[0] = 0
        if status[wp.static(TORN)] + status[wp.static(EXPIRED)] != 0:
            status[wp.static(HALT)] = 1
            return
        status[wp.static(HALT)] = 0
        dt = step_size[0]
        first = strain_after(strain[0], wp.float64(wp.static(CHI)) * dt, rate, schedule)
        last = strain_after(strain[0], dt, rate, schedule)
        stage_gradient_out[0] = mat33(rate_factor(first, schedule) * full_gradient)
        stage_gradient_out[1] = mat33(rate_factor(last, schedule) * full_gradient)
        strain_next_out[0] = last
        middle = rate_factor(wp.float64(0.5) * (strain[0] + last), schedule)
        push = lattice_push((dt * middle) * full_gradient)
        deformation_next_out[0] = push * deformation[0]
        ends_lattice_out[0] = mat33(lattice[0])
        ends_lattice_out[1] = mat33(lattice[0])
        if wp.static(sheared):
            ends_lattice_out[1] = mat33(push * lattice[0])

    return step_begin


@cache
def make_largest_error(name: str, module: str = "unique"):
    """Kernel `largest_error`: largest error of every run of fibers, and its fiber."""
    real = precision(name).real

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def largest_error(
        chunks: wp.int32,
        fiber_error: wp.array(dtype=real),
        error_out: wp.array(dtype=wp.float64),
        fiber_out: wp.array(dtype=wp.int32),
    ):
        chunk = wp.tid()
        fibers = wp.int64(fiber_error.shape[0])
        begin = wp.int32(fibers * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(fibers * wp.int64(chunk + 1) / wp.int64(chunks))
        largest = real(0.0)
        worst = begin
        for fiber in range(begin, end):
            error = fiber_error[fiber]
            if not (error <= largest):
                largest = error
                worst = fiber
        error_out[chunk] = wp.float64(largest)
        fiber_out[chunk] = worst

    return largest_error


@cache
def make_step_end(
    name: str, sheared: bool, adaptive: bool, judged: bool = False, module: str = "unique"
):
    """Kernel `step_end` (one thread): accept or not, advance the time, choose the next step.

    `judged`: a verdict on the contacts of the step may ask for less of it (1) or for the same again
    after the host has enlarged something (2); `pace` is the next step over this one.
    """
    mat33 = precision(name).mat33
    rate_factor, lattice_push = make_flow_history()

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def step_end(
        full_gradient: wp.mat33d,
        schedule: wp.array(dtype=wp.vec2d),
        tolerance: wp.float64,
        largest_step: wp.float64,
        error: wp.array(dtype=wp.float64),
        error_fiber: wp.array(dtype=wp.int32),
        verdict: wp.array(dtype=wp.int32),
        pace: wp.array(dtype=wp.float64),
        strain_next: wp.array(dtype=wp.float64),
        step_size: wp.array(dtype=wp.float64),
        rejected_out: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int64),
        time: wp.array(dtype=wp.float64),
        strain: wp.array(dtype=wp.float64),
        gradient_out: wp.array(dtype=mat33),
        lattice: wp.array(dtype=wp.mat33d),
        lattice_now_out: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        dt = step_size[0]
        if wp.static(judged):
            if verdict[0] != 0:
                rejected_out[0] = 1
                if verdict[0] == wp.static(AGAIN):
                    status[wp.static(EXPIRED)] = 1
                    return
                rejected_out[1] = rejected_out[1] + 1
                step_size[0] = pace[0] * dt
                if step_size[0] < wp.float64(wp.static(SMALLEST_SHARE)) * largest_step:
                    status[wp.static(TORN)] = 1
                    status[wp.static(BAD_FIBER)] = verdict[1]
                return
            step_size[0] = wp.min(pace[0] * dt, largest_step)
        if wp.static(adaptive):
            largest = wp.float64(0.0)
            worst = wp.int32(0)
            for k in range(error.shape[0]):
                if not (error[k] <= largest):
                    largest = error[k]
                    worst = error_fiber[k]
            ratio = wp.float64(1.0e3)
            if largest > wp.float64(1.0e-6) * tolerance:
                ratio = wp.sqrt(tolerance / largest)
            factor = wp.clamp(wp.float64(0.85) * ratio, wp.float64(0.3), wp.float64(2.0))
            if not (largest <= wp.float64(1.5) * tolerance):
                rejected_out[0] = 1
                rejected_out[1] = rejected_out[1] + 1
                factor = wp.float64(0.2)
                if largest < wp.float64(1.0e20):
                    factor = wp.max(factor, wp.float64(0.8) * ratio)
            step_size[0] = wp.min(factor * dt, largest_step)
            if rejected_out[0] != 0:
                if step_size[0] < wp.float64(wp.static(SMALLEST_SHARE)) * largest_step:
                    status[wp.static(TORN)] = 1
                    status[wp.static(BAD_FIBER)] = worst
                return
        middle = rate_factor(wp.float64(0.5) * (strain[0] + strain_next[0]), schedule)
        push = lattice_push((dt * middle) * full_gradient)
        lattice_now_out[0] = mat33(lattice[0])
        if wp.static(sheared):
            lattice[0] = push * lattice[0]
        deformation[0] = push * deformation[0]
        time[0] = time[0] + dt
        strain[0] = strain_next[0]
        gradient_out[0] = mat33(rate_factor(strain[0], schedule) * full_gradient)
        step[0] = step[0] + wp.int64(1)

    return step_end


@cache
def make_take_back(name: str, tense: bool = True, module: str = "unique"):
    """Kernel `take_back`: every fiber as before a rejected step, one thread per fiber.

    `tense`: segments carry a tension from step to step.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def take_back(
        offset: wp.int32,
        rejected: wp.array(dtype=wp.int32),
        fiber_node_start: wp.array(dtype=wp.int32),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        tension_back: wp.array(dtype=real),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
    ):
        if rejected[0] == 0:
            return
        fiber = wp.tid() + offset
        last = fiber_node_start[fiber + 1] - 1
        for i in range(fiber_node_start[fiber], last + 1):
            node_pos[i] = node_back[i]
            node_velocity[i] = velocity_back[i]
            if wp.static(tense):
                if i < last:
                    tension[i - fiber] = tension_back[i - fiber]

    return take_back
