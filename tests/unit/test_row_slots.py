"""Rows chosen many pairs at a time are those that every pair would choose for itself.

No tolerance: which rows there are is a decision, and the cells have no gap at its limit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.meeting_cell import Meeting, contact_rows
from warpfiber.passes.native_row_slots import FIRST, LAST, LOOK
from warpfiber.passes.pair_motion import make_pair_motion
from warpfiber.simulation import Simulation

BITS = np.array([bin(value).count("1") for value in range(256)])


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Cells that are closed at the end of the test."""
    made = Meeting([])
    yield made
    for simulation in made.running:
        simulation.close()


def chosen(sim: Simulation, native: bool) -> tuple[Any, Any, Any]:
    """Slots before and after the count, and how many rows every pair has."""
    rows, model = contact_rows(sim), sim.model
    launch = rows._motion(sim.state.node_pos, rows.pair_clear)
    kernel = make_pair_motion(model.precision.name, True, native=native)
    dim = launch.dim if native else model.segment_count
    rows.pair_slots.fill_(77)
    rows.pairs_known.zero_()  # every pair is measured
    wp.launch(kernel, dim=dim, inputs=[0, *launch.inputs], device=model.device)
    pairs = sim.method.list.pair_count  # type: ignore[union-attr]
    before = rows.pair_slots.numpy()[:pairs].copy()
    rows._launch("count_rows", rows._count_inputs()).run(model.device)
    counts = rows.pair_row_count.numpy()[:pairs].copy()
    return before, rows.pair_slots.numpy()[:pairs].copy(), counts


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
def test_rows_are_those_of_single_pairs(meeting: Meeting, method: str, precision: str) -> None:
    sim = meeting(method, 75, numerics={"precision": precision})
    seen = ends = many = 0
    for _ in range(12):
        sim.step(3)
        sim.method.prepare()
        marked, alone, single = chosen(sim, False)
        found, settled, counted = chosen(sim, True)
        assert set(np.unique(marked)) <= {0, LOOK}
        assert (settled == alone).all()
        assert (counted == single).all()
        assert (counted == BITS[settled]).all()
        seen += int((settled > 0).sum())
        many += int((counted > 1).sum())
        ends += int((settled > 1).sum())
        # none is left to be looked at alone, whether it is near a joint or not
        assert not (found == LOOK).any()
    assert seen > 300 and many > 10 and ends > 100


def test_thicker_fibers_are_looked_at_alone(meeting: Meeting) -> None:
    """Radii that differ decide otherwise: nothing is chosen, nothing is left out."""
    sim = meeting("overdamped", 75)
    rows = contact_rows(sim)
    assert rows._looks()[-1] == 1
    sim.step(9)
    sim.method.prepare()
    _, alone, single = chosen(sim, False)
    looks = rows._looks
    rows._looks = lambda: [*looks()[:-1], 0]  # type: ignore[method-assign]
    found, settled, counted = chosen(sim, True)
    assert set(np.unique(found)) == {0, LOOK}
    assert (settled == alone).all() and (counted == single).all() and (counted > 0).any()


def test_ends_of_fibers(meeting: Meeting) -> None:
    sim = meeting("overdamped", 40)
    ends, fiber = contact_rows(sim).segment_ends.numpy(), sim.model.host["segment_fiber"]
    for number in range(sim.model.fiber_count):
        mine = ends[fiber == number]
        assert (mine & FIRST).tolist() == [FIRST] + (len(mine) - 1) * [0]
        assert (mine & LAST).tolist() == (len(mine) - 1) * [0] + [LAST]
