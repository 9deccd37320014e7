"""Cells that are relaxed in parts: the same solution, to the bit for any number of workers.

Tolerance: two solutions of a fault within TOLERANCE of the same rows, each of which moves a fiber
by that times its number of rows at most.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.cell import isotropic
from tests.meeting_cell import Meeting, last_rows, rejected
from tests.reference.bead_chain import Array
from warpfiber.passes import relaxation_launches
from warpfiber.passes.native_relaxation import PARTS
from warpfiber.simulation import Simulation

TOLERANCE = 1e-7
FIBERS = 75
LARGE = {"size": [32.0, 33.0, 31.0]}
METHODS = ["rigid_rod", "overdamped"]


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


def cell(
    meeting: Meeting, monkeypatch: pytest.MonkeyPatch, method: str, parts: int, **keys: Any
) -> Simulation:
    """A cell that is cut into so many parts."""
    monkeypatch.setattr(relaxation_launches, "PARTED", 0)
    monkeypatch.setattr(relaxation_launches, "MOST_PARTS", parts)
    numerics = {"contact_tolerance": TOLERANCE, "precision": keys.pop("precision", "float64")}
    sim = meeting(method, FIBERS, box=LARGE, numerics=numerics, **keys)
    sim.prepare()
    return sim


def work(sim: Simulation) -> Any:
    """What the first relaxation of the last step worked with."""
    assert sim.method.executor is not None
    launches = [step for step in sim.method.executor.launches if step.name == "relax_parts"]
    assert launches[0].inputs[0] == PARTS
    return launches[0].inputs[1]


def nodes(sim: Simulation) -> Array:
    """Positions now."""
    values: Array = sim.state.node_pos.numpy().astype(float)
    return values


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("parts", [2, 5])
def test_parts_agree_with_the_whole(
    meeting: Meeting, monkeypatch: pytest.MonkeyPatch, method: str, parts: int
) -> None:
    """After a step with contacts inside the parts and between them."""
    whole = cell(meeting, monkeypatch, method, 1)
    whole.step(12)
    start = whole.snapshot()
    whole.step()
    cut = cell(meeting, monkeypatch, method, parts)
    cut.restore(start)
    cut.step()
    assert rejected(whole) == rejected(cut)
    of = work(cut)
    own = of.fiber_part.numpy()
    assert (np.bincount(own, minlength=parts) > 0).all()
    assert (of.part_relaxed.numpy() > 0).any()
    rows, fiber = last_rows(cut), cut.model.host["segment_fiber"]
    met = (rows["j"] >= 0) & (rows["force"] > 0.0)
    within = own[fiber[rows["i"]]] == own[fiber[rows["j"]]]
    assert (met & within).any() and (met & ~within).any()
    assert cut.method.contact.report()["fault"] <= TOLERANCE  # type: ignore[attr-defined]
    assert np.abs(nodes(cut) - nodes(whole)).max() < 20.0 * TOLERANCE


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_same_for_any_number_of_workers(
    meeting: Meeting, monkeypatch: pytest.MonkeyPatch, method: str, precision: str
) -> None:
    found = []
    for workers in (1, 2, 3):
        sim = cell(meeting, monkeypatch, method, 3, precision=precision, workers=workers)
        sim.step(15)
        found.append((nodes(sim), last_rows(sim)["force"], rejected(sim)))
    assert (found[0][1] > 0.0).sum() > 5
    for other in found[1:]:
        assert (other[0] == found[0][0]).all()
        assert (other[1] == found[0][1]).all()
        assert other[2] == found[0][2]


def test_cut_across_the_axis_of_least_reach(
    meeting: Meeting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fibers that lie in planes of equal z: parts are slabs along z, of about as many rows."""
    sim = cell(meeting, monkeypatch, "rigid_rod", 3)
    sim.step()
    middle = nodes(sim).reshape(-1, 2, 3).mean(axis=1)
    flat = isotropic(np.random.default_rng(3), FIBERS) * (1.0, 1.0, 0.02)
    flat *= 9.0 / np.linalg.norm(flat, axis=1)[:, None]
    placed = np.stack([middle - flat, middle + flat], axis=1).reshape(-1, 3)
    sim.method.node_back.assign(placed)  # type: ignore[attr-defined]
    assert sim.method.executor is not None
    launches = {launch.name: launch for launch in sim.method.executor.launches}
    launches["relax_begin"].run("cpu")
    of = work(sim)
    own, height = of.fiber_part.numpy(), middle[:, 2]
    for part in range(2):
        # places within a bin are the same
        assert height[own == part].max() < height[own > part].min() + 0.05
    counts = np.bincount(own, weights=1 + np.diff(of.end_start.numpy()))
    assert counts.min() > 0.5 * counts.max()
