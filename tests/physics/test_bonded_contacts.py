"""Bonded spheres that meet: restitution, momenta, Coulomb, rolling, lists that do not matter."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.reference import bonded_spheres as ref
from tests.rods import start_rods
from warpfiber.simulation import Simulation

RADIUS, STEP = 1.2e-3, 2.4e-3
WALL = {"boundary": ["open", "open", "wall"]}


def short(center: Any, direction: Any, segments: int = 1) -> ref.Rod:
    """A straight fiber around a center."""
    along = (np.arange(segments + 1) - 0.5 * segments)[:, None] * STEP
    rest = np.asarray(center) + along * np.asarray(direction, float)
    return ref.Rod(rest, RADIUS, caps="capsule")


def thrown(sim: Simulation, rods: list[ref.Rod]) -> tuple[np.ndarray, np.ndarray]:
    """Momentum and angular momentum of all."""
    first, linear, angular = 0, np.zeros(3), np.zeros(3)
    spin = sim.method.node_spin.numpy() / sim.model.units.time  # type: ignore[attr-defined]
    for rod in rods:
        mine = slice(first, first + len(rod.rest))
        motion = ref.start(rod, x=sim.node_pos[mine], v=sim.node_velocity[mine], w=spin[mine])
        found = ref.momentum(rod, motion)
        linear, angular = linear + found[0], angular + found[1]
        first += len(rod.rest)
    return linear, angular


@pytest.mark.parametrize("speed", [0.05, 0.5])
@pytest.mark.parametrize("beta", [0.0, 0.113])
def test_crossed_impact(beta: float, speed: float) -> None:
    """e = exp(-b (pi - 2 asin b) / sqrt(1 - b^2)) at any speed: contacts never pull."""
    rods = [short([0.5, 0.5, 0.5], [1, 0, 0]), short([0.5, 0.5, 0.5 + 2.41e-3], [0, 1, 0])]
    v = np.zeros((4, 3))
    v[2:, 2] = -speed
    sim = start_rods(
        rods, v=v, contact={"law": "hertz", "damping": beta}, numerics={"dt_fraction": 0.05}
    )
    sim.run(time=0.01 * 0.5 / speed)
    after = sim.node_velocity
    root = math.sqrt(1.0 - beta * beta)
    expected = math.exp(-beta * (math.pi - 2.0 * math.asin(beta)) / root)
    assert (after[2, 2] - after[0, 2]) / speed == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("friction", [0.3, 1.4])
def test_oblique_impact(friction: float) -> None:
    """Momentum and angular momentum to rounding; friction and dashpots take energy."""
    rods = [
        short([0.5, 0.5, 0.5], [1, 0, 0], 4),
        short([0.503, 0.501, 0.5 + 2.41e-3], [0.6, 0.8, 0.0], 3),
    ]
    v = np.zeros((9, 3))
    v[5:] = [0.2, -0.1, -0.5]
    sim = start_rods(
        rods,
        v=v,
        contact={"law": "hertz", "damping": 0.113, "friction": friction},
        quantities=["energy"],
    )
    before, energy = thrown(sim, rods), sim.measure()["energy_kinetic"]
    sim.run(time=0.02)
    after, row = thrown(sim, rods), sim.measure()
    scale = np.abs(before[0]).max()
    assert np.abs(after[0] - before[0]).max() < 1e-12 * scale
    assert np.abs(after[1] - before[1]).max() < 1e-12 * scale
    left = sum(value for name, value in row.items() if name.startswith("energy"))
    assert 0.3 < left / energy < 0.95
    assert sim.method.contacts.acts.numpy().sum() == 0  # type: ignore[attr-defined]


@pytest.mark.parametrize("modulus", [7.5e5, 7.5e7])
def test_sliding_to_rolling(modulus: float) -> None:
    """A fiber sliding sideways ends up rolling at 1 / (1 + 2/5 (a / (a - d))^2) of its speed.

    Without overlap d that is 5/7; the lever of the friction is a - d. What swings when the slip
    ends is damped away; errors of the order of dt times its rate.
    """
    rod = short([0.5, 0.5, RADIUS - 1.5e-6], [1, 0, 0])
    v = np.zeros((2, 3))
    v[:, 1] = 0.1
    sim = start_rods(
        [rod],
        v=v,
        box=WALL,
        contact={"law": "none", "damping": 0.5, "wall_friction": 0.3, "modulus": modulus},
        gravity={},
    )
    sim.run(time=0.1)
    lever = sim.node_pos[:, 2].mean()
    left = sim.node_velocity[:, 1] / 0.1
    assert left == pytest.approx(1.0 / (1.0 + 0.4 * (RADIUS / lever) ** 2), abs=1e-4)
    assert left == pytest.approx(5.0 / 7.0, abs=1e-4 if modulus > 1e7 else 1e-3)
    spin = sim.method.node_spin.numpy() / sim.model.units.time  # type: ignore[attr-defined]
    assert -spin[:, 0] * lever == pytest.approx(sim.node_velocity[:, 1], rel=1e-12)


@pytest.mark.parametrize(("part", "slides"), [(0.95, False), (1.1, True)])
def test_slope(part: float, slides: bool) -> None:
    """A fiber along the slope sticks below tan = mu, without creep, and slides above."""
    friction = 0.5
    tilt = math.atan(part * friction)
    down = 9.81 * np.array([math.sin(tilt), 0.0, -math.cos(tilt)])
    rod = short([0.5, 0.5, RADIUS - 1.5e-6], [1, 0, 0], 6)
    sim = start_rods(
        [rod],
        box=WALL,
        contact={"law": "none", "damping": 0.5, "wall_friction": friction},
        gravity={"acceleration": down.tolist()},
        numerics={"dt_fraction": 0.3},
    )
    sim.run(time=0.2)
    first = sim.node_pos[:, 0].mean()
    sim.run(time=0.4)
    moved = sim.node_pos[:, 0].mean() - first
    if slides:
        rate = 9.81 * (math.sin(tilt) - friction * math.cos(tilt))
        assert moved == pytest.approx(0.5 * rate * (0.4**2 - 0.2**2), rel=0.05)
    else:
        assert abs(moved) < 1e-7


def heap(skin: float | None = None, workers: int = 1, precision: str = "float64") -> Simulation:
    """Twelve fibers fall on each other and on a wall, in a box that is periodic to the sides."""
    rng = np.random.default_rng(8)
    rods = []
    for k in range(12):
        angle = rng.uniform(0.0, np.pi)
        center = [0.015 * rng.random(), 0.015 * rng.random(), 0.003 + 0.003 * k]
        rods.append(short(center, [math.cos(angle), math.sin(angle), 0.0], 3 + k % 3))
    numerics = {"precision": precision} | ({"skin": skin} if skin else {})
    v = np.concatenate([np.tile([0.0, 0.0, -0.5], (len(r.rest), 1)) for r in rods])
    return start_rods(
        rods,
        v=v,
        box={"size": [0.015, 0.015, 0.06], "boundary": ["periodic", "periodic", "wall"]},
        contact={"law": "hertz", "damping": 0.113, "friction": 0.5, "wall_friction": 0.6},
        gravity={"acceleration": [0.0, 0.0, -50.0]},
        stage=[{"kind": "settle", "damping": 60.0, "end_time": 1.0}],
        numerics=numerics,
        workers=workers,
        quantities=["contacts", "energy"],
    )


def test_the_skin_does_not_matter() -> None:
    """Lists with other skins are built at other steps and give the same motion to rounding."""
    runs = [heap(skin) for skin in (2e-4, 8e-4)]
    for sim in runs:
        sim.step(2000)
    assert runs[0].measure()["contacts_per_fiber"] > 0.5
    assert runs[0].method.list.build_count > 2 * runs[1].method.list.build_count  # type: ignore[union-attr]
    moved = np.abs(runs[0].node_pos - heap().node_pos).max()
    assert np.abs(runs[0].node_pos - runs[1].node_pos).max() < 1e-8 * moved


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_workers_and_restart(precision: str) -> None:
    """Workers, and a run continued from a snapshot, agree to the last bit, memories included."""
    runs = [heap(workers=n, precision=precision) for n in (1, 2, 3)]
    again = heap(precision=precision)
    for sim in runs:
        sim.step(200)
    assert_same(runs)
    runs[0].step(900)
    saved = runs[0].snapshot()
    assert saved["contact_acts"].sum() > 3
    for sim in (*runs[1:], again):
        sim.restore(saved)
    built = runs[0].method.list.build_count  # type: ignore[union-attr]
    for sim in (*runs, again):
        sim.step(400)
    assert runs[0].method.list.build_count > built + 1  # type: ignore[union-attr]
    assert_same([*runs, again])
    for sim in (*runs, again):
        sim.close()


def assert_same(runs: list[Simulation]) -> None:
    """All arrays of all runs agree to the last bit."""
    first = runs[0].snapshot()
    for sim in runs[1:]:
        other = sim.snapshot()
        assert first.keys() == other.keys()
        for name, value in first.items():
            assert value.tobytes() == other[name].tobytes(), name


SCENE = """
[box]
size = [0.03, 0.03, 0.06]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 40
length = 0.0144
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
bond_damping = 0.0335
[contact]
damping = 0.113
friction = 0.3
wall_friction = 0.6
[[stage]]
kind = "settle"
damping = 30
end_speed = 5e-3
time_limit = 3.0
[record]
scalars = 30
frames = 5
figures = false
quantities = ["contacts", "overlap", "energy"]
[numerics]
method = "bonded_spheres"
segment_length = 2.4e-3
"""


def test_the_wall_bears_the_bed(tmp_path: Path) -> None:
    """A settled bed pushes the wall with its weight, to 2 %."""
    path = tmp_path / "bed.toml"
    path.write_text(SCENE)
    job = wf.Job.start(wf.load_scene(path), out=tmp_path / "out")
    assert job.run() == 0
    simulation = job.simulation
    depth = np.maximum(RADIUS - simulation.node_pos[:, 2], 0.0)
    push = 4.0 / 3.0 * 7.5e5 / 0.75 * math.sqrt(RADIUS) * (depth**1.5).sum()
    rod = short([0.0, 0.0, 0.0], [1, 0, 0], 5)
    assert push == pytest.approx(40.0 * 9.81 * rod.mass.sum(), rel=0.02)
    row = job.record.last_row
    assert row["coordination_number"] > 2.0
    assert row["overlap_max"] < 0.1
