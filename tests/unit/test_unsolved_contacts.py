"""Contact forces that are not within their tolerance are counted, and told once."""

from __future__ import annotations

import warnings

import pytest

from tests.meeting_cell import METHODS, meeting_scene
from warpfiber.simulation import Simulation


@pytest.mark.parametrize("method", METHODS)
def test_unsolved_contacts_are_told_once(method: str) -> None:
    law = {"contact": {"law": "linear", "stiffness": 300.0}}  # may overlap: no step is taken back
    sim = Simulation(
        meeting_scene(method, 75, numerics={"contact": "penalty"}, **law),
        workers=1,
    )
    (_, dual), *_ = sim.method.contact.solves  # type: ignore[attr-defined]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim.step(3)
    assert sim.method.step_report()["unsolved_contacts"] == 0
    sim.method._stop_executor()
    dual.tolerance, dual.most = 1e-14, 1
    with pytest.warns(RuntimeWarning, match=r"numerics\.contact_tolerance") as told:
        for _ in range(5):
            sim.step()
    assert len(told) == 1
    assert sim.method.step_report()["unsolved_contacts"] >= 5  # repeated steps too
    sim.close()
