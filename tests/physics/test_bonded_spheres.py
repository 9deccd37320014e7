"""Bonded spheres on the device against closed forms: bending, vibration, decay, flight, walls."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import start_rods
from warpfiber.methods.stability import step_limits
from warpfiber.simulation import Diverged

RADIUS, LENGTH, DENSITY, MODULUS = 1.2e-3, 62.83e-3, 1340.0, 7.5e5
AREA, MOMENT = math.pi * RADIUS**2, 0.25 * math.pi * RADIUS**4
SHEAR_MODULUS = MODULUS / 3.0
BONDS = ("energy_stretching", "energy_shear", "energy_bending", "energy_twist")


def straight(n: int, height: float = 0.5, **keys: object) -> ref.Rod:
    """Fiber of n segments along x."""
    rest = np.full((n + 1, 3), height)
    rest[:, 0] = 0.3 + np.linspace(0.0, LENGTH, n + 1)
    return ref.Rod(rest, RADIUS, **keys)  # type: ignore[arg-type]


@pytest.mark.parametrize("shear", ["ga", "rbf"])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_cantilever(shear: str, precision: str) -> None:
    """Settles to P L^3 / 3 E I (1 - 1 / 4 n^2) + P L / G A; with `rbf` the bracket is 1.

    A deflection of 1e-3 L is linear to 1e-6. In float32 strains of 1e-4 carry errors of 1e-7.
    """
    n = 8
    force = 1e-3 * 3.0 * MODULUS * MOMENT / LENGTH**2
    sim = start_rods(
        [straight(n, shear=shear, damping=0.5)],
        load=[{"node": 0, "hold": "clamp"}, {"node": -1, "force": [0.0, force, 0.0]}],
        stage=[{"kind": "settle", "damping": 25.0, "end_time": 2.0}],
        numerics={"precision": precision},
    )
    sim.run()
    bracket = 1.0 - 0.25 / n**2 if shear == "ga" else 1.0
    bent = force * LENGTH**3 / (3.0 * MODULUS * MOMENT) * bracket
    expected = bent + force * LENGTH / (SHEAR_MODULUS * AREA)
    moved = sim.node_pos[-1, 1] - 0.5
    assert moved == pytest.approx(expected, rel=1e-5 if precision == "float64" else 5e-3)


def first_mode(rod: ref.Rod) -> tuple[float, np.ndarray]:
    """Angular frequency and displacements (n, 6) of the first bending mode in the x-y plane."""
    matrix = ref.stiffness(rod, rod.rest, np.tile(ref.IDENTITY, (len(rod.rest), 1)))
    plane = np.ravel(6 * np.arange(len(rod.rest))[:, None] + [1, 5])
    matrix = 0.5 * (matrix + matrix.T)[np.ix_(plane, plane)]
    root = np.sqrt(np.stack([rod.mass, rod.inertia], axis=1).ravel())
    values, vectors = np.linalg.eigh(matrix / np.outer(root, root))
    mode = np.zeros((len(rod.rest), 6))
    mode[:, [1, 5]] = (vectors[:, 2] / root).reshape(-1, 2)  # after two rigid motions
    return float(np.sqrt(values[2])), mode / np.abs(mode[:, 1]).max()


@pytest.mark.parametrize("shear", ["ga", "rbf"])
def test_free_vibration(shear: str) -> None:
    """Frequency of mode 1 over two periods: discrete eigenvalue to 1e-4, Timoshenko to 1 %.

    Verlet raises it by (w dt)^2 / 24 = 2e-7; amplitudes of 1e-5 L leave the linear range alone.
    """
    rod = straight(26, shear=shear)
    w, mode = first_mode(rod)
    assert w == pytest.approx(80.135, rel=1.2e-2)
    size = 1e-5 * LENGTH
    x = rod.rest + size * mode[:, :3]
    q = ref.exponential(size * mode[:, 3:])
    sim = start_rods([rod], x=x, q=q)
    times, tip = [], []
    for _ in range(200):
        sim.step(max(1, round(4.0 * np.pi / w / sim.dt / 200)))
        times.append(sim.time)
        tip.append(sim.node_pos[-1, 1] - 0.5)
    ends = np.array(tip)
    turns = np.flatnonzero(np.sign(ends[1:]) != np.sign(ends[:-1]))
    t = [times[k] - ends[k] * (times[k + 1] - times[k]) / (ends[k + 1] - ends[k]) for k in turns]
    assert len(t) == 4
    measured = 3.0 * np.pi / (t[3] - t[0])
    assert measured == pytest.approx(w, rel=1e-4)


def test_decay_of_the_first_mode() -> None:
    """Energy falls as exp(-2 d t), d = 0.0194773 1/s the Rayleigh quotient of the dashpots."""
    rod = straight(26, shear="ga", damping=0.0335)
    w, mode = first_mode(rod)
    size = 1e-5 * LENGTH
    x, q = rod.rest + size * mode[:, :3], ref.exponential(size * mode[:, 3:])
    sim = start_rods([rod], x=x, q=q, quantities=["energy"])

    def energy() -> float:
        row = sim.measure()
        return row["energy_kinetic"] + sum(row[name] for name in BONDS)

    begin, cycle = energy(), 2.0 * np.pi / w
    sim.run(time=10.0 * cycle)
    assert 0.5 * math.log(begin / energy()) / sim.time == pytest.approx(0.0194773, rel=1e-3)


def test_long_undamped_flight() -> None:
    """1e5 steps at 0.2 of the limit, ends thrown at 3 m/s: energy to 1e-3, momenta to rounding.

    Verlet's energy swings by O(dt^2) and does not drift; throws that bend more swing more.
    """
    rod = straight(26)
    along = np.linspace(-1.0, 1.0, 27)[:, None]
    v = 3.0 * np.concatenate([0.0 * along, along, along**2], axis=1)
    sim = start_rods([rod], v=v, quantities=["energy"], numerics={"dt_fraction": 0.2})
    start = ref.start(rod, v=v)
    first = ref.momentum(rod, start)
    begin = ref.kinetic_energy(rod, start)
    worst = 0.0
    for _ in range(50):
        sim.step(2000)
        row = sim.measure()
        energy = row["energy_kinetic"] + sum(row[name] for name in BONDS)
        worst = max(worst, abs(energy / begin - 1.0))
    assert sim.step_count == 100_000
    assert worst < 1e-3
    end = ref.start(
        rod,
        x=sim.node_pos,
        v=sim.node_velocity,
        w=sim.method.node_spin.numpy() / sim.model.units.time,  # type: ignore[attr-defined]
    )
    last = ref.momentum(rod, end)
    scale = begin / 3.0
    assert np.abs(last[0] - first[0]).max() < 1e-12 * scale
    assert np.abs(last[1] - first[1]).max() < 1e-12 * scale * LENGTH


def test_spin_of_a_curved_fiber() -> None:
    """Two half circles thrown into a spin of 10 rad/s, undamped, for 2 s: energy to 1e-5."""
    n, kappa = 26, 100.0
    step = 0.06283 / n
    bend = kappa * step
    heading = np.cumsum(np.where(np.arange(n) < n // 2, bend, -bend)) - 0.5 * bend
    chord = 2.0 / kappa * math.sin(0.5 * bend)
    edges = chord * np.stack([np.cos(heading), np.sin(heading), 0.0 * heading], axis=1)
    rest = np.concatenate([np.zeros((1, 3)), edges.cumsum(0)])
    rest += 0.5 - rest.mean(0)
    rod = ref.Rod(rest, RADIUS, segment_length=step, caps="capsule")
    spin = np.tile([3.0, 4.0, 8.7], (n + 1, 1))
    middle = (rod.mass[:, None] * rest).sum(0) / rod.mass.sum()
    v = np.cross(spin, rest - middle)
    sim = start_rods([rod], v=v, w=spin, quantities=["energy"])
    begin = sim.measure()["energy_kinetic"]
    worst = 0.0
    for time in np.linspace(0.0, 2.0, 21)[1:]:
        sim.run(time=time)
        row = sim.measure()
        total = row["energy_kinetic"] + sum(row[name] for name in BONDS)
        worst = max(worst, abs(total / begin - 1.0))
    assert worst < 1e-5
    assert row["energy_bending"] > 1e-4 * begin  # it is no rigid body


@pytest.mark.parametrize("shear", ["ga", "rbf"])
@pytest.mark.parametrize(("part", "stable"), [(0.97, True), (1.03, False)])
def test_largest_step(shear: str, part: float, stable: bool) -> None:
    """Just below its limit a rod keeps its energy, just above it is torn."""
    rod = straight(26, shear=shear)
    rng = np.random.default_rng(1)
    v = 1e-3 * rng.normal(size=(27, 3))
    numerics = {"dt_fraction": part, "allow_unstable_dt": True}
    sim = start_rods([rod], v=v, quantities=["energy"], numerics=numerics)
    assert sim.limits[0].dt == pytest.approx(rod.largest_step(), rel=1e-5)
    if not stable:
        with pytest.raises(Diverged, match="torn"):
            sim.step(20_000)
        return
    begin = sim.measure()["energy_kinetic"]
    sim.step(20_000)
    assert sim.measure()["energy_kinetic"] < 50.0 * begin


def test_dashpots_shorten_the_step() -> None:
    """With strong dashpots the damped limit still holds."""
    rod = straight(26, damping=1.0)
    v = 1e-2 * np.random.default_rng(1).normal(size=(27, 3))
    sim = start_rods([rod], v=v, quantities=["energy"], numerics={"dt_fraction": 0.95})
    assert sim.limits[0].dt < 0.35 * rod.largest_step()
    begin = sim.measure()["energy_kinetic"]
    sim.step(5000)
    row = sim.measure()
    assert row["energy_kinetic"] + sum(row[name] for name in BONDS) < begin
    assert step_limits(sim.scene)[0].term.startswith("bond")


def test_settling_on_a_wall() -> None:
    """An arch falls and comes to rest: the wall bears its weight, and energy only falls."""
    n = 12
    angle = np.linspace(-0.6, 0.6, n + 1)
    radius = 2.4e-3 / (2.0 * np.sin(0.05))
    rest = np.stack(
        [0.5 + radius * np.sin(angle), np.full(n + 1, 0.5), radius * (np.cos(angle) - 0.825)], 1
    )
    rest[:, 2] += 3e-3 - rest[:, 2].min()
    rod = ref.Rod(rest, RADIUS, damping=0.0335, caps="capsule")
    sim = start_rods(
        [rod],
        box={"boundary": ["open", "open", "wall"]},
        contact={"law": "none", "damping": 0.113},
        gravity={},
        stage=[{"kind": "settle", "damping": 30.0, "end_speed": 1e-5, "time_limit": 5.0}],
        quantities=["energy"],
    )
    totals = []
    for _ in range(20):
        row = sim.measure()
        totals.append(sum(value for name, value in row.items() if name.startswith("energy")))
        sim.step(500)
    assert (np.diff(totals) < 1e-9 * abs(totals[0])).all()
    sim.run()
    assert np.linalg.norm(sim.node_velocity, axis=1).max() < 1e-5
    depth = np.maximum(RADIUS - sim.node_pos[:, 2], 0.0)
    push = 4.0 / 3.0 * MODULUS / 0.75 * math.sqrt(RADIUS) * (depth**1.5).sum()
    assert push == pytest.approx(9.81 * rod.mass.sum(), rel=1e-3)
