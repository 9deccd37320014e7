"""A step that halts before its rows are made leaves no lists of rows behind."""

from __future__ import annotations

from pathlib import Path

import pytest

import warpfiber as wf
from warpfiber.model import EXPIRED
from warpfiber.passes.executor import Executor

SCENE = Path(__file__).parents[2] / "scenes" / "sasayama_2018" / "shear_cell.toml"


@pytest.fixture(scope="module")
def cell() -> wf.Scene:
    keys = {
        "box.size": [2.5e-4] * 3,
        "numerics.method": "overdamped",
        "contact.lubrication": "none",
    }
    return wf.load_scene(SCENE, keys)


def test_no_lists_after_a_halt(cell: wf.Scene) -> None:
    """Rows that grew hold zeros: a list that were followed through them would have no end."""
    simulation = wf.Simulation(cell)
    method = simulation.method
    _, dual = method.contact.solves[0]  # type: ignore[attr-defined]
    dual.relaxes = False  # that solver needs no such lists
    simulation.step(3)
    assert (dual.fiber_in.numpy() >= 0).any()
    launches = [x for x in method.launches() if x.name in ("begin", "dual_lists")]
    words = simulation.state.status.numpy().copy()
    words[EXPIRED] = 1
    simulation.state.status.assign(words)
    Executor(launches, simulation.device).run(1, lambda: False)
    assert (dual.fiber_in.numpy() == -1).all()
    simulation.close()


def test_a_tolerance_takes_no_larger_steps_of_contact(cell: wf.Scene) -> None:
    """The error estimate does not see contact: 0.05, not the 0.2 of fibers that do not meet."""
    assert cell.flow is not None and cell.numerics.tolerance is not None
    assert wf.Simulation(cell).dt * cell.flow.rate == pytest.approx(0.05)
