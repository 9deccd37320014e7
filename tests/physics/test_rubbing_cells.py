"""Cells of fibers with friction: workers and parts, resuming, packed chains, stress, both solvers.

Tolerance: what must be the same is so to the bit; forces of two solvers are apart by what their
tolerance of lengths allows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.friction_cell import by, loads
from tests.meeting_cell import HARD, Meeting, last_rows
from tests.physics.test_packed_cells import packed_scene, row_loads
from tests.reference.bead_chain import Array
from warpfiber.passes import relaxation_launches
from warpfiber.simulation import Simulation

METHODS = ["rigid_rod", "overdamped"]
RUBBING = HARD | {"friction": 0.4, "wall_friction": 0.2}


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("precision", "parts"), [("float64", 1), ("float64", 2), ("float32", 2)])
def test_same_for_any_number_of_workers(
    meeting: Meeting, monkeypatch: pytest.MonkeyPatch, method: str, precision: str, parts: int
) -> None:
    monkeypatch.setattr(relaxation_launches, "PARTED", 0)
    monkeypatch.setattr(relaxation_launches, "MOST_PARTS", parts)
    found = []
    for workers in (1, 2):
        sim = meeting(
            method, 60, workers=workers, contact=RUBBING, numerics={"precision": precision}
        )
        sim.step(12)
        found.append(sim.state.node_pos.numpy().copy())
        assert np.abs(loads(sim)[1]).max() > 0.0
    assert (found[0] == found[1]).all()


@pytest.mark.parametrize("method", METHODS)
def test_resumed_to_the_bit(meeting: Meeting, method: str) -> None:
    whole = meeting(method, 60, contact=RUBBING)
    whole.step(8)
    saved = whole.snapshot()
    assert any("friction" in name for name in saved)
    whole.step(8)
    again = meeting(method, 60, contact=RUBBING)
    again.restore(saved)
    again.step(8)
    assert (whole.state.node_pos.numpy() == again.state.node_pos.numpy()).all()
    assert (loads(whole)[1] == loads(again)[1]).all()


@pytest.mark.parametrize("method", METHODS)
def test_both_solvers_agree(meeting: Meeting, method: str) -> None:
    """After one step from the same state."""
    sims = [
        by(meeting(method, 60, contact=RUBBING, numerics={"contact_tolerance": 1e-8}), solver)
        for solver in ("relaxed", "gradients")
    ]
    sims[0].step(10)
    start = sims[0].snapshot()
    sims[1].restore(start)
    for sim in sims:
        sim.step()
    assert (loads(sims[0])[0] > 0.0).sum() > 5
    apart = np.abs(sims[0].state.node_pos.numpy() - sims[1].state.node_pos.numpy()).max()
    assert apart < 1e-5
    assert sims[0].method.contact.unsolved == 0  # type: ignore[attr-defined]
    assert sims[1].method.contact.unsolved == 0  # type: ignore[attr-defined]


@pytest.mark.parametrize("method", METHODS)
def test_without_friction_there_is_none(meeting: Meeting, method: str) -> None:
    sim = meeting(method, 40)
    rows, dual = sim.method.contact.solves[0]  # type: ignore[attr-defined]
    assert rows.rub is None
    sim.step(5)
    assert not any("friction" in name for name in sim.snapshot())
    dual.relaxes = False
    names = [x.name for x in dual.launches() + rows.launches() if hasattr(x, "kernel")]
    assert not {"fill_slip", "carry_friction", "free_spin", "rub_clear"} & set(names)
    assert dual.row_slip.shape[0] == dual.row_mu.shape[0] == dual.fiber_turn.shape[0] == 0


@pytest.mark.parametrize("method", METHODS)
def test_large_friction_is_solved_or_told(meeting: Meeting, method: str) -> None:
    sim = meeting(method, 60, contact=HARD | {"friction": 3.0})
    sim.step(20)
    assert np.isfinite(sim.state.node_pos.numpy()).all()
    report = sim.method.step_report()
    assert report["fault"] < 1e-3 or report["unsolved_contacts"] > 0


def contact_stress(sim: Simulation) -> Array:
    """(3, 3) moments of all contact forces: from middle to middle, by every pair's whole force."""
    rows, flat = last_rows(sim), loads(sim)[1]
    nodes = sim.state.node_pos.numpy().astype(float).reshape(-1, 2, 3)
    lattice = sim.state.lattice.numpy()[0]
    middle = nodes.mean(axis=1)
    total = np.zeros((3, 3))
    for k in range(len(rows["i"])):
        i, j = rows["i"][k], rows["j"][k]
        x = (1 - rows["s"][k]) * nodes[i, 0] + rows["s"][k] * nodes[i, 1]
        y = (1 - rows["t"][k]) * nodes[j, 0] + rows["t"][k] * nodes[j, 1]
        image = np.rint(np.linalg.solve(lattice, y - x))
        apart = middle[j] - middle[i] - lattice @ image
        force = rows["force"][k] * rows["normal"][k] + flat[k]
        total -= np.outer(apart, force)
    return 0.5 * (total + total.T)


def test_stress_counts_friction(meeting: Meeting) -> None:
    """sigma = -1/V sum of (x_j - x_i) (f n + F), its symmetric part."""
    sim = meeting("rigid_rod", 60, contact=RUBBING, quantities=("orientation", "stress"))
    sim.step(12)
    units = sim.model.units
    volume = abs(np.linalg.det(sim.state.lattice.numpy()[0]))
    scale = units.force / units.length**2 / volume
    expected = scale * contact_stress(sim)
    found = sim.measure()
    for name, at in {"11": (0, 0), "33": (2, 2), "13": (0, 2), "12": (0, 1)}.items():
        got = found[f"stress_contact_{name}"]
        assert got == pytest.approx(expected[at], abs=1e-10 * np.abs(expected).max())
    assert np.abs(loads(sim)[1]).max() > 0.0


# -- packed chains --------------------------------------------------------------------------------


def friction_loads(sim: Simulation) -> Array:
    """(N, 3) what the tangential forces of the last rows are on the nodes, couples too."""
    host, rows, flat = sim.model.host, last_rows(sim), loads(sim)[1]
    start = sim.method.node_back.numpy().astype(float)  # type: ignore[attr-defined]
    load = np.zeros((sim.model.node_count, 3))
    for k, force in enumerate(flat):
        for side, share, sign in (("i", rows["s"][k], -1.0), ("j", rows["t"][k], 1.0)):
            segment = rows[side][k]
            if segment < 0:
                continue
            node = host["segment_node"][segment]
            span = start[node + 1] - start[node]
            group = sim.model.group_rows[host["fiber_group"][host["segment_fiber"][segment]]]
            # the couple of the force about the center line, by two opposite forces across it
            couple = group["radius"] * np.cross(force, rows["normal"][k])
            opposite = np.cross(couple, span) / (span @ span)
            load[node] += sign * (1.0 - share) * force - opposite
            load[node + 1] += sign * share * force + opposite
    return load


@pytest.mark.parametrize("solver", ["relaxed", "gradients"])
def test_packed_chains(solver: str) -> None:
    """Forces of friction stay on the fibers in the next motion without contact, as the others."""
    scene = packed_scene()
    contact: Any = dataclasses.replace(scene.contact, friction=0.3, wall_friction=0.3)
    sim = by(Simulation(dataclasses.replace(scene, contact=contact), workers=1), solver)
    sim.step(8)
    kept = sim.method.load.contact_load.numpy()  # type: ignore[attr-defined]
    rubbed = friction_loads(sim)
    expected = row_loads(sim) + rubbed
    assert np.abs(rubbed).max() > 0.01 * np.abs(expected).max()
    assert np.abs(kept - expected).max() < 1e-11 * np.abs(expected).max()
    # passes over all rows, which know only what rigid fibers would do, may stop at their limit
    if solver == "relaxed":
        assert sim.method.contact.unsolved == 0  # type: ignore[attr-defined]
    sim.close()
