"""Contact forces of a step, and the motion that they cause: the dual problem and its launches.

A solve: weights of the rows and their lists by fiber, then repeatedly the next forces, the response
of the fibers and the balance of the rows (`dual_rows`), until the largest fault is within the
tolerance or `most` updates were made. Every launch does nothing once that is so. On the CPU one
launch instead, which relaxes row after row (`native_relaxation`) and counts as many relaxations as
there are rows as an update.
Limits: the response is linear in the forces and symmetric; see `rod_response`, `chain_response`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import warp as wp

from warpfiber.model import Model, State
from warpfiber.passes.dual_rows import (
    CONTROL_SIZE,
    NEXT_UPDATES,
    SUMS,
    UNSOLVED,
    make_dual_balance,
    make_dual_step,
    make_fold_sums,
)
from warpfiber.passes.dual_setup import make_dual_begin, make_dual_lists
from warpfiber.passes.executor import Call, Launch, Repeat
from warpfiber.passes.host_arrays import host_view
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.row_slip import RowSlip

ROW_CHUNKS = 16  # runs of rows on the CPU: enough for the workers, few sums to add
CUDA_CHUNKS = 16384, 32  # on CUDA, where their sums are folded before they are added
MOST_UPDATES = 200


class Rows(Protocol):
    """The arrays of `contact_rows.ContactRows` that are used here."""

    row_count: Any
    row_i: Any
    row_j: Any
    row_s: Any
    row_t: Any
    row_normal: Any
    row_base: Any
    row_compliance: Any
    row_force: Any
    row_out_start: Any
    rub: RowSlip | None  # with friction
    pair_row: Any
    pair_row_count: Any


class Incoming(Protocol):
    """The index of a neighbor list by the second segment of a pair."""

    in_start: Any
    in_pair: Any


class Response(Protocol):
    """How fibers move by the forces of the rows: `rod_response`, `chain_response`."""

    by_ends: bool  # it makes `row_end` and the arrays of ends, see `dual_rows.make_dual_balance`
    row_end: Any
    end_move: Any
    end_diagonal: Any
    relaxes: bool  # on this device

    def begin(self, dual: ContactDual) -> list[Launch | Call]:
        """Launches after the lists of the fibers."""

    def repeat(self, dual: ContactDual) -> Launch:
        """The motion by the present forces, in every update."""

    def relax(self, dual: ContactDual) -> list[Launch | Call]:
        """Instead of all that: forces and shifts by `native_relaxation`, where `relaxes`."""

    def end(self, dual: ContactDual) -> list[Launch | Call]:
        """Launches that leave `node_shift` of the solution."""


@dataclass(frozen=True)
class ContactLaw:
    """`hard`, `linear` (stiffness) or `exponential` (strength and decay), in run units."""

    kind: str = "hard"
    stiffness: float = 0.0
    decay: float = 0.0


class ContactDual:
    """Solves for `rows.row_force` and leaves the response of the fibers in `node_shift`.

    `tells_push`: where it relaxes, also the forces on the nodes in `node_push`.
    Arrays as long as the rows are made by `launches`, so call it again when the rows grow.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        rows: Rows,
        pairs: Incoming,
        response: Response,
        *,
        step_size: Any,
        node_start: Any,
        tolerance: float,
        law: ContactLaw | None = None,
        most: int = MOST_UPDATES,
        fiber_frozen: Any = None,
        chunks: tuple[int, int] | None = None,
        relaxes: bool | None = None,
        tells_push: bool = False,
    ) -> None:
        self.model, self.state, self.rows, self.pairs = model, state, rows, pairs
        self.response = response
        self.step_size, self.node_start = step_size, node_start
        self.tolerance, self.most = tolerance, most
        self.law = law or ContactLaw()
        self.relaxes = response.relaxes if relaxes is None else relaxes
        self.rubs = rows.rub is not None
        self.by_ends = response.by_ends and not self.rubs
        device = model.device
        self.has_frozen = fiber_frozen is not None
        none = wp.zeros(0, dtype=wp.uint8, device=device)
        self.fiber_frozen = fiber_frozen if self.has_frozen else none
        self.module = kernel_module(
            "dual",
            model.precision.name,
            self.law.kind,
            self.has_frozen,
            self.by_ends,
            self.relaxes,
            *(("friction",) if rows.rub is not None else ()),
        )
        self.node_shift = wp.zeros(model.node_count, dtype=model.precision.vec3, device=device)
        pushed = model.node_count if tells_push and self.relaxes else 0
        self.node_push = wp.zeros(pushed, dtype=model.precision.vec3, device=device)
        # how far contact moved each segment off its motion without, at most
        real, segments = model.precision.real, model.segment_count
        self.segment_shift = wp.zeros(segments, dtype=real, device=model.device)
        self.fiber_in = wp.zeros(model.fiber_count, dtype=wp.int32, device=device)
        # runs of rows, and of their sums (0: these are not folded)
        on_cpu = device.startswith("cpu")
        self.chunks, self.folds = chunks or ((ROW_CHUNKS, 0) if on_cpu else CUDA_CHUNKS)
        self.sums = wp.zeros(SUMS * self.chunks, dtype=wp.float64, device=device)
        self.folded = self.sums
        if self.folds:
            self.folded = wp.zeros(SUMS * self.folds, dtype=wp.float64, device=device)
        self.best = wp.zeros(2, dtype=wp.float64, device=device)
        self.control = wp.zeros(CONTROL_SIZE, dtype=wp.int32, device=device)
        self.going = wp.zeros(1, dtype=wp.int32, device=device)

    def _allocate(self) -> None:
        real, device = self.model.precision.real, self.model.device
        capacity = self.rows.row_i.shape[0]

        def reals(size: int = capacity) -> Any:
            return wp.zeros(size, dtype=real, device=device)

        self.row_node = wp.zeros(capacity, dtype=wp.vec2i, device=device)
        self.row_next = wp.zeros(capacity, dtype=wp.int32, device=device)
        self.row_contact = reals(capacity if self.law.kind == "exponential" else 0)
        self.row_weight, self.row_best = reals(), reals()
        self.row_balance, self.row_change = reals(), reals()
        rubs, model, vec3 = capacity if self.rubs else 0, self.model, self.model.precision.vec3
        if self.rubs:  # a gather leaves the forces on the nodes
            self.node_push = wp.zeros(model.node_count, dtype=vec3, device=device)
        # by contact, about the axis
        self.fiber_turn = reals(model.fiber_count if self.rubs else 0)
        self.row_mu, self.row_slip_weight = reals(rubs), reals(rubs)
        self.row_slip_now, self.row_friction_best, self.row_friction_change = (
            wp.zeros(rubs, dtype=vec3, device=device) for _ in range(3)
        )
        none = wp.zeros(0, dtype=vec3, device=device)
        rub = self.rows.rub
        self.row_slip, self.row_friction = (none, none) if rub is None else (rub.slip, rub.force)

    def launches(self) -> list[Launch | Call | Repeat]:
        """Begin, lists and the repeated updates of one solve."""
        if self.relaxes:
            return [*self.response.relax(self)]
        self._allocate()
        before = [self._begin(), self._lists(), *self.response.begin(self)]
        update: list[Launch | Call] = [self._step(), self.response.repeat(self), self._balance()]
        if self.folds:
            inputs = [self.chunks, self.folds, self.sums, self.control, self.folded]
            update.append(Launch("fold_sums", make_fold_sums(self.module), self.folds, inputs))
        repeat = Repeat("dual", update, self.going, self.most + 3)
        return [*before, repeat, *self.response.end(self)]

    def _begin(self) -> Launch:
        model, rows = self.model, self.rows
        inputs = [
            self.chunks,
            self.law.stiffness,
            self.law.decay,
            self.step_size,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            model.segment_node,
            model.segment_fiber,
            self.fiber_frozen,
            self.node_start,
            rows.row_count,
            rows.row_i,
            rows.row_j,
            rows.row_s,
            rows.row_t,
            rows.row_normal,
            rows.row_compliance,
            self.state.status,
            rows.row_force,
            self.row_node,
            self.row_contact,
            self.row_weight,
            self.row_best,
            self.row_balance,
            self.row_change,
            self.best,
            self.control,
            self.going,
            rows.rub.friction.fibers if rows.rub is not None else 0.0,
            rows.rub.friction.walls if rows.rub is not None else 0.0,
            self.row_friction,
            self.row_mu,
            self.row_slip_weight,
            self.row_slip_now,
            self.row_friction_best,
            self.row_friction_change,
        ]
        name = model.precision.name
        kernel = make_dual_begin(name, self.law.kind, self.has_frozen, self.module, self.rubs)
        return Launch("dual_begin", kernel, self.chunks, inputs, split=True)

    def _lists(self) -> Launch:
        model, rows = self.model, self.rows
        inputs = [
            model.fiber_node_start,
            rows.row_count,
            self.row_next,
            self.pairs.in_start,
            self.pairs.in_pair,
            rows.pair_row,
            rows.pair_row_count,
            self.state.status,
            self.fiber_in,
            self.node_shift,
        ]
        kernel = make_dual_lists(model.precision.name, self.module)
        # nothing of what the first launch made is read here
        return Launch("dual_lists", kernel, model.fiber_count, inputs, split=True, follows=True)

    def _step(self) -> Launch:
        rows = self.rows
        inputs = [
            self.chunks,
            self.most,
            wp.float64(self.tolerance),
            rows.row_count,
            rows.row_compliance,
            self.row_weight,
            self.row_balance,
            self.folded,
            rows.row_force,
            self.row_best,
            self.row_change,
            self.best,
            self.control,
            rows.row_normal,
            self.row_friction,
            self.row_mu,
            self.row_slip_weight,
            self.row_slip_now,
            self.row_friction_best,
            self.row_friction_change,
        ]
        kernel = make_dual_step(self.model.precision.name, self.module, self.rubs)
        return Launch("dual_step", kernel, self.chunks, inputs, split=True)

    def _balance(self) -> Launch:
        model, rows = self.model, self.rows
        inputs = [
            self.chunks,
            self.law.stiffness,
            self.law.decay,
            rows.row_count,
            self.row_node,
            rows.row_s,
            rows.row_t,
            rows.row_normal,
            rows.row_base,
            rows.row_compliance,
            self.row_contact,
            self.row_weight,
            rows.row_force,
            self.row_change,
            self.node_shift,
            self.response.row_end,
            self.response.end_move,
            self.response.end_diagonal,
            self.row_balance,
            self.sums,
            self.best,
            self.control,
            self.going,
            model.groups,
            model.fiber_group,
            model.segment_fiber,
            self.node_start,
            self.fiber_turn,
            rows.row_i,
            rows.row_j,
            self.row_slip,
            self.row_friction,
            self.row_mu,
            self.row_slip_weight,
            self.row_slip_now,
            self.row_friction_change,
        ]
        name = model.precision.name
        kernel = make_dual_balance(name, self.law.kind, self.by_ends, self.module, self.rubs)
        return Launch("dual_balance", kernel, self.chunks, inputs, split=True)

    # -- what is told -----------------------------------------------------------------------------

    @property
    def updates(self) -> int:
        """Updates of the last solve."""
        return int(self.control.numpy()[NEXT_UPDATES])

    @property
    def unsolved(self) -> int:
        """Solves so far that stopped at their limit."""
        return int(host_view(self.control)[UNSOLVED])

    @property
    def fault(self) -> float:
        """Largest fault of the last solve, a length."""
        return float(self.best.numpy()[1])
