"""Rows of contact as arrays of the device, made by NumPy, and the solve of them alone.

Units: as in `cell`, a = eta = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from tests.reference.bead_chain import Array
from warpfiber.model import Model
from warpfiber.passes.executor import Executor
from warpfiber.passes.unilateral import ContactDual, ContactLaw
from warpfiber.simulation import Simulation

WALL = -1
RELAXES: bool | None = None  # which solver; None: as the device has it


class FlatRow(NamedTuple):
    """One row between segments i and j (-1: a wall) at the fractions s and t."""

    i: int
    j: int
    s: float
    t: float
    normal: Array
    base: float
    compliance: float = 0.0
    force: float = 0.0


@dataclass
class RowArrays:
    """What `contact_rows.ContactRows` holds, and the index of the pairs by partner."""

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
    pair_row: Any
    pair_row_count: Any
    in_start: Any
    in_pair: Any
    rub: Any = None


def in_order(rows: Sequence[FlatRow]) -> list[FlatRow]:
    """Rows by owner, of each first those of pairs, by partner, then those of walls."""
    return sorted(rows, key=lambda row: (row.i, row.j == WALL, row.j))


def row_arrays(model: Model, rows: Sequence[FlatRow], spare: int = 7) -> RowArrays:
    """Arrays of rows that are `in_order`, with some room left."""
    p, segments = model.precision, model.segment_count
    capacity = len(rows) + spare
    pairs = sorted({(row.i, row.j) for row in rows if row.j != WALL})
    index = {pair: k for k, pair in enumerate(pairs)}
    pair_of = [index.get((row.i, row.j), -1) for row in rows]
    counts = np.bincount([k for k in pair_of if k >= 0], minlength=len(pairs)).astype(int)
    first = [pair_of.index(k) for k in range(len(pairs))]
    owner = np.array([row.i for row in rows], int)
    partner = np.array([j for _, j in pairs], int)

    def put(values: Any, dtype: Any, size: int) -> Any:
        padded = np.zeros((size, *np.shape(values)[1:]), np.float64)
        padded[: len(values)] = values
        return wp.array(padded, dtype=dtype, device=model.device)

    def starts(keys: Array) -> Any:
        edges = np.concatenate([[0], np.cumsum(np.bincount(keys, minlength=segments))])
        return put(edges, wp.int32, segments + 1)

    def column(name: str, dtype: Any) -> Any:
        values = [getattr(row, name) for row in rows]
        values = values or ([[0.0, 0.0, 0.0]] if name == "normal" else [0])
        return put(np.array(values, float), dtype, max(capacity, 1))

    return RowArrays(
        put([len(rows)], wp.int32, 1),
        *(column(name, wp.int32) for name in ("i", "j")),
        *(column(name, p.real) for name in ("s", "t")),
        column("normal", p.vec3),
        *(column(name, p.real) for name in ("base", "compliance", "force")),
        starts(owner),
        put([*first, len(rows)], wp.int32, len(pairs) + 1),
        put([*counts], wp.int32, max(len(pairs), 1)),
        starts(partner),
        put(np.argsort(partner, kind="stable"), wp.int32, max(len(pairs), 1)),
    )


@dataclass
class Solved:
    """Forces (R,), shift of the nodes (N, 3), number of updates and fault of a solve."""

    force: Array
    shift: Array
    updates: int
    fault: float
    dual: ContactDual


def solve_rows(
    sim: Simulation,
    rows: Sequence[FlatRow],
    response: Any,
    dt: float,
    *,
    workers: int = 1,
    tolerance: float = 1e-9,
    law: ContactLaw | None = None,
    most: int = 5000,
    repeats: int = 1,
    fiber_frozen: Any = None,
    chunks: tuple[int, int] | None = None,
    arrays: RowArrays | None = None,
) -> Solved:
    """One solve of rows that are `in_order`, at the present positions; `repeats` the step."""
    model = sim.model
    arrays = arrays or row_arrays(model, rows)
    dual = ContactDual(
        model,
        sim.state,
        arrays,
        arrays,
        response,
        step_size=wp.array([dt], dtype=wp.float64, device=model.device),
        node_start=sim.state.node_pos,
        tolerance=tolerance,
        law=law,
        most=most,
        fiber_frozen=fiber_frozen,
        chunks=chunks,
        relaxes=RELAXES,
    )
    executor = Executor(dual.launches(), model.device, workers)
    executor.run(repeats, lambda: False)
    executor.close()
    count = len(rows)
    return Solved(
        arrays.row_force.numpy()[:count].astype(float),
        dual.node_shift.numpy().astype(float),
        dual.updates,
        dual.fault,
        dual,
    )
