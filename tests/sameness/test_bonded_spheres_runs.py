"""Bonded spheres: runs that must agree to the last bit, and stages that end by stillness."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.reference import bonded_spheres as ref
from tests.rods import start_rods
from warpfiber.simulation import Simulation


def bent_rods(count: int) -> list[ref.Rod]:
    """Rods of two lengths with bent stress-free shapes."""
    rng = np.random.default_rng(3)
    rods = []
    for k in range(count):
        heading = np.array([1.0, 0.0, 0.3]) + 0.3 * rng.normal(size=(5 + k % 2, 3)).cumsum(0)
        heading *= 2.4e-3 / np.linalg.norm(heading, axis=1)[:, None]
        rest = np.concatenate([np.zeros((1, 3)), heading.cumsum(0)]) + 0.1 + 0.02 * rng.random(3)
        rods.append(ref.Rod(rest, 1.2e-3, damping=0.0335, caps="capsule"))
    return rods


def fall(precision: str = "float64", **keys: Any) -> Simulation:
    """Eleven rods with random velocities fall on a wall."""
    rods = bent_rods(11)
    nodes = sum(len(rod.rest) for rod in rods)
    return start_rods(
        rods,
        v=np.random.default_rng(4).normal(size=(nodes, 3)),
        w=100.0 * np.random.default_rng(5).normal(size=(nodes, 3)),
        box={"boundary": ["open", "open", "wall"], "size": [1.0, 1.0, 0.13]},
        contact={"law": "none", "damping": 0.113},
        gravity={},
        stage=[{"kind": "settle", "damping": 5.0, "end_time": 1.0, "end_speed": 0.1}],
        numerics={"precision": precision},
        **keys,
    )


def assert_same(a: Simulation, b: Simulation) -> None:
    """Every array of the state equal to the last bit."""
    first, second = a.snapshot(), b.snapshot()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_workers_and_batches(precision: str) -> None:
    """1 = 2 = 3 workers; steps one by one and in odd parts."""
    runs = [fall(precision, workers=n) for n in (1, 2, 3)]
    for sim in runs:
        sim.step(300)
    single = fall(precision)
    for count in (1, 1, 7, 133, 157, 1):
        single.step(count)
    for other in (*runs[1:], single):
        assert_same(runs[0], other)
    assert np.isfinite(runs[0].node_pos).all()
    for sim in runs:
        sim.close()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("at", [0, 1, 131])
def test_restore(precision: str, at: int) -> None:
    """Snapshot, restore into a new simulation, go on: the same as the run without a break.

    The new one is built from the deformed fibers, as a resumed run is: the stress-free shape must
    come from the snapshot.
    """
    run = fall(precision)
    run.step(at)
    saved = run.snapshot()
    run.step(300 - at)
    again = fall(precision)
    again.method.bond_axis.zero_()  # type: ignore[attr-defined]
    again.restore(saved)
    again.step(300 - at)
    assert_same(run, again)


def test_renumbered_fibers() -> None:
    """No fiber knows of the others: alone each moves as among the others to the last bit."""
    rods = bent_rods(5)
    rng = np.random.default_rng(1)
    velocity = [rng.normal(size=rod.rest.shape) for rod in rods]
    together = start_rods(rods, v=np.concatenate(velocity), dt=2e-5)
    together.step(100)
    first = 0
    for rod, v in zip(rods, velocity, strict=True):
        alone = start_rods([rod], v=v, dt=2e-5)
        alone.step(100)
        mine = together.node_pos[first : first + len(rod.rest)]
        assert alone.node_pos.tobytes() == mine.tobytes()
        first += len(rod.rest)


def test_single_precision_follows() -> None:
    """float32 with float64 positions stays at 1e-4 of the motion over 1000 steps of a fall."""
    a, b = fall("float64"), fall("float32")
    before = a.node_pos
    for sim in (a, b):
        sim.step(1000)
    assert np.abs(a.node_pos - b.node_pos).max() < 1e-3 * np.abs(a.node_pos - before).max()


def test_slow_motion_is_kept_in_single_precision() -> None:
    """3e-4 m/s far from the origin moves by v t, where float32 positions would not move at all."""
    rod = bent_rods(1)[0]
    sim = start_rods([rod], v=np.full(rod.rest.shape, 3e-4), numerics={"precision": "float32"})
    before = sim.method.place.numpy()  # type: ignore[attr-defined]
    sim.prepare()
    before = sim.method.place.numpy().copy()  # type: ignore[attr-defined]
    sim.step(1000)
    moved = sim.method.place.numpy() - before  # type: ignore[attr-defined]
    expected = 3e-4 * sim.time / sim.model.units.length
    assert np.abs(moved / expected - 1.0).max() < 1e-4


SCENE = """
[box]
size = [0.06, 0.06, 0.05]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 2
length = 0.02
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
bond_damping = 0.0335
[[fibers]]
node_file = "arch.npz"
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
[contact]
law = "none"
damping = 0.113
[[stage]]
kind = "settle"
name = "fall"
end_time = 0.02
[[stage]]
kind = "settle"
damping = 60
end_speed = 1e-3
time_limit = 2.0
[record]
frames = 10
scalars = 400
figures = false
quantities = ["orientation", "energy", "axial_strain"]
[numerics]
method = "bonded_spheres"
segment_length = 2.4e-3
"""


def write_scene(folder: Path) -> Path:
    """The scene above and its node file: one arch of seven nodes."""
    angle = np.linspace(-0.9, 0.9, 7)
    radius = 2.5e-3 / (2.0 * np.sin(0.15))
    nodes = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1) * radius + 0.02
    np.savez(folder / "arch.npz", node_pos=nodes[None])
    path = folder / "bed.toml"
    path.write_text(SCENE)
    return path


def test_resumed_job(tmp_path: Path) -> None:
    """A run stopped in its second stage and resumed writes the rows of the run without a stop."""
    scene = wf.load_scene(write_scene(tmp_path))
    whole = wf.Job.start(scene, out=tmp_path / "whole")
    assert whole.run() == 0
    speed = np.linalg.norm(whole.simulation.node_velocity, axis=1).max()
    assert speed < 1e-3
    assert 0.03 < whole.simulation.time < 2.0
    # still for 0.01 s, and no step longer than that
    method: Any = whole.simulation.method
    assert method.still_steps.numpy().min() == method.bed.still_needed
    job = wf.Job.start(scene, out=tmp_path / "parts")

    class Stop:
        """Asks for a stop in the second stage."""

        exit_code = 130

        def __enter__(self) -> Stop:
            return self

        def __exit__(self, *_: object) -> None: ...

        @property
        def reason(self) -> str:
            return "Ctrl-C" if job.simulation.time > 0.05 else ""

    assert job.run(Stop()) == 130
    assert wf.Job.resume(tmp_path / "parts").run() == 0
    rows = [(tmp_path / name / "scalars.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]
    head = rows[0].partition("\n")[0]
    for name in ("kinetic", "stretching", "shear", "bending", "twist", "gravity", "wall"):
        assert f"energy_{name}" in head


def test_unmet_condition(tmp_path: Path) -> None:
    """A bed that is not still within the limit ends the run with code 3 and says how fast it is."""
    scene = wf.load_scene(write_scene(tmp_path), {"stage.1.time_limit": 0.011})
    job = wf.Job.start(scene, out=tmp_path / "out")
    assert job.run() == 3
    assert job.simulation.time == pytest.approx(0.031, abs=2.0 * job.simulation.dt)
    failure = json.loads((tmp_path / "out" / "summary.json").read_text())["failure"]
    assert failure["outcome"] == "end condition not met"
    assert "end_speed = 0.001 m/s; the fastest node moves at" in failure["message"]
    with pytest.raises(wf.simulation.StageUnfinished, match="end_speed"):
        Simulation(scene).run()
