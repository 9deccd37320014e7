"""Rigid rods: Jeffery orbits at any step, lengths, schedules, frames, agreement with stiff chains.

Source of the numbers: period 2 pi (r_e + 1/r_e)/rate, r_e = sqrt((r_f^2 + 1)/2): 444.3993608914 for
r_f = 100. Units a = eta = rate = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, isotropic, straight_fiber
from tests.reference import rigid
from tests.reference import rigid_rod as rr
from tests.reference.bead_chain import Array
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
ROD = Kind(1, 99.0)
R_E = math.sqrt(5000.5)
PERIOD = 2.0 * math.pi * (R_E + 1.0 / R_E)


def rods(start: Start, axis: Array, dt: float, **keys: Any) -> Simulation:
    """One rod of 100 beads per direction, all centered at 0 or at `center`."""
    center = keys.pop("center", np.zeros_like(axis))
    fibers = [straight_fiber(ROD, p, c) for p, c in zip(axis, center, strict=True)]
    numerics = {"method": "rigid_rod", "dt": dt, **keys.pop("numerics", {})}
    flow = keys.pop("flow", SHEAR)
    return start([ROD], fibers, [0] * len(axis), flow=flow, numerics=numerics, **keys)


def directions(sim: Simulation) -> Array:
    """Unit vector of every rod."""
    ends = sim.node_pos.reshape(-1, 2, 3)
    span = ends[:, 1] - ends[:, 0]
    return span / np.linalg.norm(span, axis=1)[:, None]


def test_period_of_the_literature() -> None:
    assert R_E == pytest.approx(70.7142135642, abs=5e-11)
    assert PERIOD == pytest.approx(444.3993608914, abs=5e-11)


# The strain of a run is off by the rounding of its sum, some 1e-12 of it, and at most the rate of
# an orbit, 1, amplifies that.
@pytest.mark.parametrize("pieces", [1, 2, 8, 444, 8888])
def test_rods_return_after_a_period(start: Start, pieces: int) -> None:
    axis = isotropic(np.random.default_rng(1), 200)
    sim = rods(start, axis, PERIOD / pieces)
    sim.step(pieces)
    assert np.abs(directions(sim) - axis).max() < 1e-9
    late = abs(sim.strain - PERIOD)
    assert np.abs(directions(sim) - axis).max() < 1e-11 + 1.1 * late


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.7, 30.0])
def test_period(start: Start, dt: float) -> None:
    """Half a turn of a rod from the flow axis, by the exact orbit within the step of crossing."""
    sim = rods(start, np.array([[1.0, 0.0, 0.0]]), dt)
    steps = round(PERIOD / 2.0 / dt)
    sim.step(steps)
    p = directions(sim)[0]
    # tan(angle) = -tan(phase)/r_e: the phase that the direction has against that of the strain
    phase = math.atan2(-p[2] * R_E, p[0])
    asked = sim.strain / (R_E + 1.0 / R_E)
    off = (phase - asked + math.pi) % (2.0 * math.pi) - math.pi
    assert abs(off) / math.pi < 1e-10


def test_ensemble_follows_jeffery_orbits(start: Start) -> None:
    """Every rod of an ensemble at strains between the turns, and the orientation tensor."""
    axis = isotropic(np.random.default_rng(2), 100)
    sim = rods(start, axis, 2.5, quantities=["orientation", "energy", "axial_strain", "curvature"])
    for _ in range(6):
        sim.step(9)
        exact = np.array([rigid.jeffery_orbit(p, SHEAR_GRADIENT, R_E, sim.strain) for p in axis])
        assert np.abs(directions(sim) - exact).max() < 1e-11
        row = sim.measure()
        assert row["a11"] == pytest.approx(float((exact[:, 0] ** 2).mean()), abs=1e-11)
        assert row["a13"] == pytest.approx(float((exact[:, 0] * exact[:, 2]).mean()), abs=1e-11)
        # rods keep their length and shape but for rounding
        assert row["axial_strain_max"] < 1e-14
        assert row["curvature_max"] == row["energy_bending"] == row["energy_stretching"] == 0.0
        assert "energy_kinetic" not in row


SHEAR_GRADIENT = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize(("precision", "bound"), [("float64", 4e-15), ("float32", 2e-6)])
def test_lengths_do_not_drift(start: Start, precision: str, bound: float) -> None:
    """Rounding of the nodes of the last step is all that a length is off by, however many went."""
    axis = isotropic(np.random.default_rng(3), 20)
    center = 50.0 * np.random.default_rng(4).normal(size=(20, 3)) * [1.0, 1.0, 0.0]
    sim = rods(start, axis, 0.02, center=center, numerics={"precision": precision})
    worst = []
    for _ in range(2):
        sim.step(10_000)
        ends = sim.node_pos.reshape(-1, 2, 3)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        worst.append(float(np.abs(length / 198.0 - 1.0).max()))
    assert max(worst) < bound


def test_single_precision_period(start: Start) -> None:
    """Half a turn in 4444 steps: what rounding of positions of some 100 leaves of 1/r_e."""
    sim = rods(start, np.array([[1.0, 0.0, 0.0]]), PERIOD / 8888, numerics={"precision": "float32"})
    sim.step(4444)
    p = directions(sim)[0]
    assert p[0] < -0.999
    assert abs(p[2]) < 1e-2 / R_E


def test_scheduled_rate(start: Start) -> None:
    """Only the strain counts: a schedule, in steps of any size, leads to the same orientation."""
    axis = isotropic(np.random.default_rng(5), 30)
    schedule = {"schedule": [[0.0, 0.2], [6.0, 1.0], [9.0, 0.5]]}
    for dt in (0.02, 0.9):
        sim = rods(start, axis, dt, flow=SHEAR | schedule)
        sim.run(10.0)
        exact = rr.map_rods_in_shear(rr.make_rods(0.0, axis, 100.0), 1.0, sim.strain)
        assert np.abs(directions(sim) - exact.axis).max() < 1e-12
        swing = sim.node_velocity.reshape(-1, 2, 3)[:, 1]
        _, turn = rr.flow_rate(exact, 0.5 * SHEAR_GRADIENT)
        assert np.abs(swing - 99.0 * turn).max() < 1e-10


def test_time_of_a_schedule(start: Start) -> None:
    """Strain against time where the rate grows with it: second order in the step."""
    flow = SHEAR | {"schedule": [[0.0, 0.5], [10.0, 2.0]]}
    off = []
    for dt in (0.1, 0.05):
        sim = rods(start, np.array([[1.0, 0.0, 0.0]]), dt, flow=flow)
        sim.step(round(4.0 / dt))
        # d(strain)/dt = 0.5 + 0.15 strain
        off.append(abs(sim.strain - 0.5 / 0.15 * math.expm1(0.15 * 4.0)))
    assert 3.5 < off[0] / off[1] < 4.5


@pytest.mark.parametrize("kind", ["simple_shear", "planar_extension", "uniaxial_extension"])
def test_box_follows_the_flow(start: Start, kind: str) -> None:
    """The lattice of a sheared or extended box after steps of any size is the flow's map of it."""
    rate = "shear_rate" if kind == "simple_shear" else "extension_rate"
    flow = {"kind": kind, rate: 1.0, "viscosity": 1.0}
    size = [300.0, 280.0, 260.0]
    axis = isotropic(np.random.default_rng(6), 10)
    for dt in (0.05, 0.5):
        sim = rods(start, axis, dt, flow=flow, box={"size": size}, center=axis + 130.0)
        sim.step(round(1.0 / dt))
        factor = rr.exponential(np.asarray(sim.method.full_gradient) * sim.strain)
        assert np.abs(sim.lattice - factor @ np.diag(size)).max() < 1e-13 * 300.0 * math.e


def test_moved_and_turned_frames(start: Start) -> None:
    """Elsewhere (with the flow's origin), and seen from turned axes: the same motion."""
    rng = np.random.default_rng(7)
    axis, center = isotropic(rng, 20), 30.0 * rng.normal(size=(20, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    away = np.array([30.0, -20.0, 55.0])
    plain = rods(start, axis, 0.3, center=center)
    seen = rods(
        start,
        axis @ turn.T,
        0.3,
        center=center @ turn.T + away,
        flow={
            "kind": "gradient",
            "gradient": (turn @ SHEAR_GRADIENT @ turn.T).tolist(),
            "origin": away.tolist(),
            "viscosity": 1.0,
        },
    )
    for sim in (plain, seen):
        sim.step(100)
    back = (seen.node_pos - away) @ turn
    assert np.abs(back - plain.node_pos).max() < 1e-11 * np.abs(plain.node_pos).max()


def test_stiff_chain_is_a_rod(start: Start) -> None:
    """A fiber of one inextensible segment without inertia converges to the map, second order."""
    axis = isotropic(np.random.default_rng(8), 10)
    rod = rods(start, axis, 5.0)
    rod.step(2)
    off = []
    for dt in (0.05, 0.025):
        sim = rods(
            start,
            axis,
            dt,
            numerics={"method": "overdamped"},
            groups={"inextensible": True},
        )
        sim.step(round(10.0 / dt))
        off.append(float(np.abs(directions(sim) - directions(rod)).max()))
    assert off[1] < 5e-5
    assert 3.0 < off[0] / off[1] < 5.0


def test_rods_sink_as_beads_do(start: Start) -> None:
    """At rest: the speed of a bead, whatever the direction, and no turn."""
    axis = isotropic(np.random.default_rng(9), 5)
    sim = rods(
        start,
        axis,
        0.4,
        flow={"kind": "rest", "viscosity": 2.0},
        gravity={"acceleration": [0.0, 0.0, -3.0], "fluid_density": 0.04},
    )
    before = sim.node_pos
    sim.step(50)
    speed = 4.0 / 3.0 * math.pi * 0.06 * 3.0 / (12.0 * math.pi)
    assert np.abs(sim.node_pos - before - [0.0, 0.0, -speed * sim.time]).max() < 1e-12
    assert np.abs(sim.node_velocity - [0.0, 0.0, -speed]).max() < 1e-14
