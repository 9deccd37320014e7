"""What a relaxation of contact rows reads, works with and leaves, as one struct per precision.

Source: `native_relaxation`.

No `from __future__ import annotations` here: Warp reads the annotations of a struct as objects.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.dual_rows import DONE, NEXT_PHASE, NEXT_UPDATES, PHASE, UPDATES
from warpfiber.passes.precision import group_struct


@cache
def relaxation_struct(name: str) -> Any:
    """Warp struct of what every relaxation reads, works with and leaves (`relaxation_launches`)."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)

    @wp.struct
    class Relaxation:
        fibers: wp.int32
        parts: wp.int32
        most: wp.int32  # relaxations, in rows
        tolerance: wp.float64
        stiffness: real  # of the law
        decay: real
        wraps: wp.vec3i  # 1 of axes that are periodic
        groups: wp.array(dtype=Group)
        fiber_node_start: wp.array(dtype=wp.int32)
        fiber_group: wp.array(dtype=wp.int32)
        fiber_frozen: wp.array(dtype=wp.uint8)
        segment_node: wp.array(dtype=wp.int32)
        segment_fiber: wp.array(dtype=wp.int32)
        node_start: wp.array(dtype=vec3)
        status: wp.array(dtype=wp.int32)
        row_count: wp.array(dtype=wp.int32)
        row_out_start: wp.array(dtype=wp.int32)
        row_i: wp.array(dtype=wp.int32)
        row_j: wp.array(dtype=wp.int32)
        row_s: wp.array(dtype=real)
        row_t: wp.array(dtype=real)
        row_normal: wp.array(dtype=vec3)
        row_base: wp.array(dtype=real)
        row_compliance: wp.array(dtype=real)
        row_force: wp.array(dtype=real)
        # with friction: coefficients, slip without contact and tangential forces
        friction: real
        wall_friction: real
        row_slip: wp.array(dtype=vec3)
        row_friction: wp.array(dtype=vec3)
        row_rub: wp.array(dtype=real)
        # work: rows, rows by partner, places of the fibers, parts, and the queue of fibers
        row_place: wp.array(dtype=real)
        row_state: wp.array(dtype=real)
        in_start: wp.array(dtype=wp.int32)
        in_row: wp.array(dtype=wp.int32)
        end_start: wp.array(dtype=wp.int32)
        motion: wp.array(dtype=real)
        fiber_at: wp.array(dtype=wp.int32)
        fiber_row: wp.array(dtype=wp.int32)
        fiber_part: wp.array(dtype=wp.int32)
        fiber_order: wp.array(dtype=wp.int32)
        part_start: wp.array(dtype=wp.int32)
        part_relaxed: wp.array(dtype=wp.int64)
        fiber_queued: wp.array(dtype=wp.uint8)
        queue: wp.array(dtype=wp.int32)
        # what rows do to each other, and the queue of rows, where there is one part
        row_hot: wp.array(dtype=real)
        touches: wp.array(dtype=real)
        touch_at: wp.array(dtype=wp.int32)
        row_queued: wp.array(dtype=wp.uint8)
        row_queue: wp.array(dtype=wp.int32)
        node_shift: wp.array(dtype=vec3)
        node_push: wp.array(dtype=vec3)  # forces on nodes, if they are asked for
        best: wp.array(dtype=wp.float64)
        control: wp.array(dtype=wp.int32)

    return Relaxation


@cache
def make_relaxation_begin(name: str) -> Any:
    """`begin_solve(work)`: what is told of a solve; no motion where there are no rows."""
    vec3 = precision(name).vec3
    Relaxation = relaxation_struct(name)

    @wp.func
    def begin_solve(d: Relaxation):
        d.control[wp.static(PHASE)] = wp.static(DONE)
        d.control[wp.static(NEXT_PHASE)] = wp.static(DONE)
        d.control[wp.static(UPDATES)] = 0
        d.control[wp.static(NEXT_UPDATES)] = 0
        d.best[1] = wp.float64(0.0)
        if d.status[wp.static(HALT)] != 0:
            return
        if d.row_count[0] == 0 or d.row_count[0] > d.row_i.shape[0]:
            for fiber in range(d.fibers):
                d.end_start[fiber + 1] = 0
            for node in range(d.node_shift.shape[0]):
                d.node_shift[node] = vec3()
            for node in range(d.node_push.shape[0]):
                d.node_push[node] = vec3()

    return begin_solve
