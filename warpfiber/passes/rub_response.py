"""Motion of rods and of flexible fibers by all forces of their rows, those of friction too.

Source: law `surface_slip`: what a tangential force on the surface does to the two nodes of its
    segment, and its torque about the axis, which turns the fiber by dt tau/(8 pi eta a^3 w); the
    forces on the nodes move it as in `rod_response` and `chain_reply`.
Symbols: w beads that carry torque.
Limits: every fiber is solved in every update; `native_friction` is the same for the CPU.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.laws.rod_mobility import make_rod_mobility
from warpfiber.laws.surface_slip import make_surface_slip
from warpfiber.model import HALT, precision
from warpfiber.passes.chain_reply import make_chain_reply
from warpfiber.passes.dual_rows import DONE, NEXT_PHASE
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.executor import Launch
from warpfiber.passes.precision import group_struct
from warpfiber.passes.unilateral import ContactDual


@cache
def make_gather_rub(name: str) -> Any:
    """`gather_rub`: forces of its rows on the nodes of one fiber; the torque about its axis."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    _, surface_roll, surface_couple = make_surface_slip(name)
    zero, one = real(0.0), real(1.0)

    @wp.func
    def gather_rub(
        fiber: wp.int32,
        first: wp.int32,
        segments: wp.int32,
        radius: real,
        node_start: wp.array(dtype=vec3),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        row_friction: wp.array(dtype=vec3),
        node_push: wp.array(dtype=vec3),
    ) -> real:
        r = fiber_in[fiber]
        behind = vec3()
        torque = zero
        for k in range(segments):
            segment = first - fiber + k
            edge = node_start[first + k + 1] - node_start[first + k]
            length = wp.length(edge)
            axis = edge / length
            here = behind
            behind = vec3()
            for own in range(row_out_start[segment], row_out_start[segment + 1]):
                n = row_normal[own]
                flat = row_friction[own]
                push = row_force[own] * n + flat
                couple = surface_couple(n, axis, radius / length, flat)
                here -= (one - row_s[own]) * push + couple
                behind += couple - row_s[own] * push
                torque += wp.dot(flat, surface_roll(n, axis, radius))
            while r >= 0 and row_j[wp.max(r, 0)] == segment:
                n = row_normal[r]
                flat = row_friction[r]
                push = row_force[r] * n + flat
                couple = surface_couple(n, axis, radius / length, flat)
                here += (one - row_t[r]) * push - couple
                behind += row_t[r] * push + couple
                torque += wp.dot(flat, surface_roll(n, axis, radius))
                r = row_next[r]
            node_push[first + k] = here
        node_push[first + segments] = behind
        return torque

    return gather_rub


@cache
def make_rub_clear(name: str, module: str = "unique") -> Any:
    """Kernel `rub_clear`, one thread per fiber: no forces on nodes yet, no turn about the axis."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rub_clear(
        offset: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        fiber_turn: wp.array(dtype=real),
        node_push: wp.array(dtype=vec3),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        fiber_turn[fiber] = real(0.0)
        for i in range(fiber_node_start[fiber], fiber_node_start[fiber + 1]):
            node_push[i] = vec3()

    return rub_clear


@cache
def make_rod_rub(name: str, has_frozen: bool, module: str = "unique") -> Any:
    """Kernel `rod_rub`, one thread per rod: shift of its ends, turn about its axis."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    turning_drag, _ = make_rod_mobility(name)
    gather_rub = make_gather_rub(name)
    one, two, half = real(1.0), real(2.0), real(0.5)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rod_rub(
        offset: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_start: wp.array(dtype=vec3),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        row_friction: wp.array(dtype=vec3),
        control: wp.array(dtype=wp.int32),
        node_push: wp.array(dtype=vec3),
        node_shift: wp.array(dtype=vec3),
        fiber_turn: wp.array(dtype=real),
    ):
        if control[wp.static(NEXT_PHASE)] == wp.static(DONE):
            return
        fiber = wp.tid() + offset
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                return
        if row_out_start[fiber] == row_out_start[fiber + 1] and fiber_in[fiber] < 0:
            return
        g = groups[fiber_group[fiber]]
        i = 2 * fiber
        torque = gather_rub(
            fiber,
            i,
            1,
            g.radius,
            node_start,
            row_out_start,
            fiber_in,
            row_next,
            row_j,
            row_s,
            row_t,
            row_normal,
            row_force,
            row_friction,
            node_push,
        )
        axis = wp.normalize(node_start[i + 1] - node_start[i])
        beads = g.spacing + one
        reach = half * g.rest
        dt = real(step_size[0])
        weight = g.weight + two * g.weight_excess
        move = (dt / (g.drag * beads)) * (node_push[i] + node_push[i + 1])
        across = node_push[i + 1] - node_push[i]
        turning = turning_drag(g.torque, beads, weight)
        turn = (dt * reach * reach / turning) * (across - wp.dot(axis, across) * axis)
        node_shift[i] = move - turn
        node_shift[i + 1] = move + turn
        fiber_turn[fiber] = dt * torque / (g.torque * weight)

    return rod_rub


@cache
def make_chain_rub(name: str, has_frozen: bool, module: str = "unique") -> Any:
    """Kernel `chain_rub`, one thread per fiber: shift, tensions, turn about its axis."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    Row = elimination_row(name)
    chain_reply = make_chain_reply(name)
    gather_rub = make_gather_rub(name)
    zero, two = real(0.0), real(2.0)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def chain_rub(
        offset: wp.int32,
        row_stride: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        rows: wp.array(dtype=Row),
        node_start: wp.array(dtype=vec3),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        row_friction: wp.array(dtype=vec3),
        end_start: wp.array(dtype=wp.int32),
        control: wp.array(dtype=wp.int32),
        node_push: wp.array(dtype=vec3),
        node_reply: wp.array(dtype=vec3),
        reply_impulse: wp.array(dtype=real),
        segment_impulse: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        fiber_turn: wp.array(dtype=real),
    ):
        if control[wp.static(NEXT_PHASE)] == wp.static(DONE):
            return
        fiber = wp.tid() + offset
        if end_start[fiber] == end_start[fiber + 1]:
            return
        first = fiber_node_start[fiber]
        segments = fiber_node_start[fiber + 1] - first - 1
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                for segment in range(first - fiber, first - fiber + segments):
                    segment_impulse[segment] = zero
                return
        g = groups[fiber_group[fiber]]
        torque = gather_rub(
            fiber,
            first,
            segments,
            g.radius,
            node_start,
            row_out_start,
            fiber_in,
            row_next,
            row_j,
            row_s,
            row_t,
            row_normal,
            row_force,
            row_friction,
            node_push,
        )
        dt = fiber_pace[fiber] * real(step_size[0])
        weight = real(segments) * g.weight + two * g.weight_excess
        fiber_turn[fiber] = dt * torque / (g.torque * weight)
        chain_reply(
            fiber,
            first,
            segments,
            row_stride * fiber,
            dt,
            g,
            rows,
            node_push,
            node_reply,
            reply_impulse,
            segment_impulse,
            node_shift,
        )

    return chain_rub


def rub_rows(dual: ContactDual) -> list[Any]:
    """Arguments of a gather."""
    rows = dual.rows
    assert rows.rub is not None
    lists = [rows.row_out_start, dual.fiber_in, dual.row_next, rows.row_j]
    return [*lists, rows.row_s, rows.row_t, rows.row_normal, rows.row_force, rows.rub.force]


def rub_clear(dual: ContactDual) -> Launch:
    """Before a solve."""
    model = dual.model
    inputs = [model.fiber_node_start, dual.state.status, dual.fiber_turn, dual.node_push]
    kernel = make_rub_clear(model.precision.name, dual.module)
    return Launch("rub_clear", kernel, model.fiber_count, inputs, split=True, follows=True)


def rod_rub(dual: ContactDual) -> Launch:
    """Shifts of all rods in an update."""
    model = dual.model
    inputs = [
        dual.step_size,
        model.groups,
        model.fiber_group,
        dual.fiber_frozen,
        dual.node_start,
        *rub_rows(dual),
        dual.control,
        dual.node_push,
        dual.node_shift,
        dual.fiber_turn,
    ]
    kernel = make_rod_rub(model.precision.name, dual.has_frozen, dual.module)
    return Launch("rod_rub", kernel, model.fiber_count, inputs, split=True)
