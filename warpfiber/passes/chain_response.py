"""Contact forces on flexible fibers: their motion during the solve, and what the solution does.

Source: `chain_reply`, the response of one fiber; during the solve by its blocks (`chain_blocks`).
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import HALT, Model, precision
from warpfiber.passes.chain_blocks import make_chain_moves, make_end_kernels
from warpfiber.passes.chain_relaxation import (
    REPLY_NUMBERS,
    make_chain_relaxation,
    waiting_numbers,
)
from warpfiber.passes.chain_reply import make_chain_reply, make_gather_push
from warpfiber.passes.chain_solve import CHI
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.executor import Call, Launch
from warpfiber.passes.native import LANES
from warpfiber.passes.native_blocks import FACTORS, MOST_NODES
from warpfiber.passes.precision import group_struct
from warpfiber.passes.relaxation_launches import relaxation_launches, relaxation_work
from warpfiber.passes.rub_response import make_chain_rub, rub_clear, rub_rows
from warpfiber.passes.unilateral import ContactDual

BLOCK_SHARE = 32
MOST_NUMBERS = 2**31 - 1  # places in `block` are of 32 bits


@cache
def make_chain_response(name: str, has_frozen: bool, module: str = "unique") -> Any:
    """Kernel `chain_response`, one thread per fiber: shift and tensions by the forces found."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    Row = elimination_row(name)
    chain_reply = make_chain_reply(name)
    gather_push = make_gather_push(name)
    zero = real(0.0)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def chain_response(
        offset: wp.int32,
        row_stride: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        rows: wp.array(dtype=Row),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        end_start: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        node_push: wp.array(dtype=vec3),
        node_reply: wp.array(dtype=vec3),
        reply_impulse: wp.array(dtype=real),
        segment_impulse: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
    ):
        fiber = wp.tid() + offset
        if status[wp.static(HALT)] != 0 or end_start[fiber] == end_start[fiber + 1]:
            return
        first = fiber_node_start[fiber]
        segments = fiber_node_start[fiber + 1] - first - 1
        pushed = gather_push(
            fiber,
            first,
            segments,
            row_out_start,
            fiber_in,
            row_next,
            row_j,
            row_s,
            row_t,
            row_normal,
            row_force,
            node_push,
        )
        if wp.static(has_frozen):
            pushed = pushed and fiber_frozen[fiber] == wp.uint8(0)
        if not pushed:
            for i in range(first, first + segments + 1):
                node_shift[i] = vec3()
            for segment in range(first - fiber, first - fiber + segments):
                segment_impulse[segment] = zero
            return
        chain_reply(
            fiber,
            first,
            segments,
            row_stride * fiber,
            fiber_pace[fiber] * real(step_size[0]),
            groups[fiber_group[fiber]],
            rows,
            node_push,
            node_reply,
            reply_impulse,
            segment_impulse,
            node_shift,
        )

    return chain_response


@cache
def make_chain_apply(name: str, module: str = "unique") -> Any:
    """Kernel `chain_apply`, one thread per fiber: moved by its shift, tensions added.

    `carried`: share of the shift's velocity that `node_velocity` takes up.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    chi = real(CHI)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def chain_apply(
        offset: wp.int32,
        carried: real,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        end_start: wp.array(dtype=wp.int32),
        node_shift: wp.array(dtype=vec3),
        segment_impulse: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
        segment_shift: wp.array(dtype=real),
    ):
        fiber = wp.tid() + offset
        if status[wp.static(HALT)] != 0:
            return
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        if end_start[fiber] == end_start[fiber + 1]:
            for i in range(first, last):
                segment_shift[i - fiber] = real(0.0)
            return
        dt = real(step_size[0])
        h_force = chi * dt * fiber_pace[fiber]
        behind = real(0.0)
        for i in range(first, last + 1):
            moved = wp.length(node_shift[i])
            if i > first:
                segment_shift[i - fiber - 1] = wp.max(behind, moved)
            behind = moved
            node_pos[i] = node_pos[i] + node_shift[i]
            node_velocity[i] = node_velocity[i] + (carried / dt) * node_shift[i]
            if i < last:
                tension[i - fiber] = tension[i - fiber] + segment_impulse[i - fiber] / h_force

    return chain_apply


class ChainResponse:
    """The response of a cell of flexible fibers; `ContactDual` takes an instance.

    rows, row_stride: factors of every fiber, as `chain_solve` left them (row_stride > 0).
    block_share: numbers per end in `block`, the ends that a fiber may have on average.
    fiber_pace: see `chain_pace`; 1 unless given.
    axes: instead of factors, see `native_factor`; only where it relaxes.
    parts: into which a relaxation cuts the cell; by its size unless given.
    """

    by_ends = True

    def __init__(
        self,
        model: Model,
        rows: Any,
        row_stride: int,
        tension: Any,
        block_share: int | None = None,
        fiber_pace: Any = None,
        parts: int | None = None,
        axes: Any = None,
    ) -> None:
        most = max(row["segments"] for row in model.group_rows)
        self.relaxes = model.device.startswith("cpu") and most < MOST_NODES
        self.block_share, self.parts = block_share, parts
        self.model, self.rows, self.row_stride, self.tension = model, rows, row_stride, tension
        p, nodes = model.precision, model.node_count
        ones = wp.full(model.fiber_count, p.real(1.0), p.real, device=model.device)
        self.fiber_pace = ones if fiber_pace is None else fiber_pace
        self.node_push = self._array(nodes, p.vec3)
        self.node_reply = self._array(nodes, p.vec3)
        self.reply_impulse = self._array(nodes, p.real)
        self.segment_impulse = self._array(model.segment_count, p.real)
        self.end_start = self._array(model.fiber_count + 1, wp.int32)
        self.block_start = self._array(model.fiber_count, wp.int32)
        self.axes = self._array(0, p.real) if axes is None else axes
        self._allocate(0, 0)
        self.column_at = self._array(0, wp.int32)

    def _array(self, size: int, dtype: Any) -> Any:
        return wp.zeros(size, dtype=dtype, device=self.model.device)

    def _allocate(self, ends: int, block_share: int | None) -> None:
        real = self.model.precision.real
        self.row_end, self.end_row = self._array(ends, wp.int32), self._array(ends, wp.int32)
        self.end_known = self._array(ends, wp.uint8)
        self.end_force, self.end_move = self._array(ends, real), self._array(ends, real)
        self.end_diagonal = self._array(ends, real)
        self.block = self._array((BLOCK_SHARE if block_share is None else block_share) * ends, real)

    def begin(self, dual: ContactDual) -> list[Launch | Call]:
        """Ends and blocks of every fiber, for rows of the present capacity."""
        model, rows, status = self.model, dual.rows, dual.state.status
        self._allocate(2 * rows.row_i.shape[0], 0 if dual.rubs else self.block_share)
        fibers = model.fiber_count
        name = model.precision.name
        kernels = make_end_kernels(name)
        lists = [rows.row_out_start, dual.fiber_in, dual.row_next]
        counted = [model.fiber_node_start, rows.row_count, *lists, self.end_start]
        scanned = [fibers, self.block.shape[0], status, self.end_start, self.block_start]
        filled = [
            model.fiber_node_start,
            *lists,
            rows.row_j,
            self.end_start,
            status,
            self.row_end,
            self.end_row,
            self.end_known,
            self.end_force,
            self.end_move,
            self.end_diagonal,
        ]
        return [
            Launch("end_count", kernels["end_count"], fibers, counted, split=True, follows=True),
            Launch("end_scan", kernels["end_scan"], 1, scanned),
            Launch("end_fill", kernels["end_fill"], fibers, filled, split=True),
            *([rub_clear(dual)] if dual.rubs else []),
        ]

    def _fibers(self, dual: ContactDual) -> list[Any]:
        model = self.model
        return [
            self.row_stride,
            dual.step_size,
            self.fiber_pace,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            dual.fiber_frozen,
            self.rows,
            dual.rows.row_out_start,
            dual.fiber_in,
            dual.row_next,
            dual.rows.row_j,
        ]

    def _rows(self, dual: ContactDual) -> list[Any]:
        rows = dual.rows
        return [rows.row_s, rows.row_t, rows.row_normal, rows.row_force, self.end_start]

    def _work(self, dual: ContactDual) -> list[Any]:
        made = [self.reply_impulse, self.segment_impulse, dual.node_shift]
        return [self.node_push, self.node_reply, *made]

    def repeat(self, dual: ContactDual) -> Launch:
        """Motion of the ends of all rows."""
        if dual.rubs:
            return self._rub(dual)
        model = self.model
        inputs = [
            *self._fibers(dual),
            dual.row_node,
            *self._rows(dual),
            self.block_start,
            self.end_row,
            dual.control,
            *self._work(dual),
            self.block,
            self.end_known,
            self.end_force,
            self.end_move,
            self.end_diagonal,
        ]
        kernel = make_chain_moves(model.precision.name, dual.has_frozen)
        return Launch("chain_moves", kernel, model.fiber_count, inputs, split=True)

    def _rub(self, dual: ContactDual) -> Launch:
        model = self.model
        inputs = [
            self.row_stride,
            dual.step_size,
            self.fiber_pace,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            dual.fiber_frozen,
            self.rows,
            dual.node_start,
            *rub_rows(dual),
            self.end_start,
            dual.control,
            dual.node_push,
            self.node_reply,
            self.reply_impulse,
            self.segment_impulse,
            dual.node_shift,
            dual.fiber_turn,
        ]
        kernel = make_chain_rub(model.precision.name, dual.has_frozen, dual.module)
        return Launch("chain_rub", kernel, model.fiber_count, inputs, split=True)

    def end(self, dual: ContactDual) -> list[Launch | Call]:
        """Shift and tensions of the solution; with friction the last update leaves them."""
        if dual.rubs:
            return []
        model = self.model
        inputs = [*self._fibers(dual), *self._rows(dual), dual.state.status, *self._work(dual)]
        kernel = make_chain_response(model.precision.name, dual.has_frozen, dual.module)
        return [Launch("chain_response", kernel, model.fiber_count, inputs, split=True)]

    def relax(self, dual: ContactDual) -> list[Launch | Call]:
        """Forces, shift and tensions of the solution."""
        model, p = self.model, self.model.precision
        ends, lanes = 2 * dual.rows.row_i.shape[0], LANES[p.name]
        nodes = np.diff(model.host["fiber_node_start"])
        sizes = -(-4 * nodes // lanes) * lanes
        work = relaxation_work(dual, self.end_start, sizes, self.parts)
        most, parts, groups = int(sizes.max()), work.parts, len(model.group_rows)
        # as much as there may be: what the rows of a step do not need stays out of memory
        share = most * parts if self.block_share is None else self.block_share
        columns = 3 * ends if dual.rubs else ends
        size = min(columns * share, MOST_NUMBERS)
        self.block = wp.empty(size, dtype=p.real, device=model.device)
        self.column_at = self._array(columns, wp.int32)
        inputs = [
            self.row_stride,
            dual.step_size,
            self.fiber_pace,
            self.rows,
            self.axes,
            self._array(REPLY_NUMBERS * groups, p.real),
            self.column_at,
            self.block,
            self._array(parts, wp.int64),
            self._array(most * parts, p.real),
            self._array(parts * lanes * (FACTORS * int(nodes.max()) + 1), p.real),
            self._array(parts * groups * lanes * waiting_numbers(p.name), wp.int32),
            self.segment_impulse,
        ]
        found = self.axes.shape[0] > 0
        kernel = make_chain_relaxation(p.name, dual.law.kind, friction=dual.rubs, found=found)
        return [*relaxation_launches(kernel, work, inputs)]

    def apply(self, dual: ContactDual, carried: float = 0.0) -> Launch:
        """Moves the fibers by the solution and adds its tensions."""
        model, state = self.model, dual.state
        inputs = [
            carried,
            dual.step_size,
            self.fiber_pace,
            model.fiber_node_start,
            self.end_start,
            dual.node_shift,
            self.segment_impulse,
            state.status,
            state.node_pos,
            state.node_velocity,
            self.tension,
            dual.segment_shift,
        ]
        kernel = make_chain_apply(model.precision.name, dual.module)
        return Launch("chain_apply", kernel, model.fiber_count, inputs, split=True)
