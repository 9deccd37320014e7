"""Contact of flexible fibers whose factors are found again by the axes of their segments.

Tolerance: rounding of two eliminations, K eps of the size of the cell; K as in `test_native_chain`,
and once more for the solve on top of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind
from tests.meeting_cell import Meeting, last_rows
from warpfiber.methods import overdamped
from warpfiber.passes import chain_response
from warpfiber.passes.native_factor import axes_stride
from warpfiber.simulation import Simulation

KINDS = (Kind(3, 3.0, modulus=3e3), Kind(6, 1.6, modulus=7e6), Kind(1, 8.0))
COUNTS = (31, 26, 29)
EPS = {"float64": 2.0**-52, "float32": 2.0**-23}
K = 3e4


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


def cell(meeting: Meeting, **keys: Any) -> Simulation:
    """Fibers of several kinds that meet."""
    which = np.repeat(np.arange(len(KINDS)), COUNTS).tolist()
    return meeting("overdamped", kinds=KINDS, which=which, **keys)


@pytest.mark.parametrize(
    ("precision", "friction"), [("float64", 0.0), ("float32", 0.0), ("float64", 0.3)]
)
def test_axes_stand_for_factors(
    meeting: Meeting, monkeypatch: pytest.MonkeyPatch, precision: str, friction: float
) -> None:
    """The first step of a cell, alike in both but for its contact forces."""
    found = []
    for stored in (True, False):
        if stored:
            monkeypatch.setattr(overdamped, "axes_stride", lambda *_: 0)
        else:
            monkeypatch.undo()
        contact = {"law": "exponential", "friction": friction}
        sim = cell(meeting, numerics={"precision": precision}, contact=contact)
        method: Any = sim.method
        assert method.native
        assert (method.axes.shape[0] == 0) == stored
        sim.step()
        nodes = sim.state.node_pos.numpy().astype(float)
        found.append((nodes, method.tension.numpy().astype(float), last_rows(sim)["force"]))
    (nodes, tension, force), (same_nodes, same_tension, same_force) = found
    assert (force > 0.0).sum() > 20
    rounding = K * EPS[precision]
    assert np.abs(same_force - force).max() < rounding * np.abs(force).max()
    assert np.abs(same_nodes - nodes).max() < rounding * np.abs(nodes).max()
    assert np.abs(same_tension - tension).max() < rounding * np.abs(tension).max()


def test_columns_without_room(meeting: Meeting, monkeypatch: pytest.MonkeyPatch) -> None:
    """What finds no place is found whenever it is asked for: the same to the bit."""
    found = []
    for room in (chain_response.MOST_NUMBERS, 4000, 0):
        monkeypatch.setattr(chain_response, "MOST_NUMBERS", room)
        sim = cell(meeting)
        sim.step(6)
        found.append((last_rows(sim)["force"], sim.state.node_pos.numpy().copy()))
    assert (found[0][0] > 0.0).sum() > 20
    for force, nodes in found[1:]:
        assert (force == found[0][0]).all()
        assert (nodes == found[0][1]).all()


def test_axes_fill_whole_vectors() -> None:
    assert [axes_stride("float64", nodes) for nodes in (1, 2, 3, 6)] == [8, 8, 16, 24]
    assert [axes_stride("float32", nodes) for nodes in (2, 4, 5)] == [16, 16, 32]
