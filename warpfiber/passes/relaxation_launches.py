"""The launches of a relaxation, and what it works with: shared by rods and flexible fibers.

Source: `native_relaxation`.
Limits: CPU only. Cells of fewer than PARTED segments are one part: their parts would wait for each
    other longer than they work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpfiber.passes.executor import Launch
from warpfiber.passes.native_friction import RUB_NUMBERS
from warpfiber.passes.native_relaxation import BEGIN, END, PARTS, REST, ROWS
from warpfiber.passes.native_row_coupling import HOT_NUMBERS, TOUCH_NUMBERS, TOUCHES
from warpfiber.passes.native_row_order import ROW_NUMBERS, STATE_NUMBERS, STILL
from warpfiber.passes.relaxation_work import relaxation_struct

if TYPE_CHECKING:
    from warpfiber.passes.unilateral import ContactDual

PARTED = 20_000
MOST_PARTS = 2


def relaxation_work(
    dual: ContactDual, end_start: Any, motion_sizes: np.ndarray, parts: int | None = None
) -> Any:
    """The struct of a solve; `motion_sizes` (F,) numbers of the motion of every fiber."""
    model, rows, p = dual.model, dual.rows, dual.model.precision
    fibers, capacity, device = model.fiber_count, rows.row_i.shape[0], model.device
    if parts is None:
        parts = MOST_PARTS if model.segment_count >= PARTED else 1

    def zeros(size: int, dtype: Any = wp.int32) -> Any:
        return wp.zeros(size, dtype=dtype, device=device)

    work = relaxation_struct(p.name)()
    work.fibers, work.parts, work.most = fibers, parts, dual.most
    work.tolerance = dual.tolerance
    work.stiffness, work.decay = dual.law.stiffness, dual.law.decay
    work.wraps = wp.vec3i(*(int(wraps) for wraps in model.domain.periodic))
    for name in "groups fiber_node_start fiber_group segment_node segment_fiber".split():
        setattr(work, name, getattr(model, name))
    work.fiber_frozen, work.node_start = dual.fiber_frozen, dual.node_start
    work.status = dual.state.status
    names = "count out_start i j s t normal base compliance force".split()
    for name in names:
        setattr(work, f"row_{name}", getattr(rows, f"row_{name}"))
    if rows.rub is not None:
        work.friction = rows.rub.friction.fibers
        work.wall_friction = rows.rub.friction.walls
        work.row_slip, work.row_friction = rows.rub.slip, rows.rub.force
        work.row_rub = zeros(RUB_NUMBERS * capacity, p.real)
    work.row_place = zeros(ROW_NUMBERS * capacity, p.real)
    work.row_state = zeros(STATE_NUMBERS * capacity, p.real)
    work.in_start, work.in_row = zeros(fibers + 2), zeros(capacity)
    work.end_start = end_start
    work.motion = zeros(int(motion_sizes.sum()) + STILL, p.real)
    work.fiber_at, work.fiber_row, work.fiber_part = (zeros(fibers) for _ in range(3))
    work.fiber_order, work.part_start = zeros(fibers), zeros(parts + 2)
    work.part_relaxed = zeros(parts, wp.int64)
    work.fiber_queued, work.queue = zeros(fibers, wp.uint8), zeros(fibers)
    alone = capacity if parts == 1 and rows.rub is None else 0
    work.row_hot = zeros(HOT_NUMBERS * alone, p.real)
    work.touches = wp.empty(TOUCHES * TOUCH_NUMBERS * alone, dtype=p.real, device=device)
    work.touch_at, work.row_queue = zeros(2 * alone), zeros(alone)
    work.row_queued = zeros(alone, wp.uint8)
    work.node_shift, work.node_push = dual.node_shift, dual.node_push
    work.best, work.control = dual.best, dual.control
    return work


def relaxation_launches(kernel: Any, work: Any, inputs: list[Any]) -> list[Launch]:
    """All stages; `inputs` behind the stage and the struct."""
    parts = work.parts

    def by_parts(name: str, stage: int) -> Launch:
        return Launch(name, kernel, parts, [stage, work, *inputs], split=True)

    return [
        Launch("relax_begin", kernel, 1, [0, BEGIN, work, *inputs]),
        by_parts("relax_rows", ROWS),
        by_parts("relax_parts", PARTS),
        Launch("relax_rest", kernel, 1, [0, REST, work, *inputs]),
        by_parts("relax_end", END),
    ]
