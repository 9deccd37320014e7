"""Motion of rigid rods by forces on their contact rows.

Source: balance of bead drag 6 pi eta a along a rigid line of N beads and bead torque
    8 pi eta a^3 over w of them:
        v = (F0 + F1)/xi,  dp/dt = H (I - p p^T)(F1 - F0)/K_r,  shift = dt (v -/+ H dp/dt)
    with forces F0, F1 at the two ends; a force at the fraction s of the rod is (1 - s) and s of it.
Symbols: xi = 6 pi eta a N, K_r = 2 pi eta a^3 (N (N^2 - 1) + 4 w), H = (N - 1) a, p unit
    direction; w = N, or N - 1 with plain weights.
Limits: the direction is that of the start of the step, where the rows were made.
"""

from functools import cache

import numpy as np
import warp as wp

from warpfiber.laws.rod_mobility import make_rod_mobility
from warpfiber.model import HALT, Model, precision
from warpfiber.passes.dual_rows import DONE, NEXT_PHASE
from warpfiber.passes.executor import Call, Launch
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.native_rod_apply import make_native_rod_apply
from warpfiber.passes.native_rod_sweeps import SWEEP_NUMBERS
from warpfiber.passes.precision import group_struct
from warpfiber.passes.relaxation_launches import relaxation_launches, relaxation_work
from warpfiber.passes.rigid_rods import CHUNK
from warpfiber.passes.rod_relaxation import MOTION, ROD_NUMBERS, make_rod_relaxation
from warpfiber.passes.rub_response import rod_rub, rub_clear
from warpfiber.passes.unilateral import ContactDual


@cache
def make_rod_response(name: str, has_frozen: bool, module: str = "unique"):
    """Kernel `rod_response`, one thread per rod: forces of its rows gathered, shift of its ends."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    turning_drag, _ = make_rod_mobility(name)
    one, half = real(1.0), real(0.5)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rod_response(
        offset: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_start: wp.array(dtype=vec3),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        control: wp.array(dtype=wp.int32),
        node_shift: wp.array(dtype=vec3),
    ):
        if control[wp.static(NEXT_PHASE)] == wp.static(DONE):
            return
        fiber = wp.tid() + offset
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                return
        begin = row_out_start[fiber]
        end = row_out_start[fiber + 1]
        r = fiber_in[fiber]
        if begin == end and r < 0:
            return
        total = vec3()
        across = vec3()  # F1 - F0
        for k in range(begin, end):
            push = row_force[k] * row_normal[k]
            total -= push
            across -= (row_s[k] + row_s[k] - one) * push
        while r >= 0:
            push = row_force[r] * row_normal[r]
            total += push
            across += (row_t[r] + row_t[r] - one) * push
            r = row_next[r]
        g = groups[fiber_group[fiber]]
        axis = wp.normalize(node_start[2 * fiber + 1] - node_start[2 * fiber])
        beads = g.spacing + one
        reach = half * g.rest
        dt = real(step_size[0])
        move = (dt / (g.drag * beads)) * total
        turning = turning_drag(g.torque, beads, g.weight + g.weight_excess + g.weight_excess)
        turn = (dt * reach * reach / turning) * (across - wp.dot(axis, across) * axis)
        node_shift[2 * fiber] = move - turn
        node_shift[2 * fiber + 1] = move + turn

    return rod_response


@cache
def make_rod_apply(name: str, module: str = "unique"):
    """Kernel `rod_apply`, one thread per rod: moved by its shift, its length as at rest.

    `carried`: share of the shift's velocity that `node_velocity` takes up.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    half = real(0.5)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rod_apply(
        offset: wp.int32,
        carried: real,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        node_shift: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        segment_shift: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        i = 2 * fiber
        shift0 = node_shift[i]
        shift1 = node_shift[i + 1]
        segment_shift[fiber] = real(0.0)
        if wp.dot(shift0, shift0) + wp.dot(shift1, shift1) == real(0.0):
            return
        from0 = node_pos[i]
        from1 = node_pos[i + 1]
        x0 = from0 + shift0
        x1 = from1 + shift1
        center = half * (x0 + x1)
        lever = (half * groups[fiber_group[fiber]].rest) * wp.normalize(x1 - x0)
        node_pos[i] = center - lever
        node_pos[i + 1] = center + lever
        moved0 = wp.length(center - lever - from0)
        segment_shift[fiber] = wp.max(moved0, wp.length(center + lever - from1))
        share = carried / real(step_size[0])
        node_velocity[i] = node_velocity[i] + share * shift0
        node_velocity[i + 1] = node_velocity[i + 1] + share * shift1

    return rod_apply


class RodResponse:
    """The response of a cell of rods; `ContactDual` takes an instance.

    parts: into which a relaxation cuts the cell; by its size unless given.
    """

    by_ends = False

    def __init__(self, model: Model, parts: int | None = None) -> None:
        self.parts = parts
        self.relaxes = model.device.startswith("cpu")
        self.row_end = wp.zeros(0, dtype=wp.int32, device=model.device)
        self.end_move = wp.zeros(0, dtype=model.precision.real, device=model.device)
        self.end_diagonal = wp.zeros(0, dtype=model.precision.real, device=model.device)

    def begin(self, dual: ContactDual) -> list[Launch | Call]:
        """Nothing, but with friction."""
        return [rub_clear(dual)] if dual.rubs else []

    def end(self, dual: ContactDual) -> list[Launch | Call]:
        """Nothing: the last update leaves the shift."""
        return []

    def repeat(self, dual: ContactDual) -> Launch:
        """Forces gathered and shifts of both ends."""
        if dual.rubs:
            return rod_rub(dual)
        model, rows = dual.model, dual.rows
        inputs = [
            dual.step_size,
            model.groups,
            model.fiber_group,
            dual.fiber_frozen,
            dual.node_start,
            rows.row_out_start,
            dual.fiber_in,
            dual.row_next,
            rows.row_s,
            rows.row_t,
            rows.row_normal,
            rows.row_force,
            dual.control,
            dual.node_shift,
        ]
        kernel = make_rod_response(model.precision.name, dual.has_frozen, dual.module)
        return Launch("rod_response", kernel, model.fiber_count, inputs, split=True)

    def relax(self, dual: ContactDual) -> list[Launch | Call]:
        """Forces and shifts of the solution."""
        model = dual.model
        sizes = np.full(model.fiber_count, MOTION)
        ends = wp.zeros(model.fiber_count + 1, dtype=wp.int32, device=model.device)
        work = relaxation_work(dual, ends, sizes, self.parts)
        numbers = (ROD_NUMBERS + dual.rubs) * model.fiber_count
        rods = wp.zeros(numbers, dtype=model.precision.real, device=model.device)
        kernel = make_rod_relaxation(model.precision.name, dual.law.kind, dual.module, dual.rubs)
        swept = SWEEP_NUMBERS * work.row_queue.shape[0]  # where there is one part
        row_sweeps = wp.zeros(swept, dtype=model.precision.real, device=model.device)
        return [*relaxation_launches(kernel, work, [dual.step_size, rods, row_sweeps])]

    def apply(self, dual: ContactDual, carried: float = 0.0) -> Launch:
        """Moves the rods by the solution."""
        model, state = dual.model, dual.state
        inputs = [
            carried,
            dual.step_size,
            model.groups,
            model.fiber_group,
            dual.node_shift,
            state.status,
            state.node_pos,
            state.node_velocity,
            dual.segment_shift,
        ]
        name, rods = model.precision.name, model.fiber_count
        if model.device.startswith("cpu") and rods >= CHUNK:
            native = make_native_rod_apply(name, kernel_module("rod_lanes", name))
            return Launch("rod_apply", native, (rods + CHUNK - 1) // CHUNK, inputs, split=True)
        return Launch("rod_apply", make_rod_apply(name, dual.module), rods, inputs, split=True)
