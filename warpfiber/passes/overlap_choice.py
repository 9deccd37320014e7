"""Which pairs a second solve of a step looks at: those of fibers that the first left overlapping.

Rows are linear in the motion. Where fibers slide along each other by several radii while they turn,
or were stopped by one that no row had foreseen, they end deeper in each other than the tolerance of
the forces. Rows of the result, of these fibers alone, push them apart once more.
Source: a fiber is marked if it overlaps another, or a wall, by more than a given share of the
    radius; chosen are the pairs of which one fiber at least is marked.
Limits: nothing is chosen where the step is repeated anyway: center lines that passed through each
    other, torn fibers, rows that did not fit.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import warp as wp

from warpfiber.model import HALT, Model, State, precision
from warpfiber.passes.executor import Launch
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.native_row_slots import LOOK

if TYPE_CHECKING:
    from warpfiber.passes.contact_check import ContactCheck
    from warpfiber.passes.contact_rows import ContactRows

LOST = 1e20  # radii; more is no overlap but a fiber that is nowhere


@cache
def make_overlap_choice(name: str, module: str = "unique"):
    """`clear_marks`, `mark_fibers`, `choose_pairs` in launch order, as a dict by name."""
    real = precision(name).real
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.func
    def is_idle(
        limit: wp.float64,
        largest: wp.array(dtype=wp.float64),
        found: wp.array(dtype=wp.int32),
        row_need: wp.array(dtype=wp.int32),
    ) -> wp.bool:
        repeated = found[0] > 0 or row_need[0] > 0
        return repeated or not (largest[0] > limit and largest[0] < wp.float64(LOST))

    @wp.kernel(**options)
    def clear_marks(
        offset: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        fiber_marked_out: wp.array(dtype=wp.uint8),
        segment_rows_out: wp.array(dtype=wp.int32),
        pair_row_count_out: wp.array(dtype=wp.int32),
    ):
        """One thread per fiber: no marks, no rows. Pairs of a fiber lie behind each other."""
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        fiber_marked_out[fiber] = wp.uint8(0)
        first = fiber_node_start[fiber] - fiber
        last = fiber_node_start[fiber + 1] - fiber - 1
        for i in range(first, last):
            segment_rows_out[i] = 0
        for k in range(out_start[first], out_start[last]):
            pair_row_count_out[k] = 0

    @wp.kernel(**options)
    def mark_fibers(
        offset: wp.int32,
        limit: wp.float64,
        largest: wp.array(dtype=wp.float64),
        found: wp.array(dtype=wp.int32),
        row_need: wp.array(dtype=wp.int32),
        overlap: wp.array(dtype=real),
        overlap_partner: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        fiber_marked_out: wp.array(dtype=wp.uint8),
    ):
        """One thread per segment; all that mark a fiber write the same."""
        if status[wp.static(HALT)] != 0 or is_idle(limit, largest, found, row_need):
            return
        i = wp.tid() + offset
        if overlap[i] > real(limit):
            fiber_marked_out[segment_fiber[i]] = wp.uint8(1)
            if overlap_partner[i] >= 0:
                fiber_marked_out[segment_fiber[overlap_partner[i]]] = wp.uint8(1)

    @wp.kernel(**options)
    def choose_pairs(
        offset: wp.int32,
        limit: wp.float64,
        largest: wp.array(dtype=wp.float64),
        found: wp.array(dtype=wp.int32),
        row_need: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        fiber_marked: wp.array(dtype=wp.uint8),
        status: wp.array(dtype=wp.int32),
        segment_chosen_out: wp.array(dtype=wp.uint8),
        pair_slots_out: wp.array(dtype=wp.uint8),
    ):
        """One thread per segment: its pairs, and whether there are any."""
        if status[wp.static(HALT)] != 0:
            return
        i = wp.tid() + offset
        mine = fiber_marked[segment_fiber[i]]
        chosen = mine
        if not is_idle(limit, largest, found, row_need):
            for k in range(out_start[i], out_start[i + 1]):
                looked_at = mine | fiber_marked[segment_fiber[pair_j[k]]]
                chosen = chosen | looked_at
                pair_slots_out[k] = wp.uint8(wp.static(LOOK)) * looked_at
        segment_chosen_out[i] = chosen

    kernels = [clear_marks, mark_fibers, choose_pairs]
    return dict(zip(["clear_marks", "mark_fibers", "choose_pairs"], kernels, strict=True))


class OverlapChoice:
    """`segment_chosen` (S) uint8: segments with pairs or walls that a second solve looks at."""

    def __init__(self, model: Model, state: State, limit: float) -> None:
        """`limit` in radii."""
        self.model, self.state, self.limit = model, state, limit
        name = model.precision.name
        self.kernels = make_overlap_choice(name, kernel_module("choice", name))
        self.fiber_marked = wp.zeros(model.fiber_count, dtype=wp.uint8, device=model.device)
        self.segment_chosen = wp.zeros(model.segment_count, dtype=wp.uint8, device=model.device)

    def launches(self, check: ContactCheck, first: ContactRows, rows: ContactRows) -> list[Launch]:
        """After a check of the first solve; `rows` are those of the second."""
        model, state = self.model, self.state
        found = [wp.float64(self.limit), check.largest, check.found, first.row_need]
        marks = [check.overlap, check.overlap_partner, model.segment_fiber]
        pairs = [model.segment_fiber, rows.pairs.out_start, rows.pairs.pair_j]
        chosen = [self.segment_chosen, rows.pair_slots]
        cleared = [model.fiber_node_start, rows.pairs.out_start, state.status]
        cleared += [self.fiber_marked, rows.segment_rows, rows.pair_row_count]
        fibers, segments = model.fiber_count, model.segment_count
        return [
            self._launch("clear_marks", fibers, cleared),
            self._launch(
                "mark_fibers", segments, [*found, *marks, state.status, self.fiber_marked]
            ),
            self._launch(
                "choose_pairs", segments, [*found, *pairs, self.fiber_marked, state.status, *chosen]
            ),
        ]

    def _launch(self, name: str, dim: int, inputs: list[Any]) -> Launch:
        return Launch(name, self.kernels[name], dim, inputs, split=True)
