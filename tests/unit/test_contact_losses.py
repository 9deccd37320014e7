"""What contacts dissipate in a step: the work of all that is no spring, by the restatement."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.bonded_crowd import crowd
from tests.physics.test_ring_contacts import RADIUS, RUBBING, N, circle, hoop
from tests.reference.bonded_spheres import Rod
from tests.reference.capsule_contact import Laws, contact_loads
from tests.rods import start_rods
from tests.unit.test_kernels_capsules import MEETINGS, pair
from warpfiber.methods import bonded_spheres
from warpfiber.simulation import Simulation

ENERGY = {"record": {"quantities": ["energy"]}}


def lost(sim: Simulation) -> np.ndarray:
    """Put in against dashpots and friction of contacts so far, J, by segment."""
    units = sim.model.units
    return np.asarray(sim.method.energies.rubbed.numpy() * units.energy)  # type: ignore[attr-defined]


def speeds(sim: Simulation, back: float) -> list[np.ndarray]:
    """Velocities and spins of all nodes a time `back` before the end of the step, SI."""
    method: Any = sim.method
    units = sim.model.units
    turning = method.node_spin.numpy() / units.time
    rate, turn_rate = method.node_rate.numpy(), method.node_spin_rate.numpy()
    return [
        sim.node_velocity - back * rate * units.velocity / units.time,
        turning - back * turn_rate / units.time**2,
    ]


def put_in(rods: tuple[Rod, Rod], laws: Laws, sim: Simulation, steps: int) -> float:
    """Work against dashpots and friction in some steps, J."""
    x = np.concatenate([rod.rest for rod in rods])
    contact_loads(laws, rods, x, *speeds(sim, 0.0), 0.0)  # type: ignore[arg-type]
    work = 0.0
    for _ in range(steps):
        sim.step(1)
        amid, now = speeds(sim, 0.5 * sim.dt), speeds(sim, 0.0)
        loads = contact_loads(laws, rods, sim.node_pos, *amid, sim.dt)  # type: ignore[arg-type]
        springs = contact_loads(Laws(), rods, sim.node_pos, *amid, sim.dt)  # type: ignore[arg-type]
        for load, spring, speed in zip(loads, springs, now, strict=True):
            work -= sim.dt * float(((load - spring) * speed).sum())
    return work


@pytest.mark.parametrize("friction", [0.0, 0.3, 100.0])
@pytest.mark.parametrize("name", sorted(set(MEETINGS) - {"apart"}))
def test_work_of_what_is_no_spring(name: str, friction: float) -> None:
    """Rounding: 1e-7 of the work, as of the motion in 300 steps."""
    rods, laws = pair(name, 0.02, damping=0.0335), Laws(damping=0.113, friction=friction)
    rng = np.random.default_rng(4)
    v = 0.05 * rng.normal(size=(11, 3))
    v[6:] -= [0.1, 0.2, 0.5]
    contact = {"law": "hertz", "damping": laws.damping, "friction": laws.friction}
    w = 20.0 * rng.normal(size=v.shape)
    sim = start_rods(rods, v=v, w=w, contact=contact, quantities=["energy"])
    sim.prepare()
    expected = put_in(rods, laws, sim, 20)
    found = lost(sim).sum(0)
    assert found.sum() == pytest.approx(expected, rel=1e-7)
    assert found[0] > 0.0
    assert (found[1] != 0.0) == (friction > 0.0)
    row = sim.measure()
    told = row["dissipated_contacts"] + row.get("dissipated_friction", 0.0)
    assert told + row.get("energy_friction", 0.0) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_vectors_lose_the_same(precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By segment; eps of what the whole bed loses."""
    rows = []
    for native in (True, False):
        monkeypatch.setattr(bonded_spheres, "NATIVE", native)
        sim = crowd(precision, **ENERGY)
        sim.step(12)
        assert (sim.method.native is not None) == native  # type: ignore[attr-defined]
        rows.append(lost(sim))
        sim.method.close()
    eps = 1e-9 if precision == "float64" else 2e-3
    assert np.abs(rows[1]).sum(0).min() > 0.0
    assert np.abs(rows[0] - rows[1]).max() < eps * np.abs(rows[1]).max()


def test_closing_segment_of_rings() -> None:
    """It ends at the first node: rings lose as much wherever their numbering starts."""
    totals = []
    for shift in (0, 1, N - 1):
        above = [0.3e-3, 0.2e-3, 2.0 * RADIUS - 5e-5]
        rods = [hoop(np.roll(circle([0.0, 0.0, 0.0]), -shift, axis=0)), hoop(circle(above))]
        v = np.zeros((2 * N, 3))
        v[N:] = [0.3, 0.0, -0.2]
        sim = start_rods(rods, v=v, contact=RUBBING, quantities=["energy"])
        sim.step(50)
        totals.append(lost(sim).sum(0))
    assert (totals[0] > 0.0).all()
    for other in totals[1:]:
        assert other == pytest.approx(totals[0], rel=1e-9)
