"""Rows relaxed by what they do to each other, stored or computed whenever it is needed.

Tolerance: none, the same sums in the same order; against fibers that move at once, two solutions
within TOLERANCE of the same rows, each of which moves a fiber by that times its rows at most.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.meeting_cell import Meeting, last_rows
from warpfiber.passes import relaxation_launches
from warpfiber.simulation import Simulation

METHODS = ["rigid_rod", "overdamped"]
FIBERS, TOLERANCE = 75, 1e-7
SOFT: dict[str, Any] = {"law": "linear", "stiffness": 300.0}  # hard rows of rods: `rod_sweeps`


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


def stepped(
    meeting: Meeting, method: str, tables: dict[str, Any] | None = None, **numerics: Any
) -> Simulation:
    """A cell after some steps."""
    sim = meeting(method, FIBERS, numerics=numerics, **(tables or {}))
    sim.step(12)
    return sim


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_same_without_room_for_couplings(
    meeting: Meeting, monkeypatch: pytest.MonkeyPatch, method: str, precision: str
) -> None:
    found = []
    tables, numerics = {}, {"precision": precision}
    if method == "rigid_rod":
        tables, numerics = {"contact": SOFT}, {**numerics, "contact": "penalty"}
    for room in (relaxation_launches.TOUCHES, 1, 0):
        monkeypatch.setattr(relaxation_launches, "TOUCHES", room)
        sim = stepped(meeting, method, tables, **numerics)
        found.append((last_rows(sim)["force"], sim.state.node_pos.numpy().copy()))
    assert (found[0][0] > 0.0).sum() > 5
    for force, nodes in found[1:]:
        assert (force == found[0][0]).all()
        assert (nodes == found[0][1]).all()


@pytest.mark.parametrize("method", METHODS)
def test_motion_is_that_of_the_forces(meeting: Meeting, method: str) -> None:
    """A solve that starts from its own solution finds it within the tolerance already."""
    sim = stepped(meeting, method, contact_tolerance=TOLERANCE)
    start = sim.snapshot()
    sim.step()
    whole, forces = sim.state.node_pos.numpy().copy(), last_rows(sim)["force"]
    sim.restore(start)
    sim.prepare()
    contact = sim.method.contact  # type: ignore[attr-defined]
    contact.solves[0][0].row_force.zero_()  # a cold start instead of a warm one
    sim.step()
    assert np.abs(sim.state.node_pos.numpy() - whole).max() < 20.0 * TOLERANCE
    assert contact.report()["fault"] <= TOLERANCE
    assert contact.report()["updates"] > 0
    assert len(last_rows(sim)["force"]) == len(forces)
