"""Beds between walls that move: Hertz at the wall, work and energy, both pressures, memory."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.reference import bonded_spheres as ref
from tests.rods import rates, start_rods
from warpfiber.methods.press import Press
from warpfiber.scene import SceneError, Stage
from warpfiber.simulation import Simulation

RADIUS, STEP = 1.2e-3, 2.4e-3
EDGE, HEIGHT = 0.015, 0.03
BOX = {"size": [EDGE, EDGE, HEIGHT], "boundary": ["periodic", "periodic", "wall"]}
MODULUS = 7.5e5 / 0.75  # E* against a rigid wall


def level(height: float, segments: int = 3, angle: float = 0.0, **keys: Any) -> ref.Rod:
    """A level fiber above the middle of the box."""
    along = (np.arange(segments + 1) - 0.5 * segments)[:, None] * STEP
    ahead = np.array([math.cos(angle), math.sin(angle), 0.0])
    rest = np.array([0.5 * EDGE, 0.5 * EDGE, height]) + along * ahead
    return ref.Rod(rest, RADIUS, caps="capsule", **keys)


def press_of(sim: Simulation) -> Press:
    """The walls of a simulation."""
    press = sim.method.press  # type: ignore[attr-defined]
    assert isinstance(press, Press)
    return press


def stage(kind: str, speed: float, **keys: Any) -> dict[str, Any]:
    """A stage of the upper wall."""
    return {"kind": kind, "wall": "z+", "speed": speed, **keys}


@pytest.mark.parametrize("wall", ["z+", "z-"])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_hertz_at_the_moving_wall(precision: str, wall: str) -> None:
    """A held fiber feels 4/3 E* sqrt(a) delta^1.5 per node at delta = speed times time.

    The wall starts at the fiber, wherever that is; its work is 8/15 E* sqrt(a) delta^2.5 per node.
    """
    rod, speed, end = level(0.01), 0.05, 4e-3
    sim = start_rods(
        [rod],
        box=BOX,
        contact={"law": "none", "damping": 0.0},
        load=[{"node": k, "hold": "position"} for k in range(4)],
        stage=[stage("compress", speed, end_time=end) | {"wall": wall}],
        numerics={"precision": precision, "dt": 1e-5},
        quantities=["stress", "energy"],
    )
    press, side = press_of(sim), int(wall == "z+")
    start = 0.01 + RADIUS * (1 if side else -1)
    units = sim.model.units
    eps = float(np.finfo(sim.model.precision.numpy).eps)
    # the place of the fiber is given in the precision of the run
    assert press.place.numpy()[side, 2] * units.length == pytest.approx(start, rel=2 * eps)
    sim.run()
    depth = speed * sim.time
    push = 4.0 * 4.0 / 3.0 * MODULUS * math.sqrt(RADIUS) * depth**1.5
    found = press.push.numpy()[0] * units.force
    # depth is the difference of places that are rounded at 0.01 m
    rounding = 10.0 * eps * 0.01 / depth + 1e-9
    assert found[side] == pytest.approx(push, rel=rounding)
    assert found[1 - side] == 0.0
    work = 4.0 * 8.0 / 15.0 * MODULUS * math.sqrt(RADIUS) * depth**2.5
    # trapezoids of t^1.5 over n steps: second order
    steps = sim.step_count
    assert sim.measure()["wall_work"] == pytest.approx(work, rel=2.0 / steps**2 + rounding)
    assert sim.measure()["energy_wall"] == pytest.approx(work, rel=2.0 * rounding)


def test_a_dashpot_feels_the_speed_of_the_wall() -> None:
    """A fiber at rest before a wall at speed v is hit as a fiber at v hits a wall at rest."""
    keys: dict[str, Any] = {"contact": {"law": "none", "damping": 0.3}, "numerics": {"dt": 1e-5}}
    rod, speed = level(0.01), 0.2
    pushed = start_rods([rod], box=BOX, stage=[stage("compress", speed, end_time=0.03)], **keys)
    top = 0.01 + RADIUS
    thrown = start_rods(
        [rod],
        v=np.tile([0.0, 0.0, speed], (4, 1)),
        box=BOX | {"size": [EDGE, EDGE, top]},
        stage=[{"kind": "settle", "end_time": 0.03}],
        **keys,
    )
    pushed.run(time=0.02)
    thrown.run(time=0.02)
    assert thrown.node_velocity[:, 2].max() < 0.0
    difference = thrown.node_velocity[:, 2] - speed - pushed.node_velocity[:, 2]
    # the two differ by where rounding puts the planes, 1e-16 of 0.01 m in an overlap of 1e-4 m
    assert np.abs(difference).max() < 1e-9 * speed


def layers(damping: float = 0.0335) -> list[ref.Rod]:
    """Eight crossed fibers, one on the other."""
    heights = RADIUS + 2.0 * RADIUS * np.arange(8)
    return [
        level(z, 2 + 2 * (k % 2), 1.0 * k, damping=damping) for k, z in enumerate(heights.tolist())
    ]


def heap(
    *, stages: list[dict[str, Any]], friction: float = 1.4, damping: float = 0.113, **keys: Any
) -> Simulation:
    """Eight crossed fibers; without weight unless `keys` say so."""
    numerics = keys.pop("numerics", {})
    return start_rods(
        layers(0.0335 * (damping > 0)),
        box=BOX,
        contact={"law": "hertz", "damping": damping, "friction": friction, "wall_friction": 0.6},
        stage=stages,
        numerics=numerics,
        quantities=["stress", "energy"],
        **keys,
    )


def energy(row: dict[str, float]) -> float:
    """Sum of all energies, J."""
    return sum(value for name, value in row.items() if name.startswith("energy_"))


@pytest.mark.parametrize("fraction", [0.03, 0.2])
def test_work_is_energy(fraction: float) -> None:
    """A tilted elastic fiber thrown about and bent between the walls has their work at any time."""
    along = (np.arange(5) - 2.0)[:, None] * STEP
    rest = np.array([0.5 * EDGE, 0.5 * EDGE, 0.5 * HEIGHT]) + along * np.array([0.6, 0.0, 0.8])
    sim = start_rods(
        [ref.Rod(rest, RADIUS, caps="capsule")],
        box=BOX,
        contact={"law": "none"},
        stage=[stage("compress", 1.0, end_time=0.018), stage("unload", 1.0, end_time=0.01)],
        numerics={"dt_fraction": fraction},
        quantities=["energy"],
    )
    rows = []
    for part, end in zip(sim.scene.stage_sequence, (0.018, 0.028), strict=True):
        sim.begin_stage(part)
        while sim.time < end:
            sim.step(10)
            rows.append(sim.measure())
    given = np.array([row["wall_work"] for row in rows])
    held = np.array([energy(row) for row in rows])
    bent = max(row["energy_bending"] for row in rows)
    assert bent > 0.05 * given.max() and given[-1] < 0.9 * given.max()
    # velocity Verlet, less than second order where a touch begins amid a step
    assert np.abs(held - given).max() < 0.03 * fraction * given.max()


@pytest.mark.parametrize(("damping", "most"), [(0.0, 1e-3), (0.113, 1e-3)])
def test_no_energy_beyond_the_work(damping: float, most: float) -> None:
    """A bed pressed at 1 m/s with friction 1.4 and let go has 0.1 % more than the work at most.

    They cross at their middle nodes; without dashpots they topple until they lie along each other.
    """
    sim = heap(
        stages=[
            stage("compress", 1.0, end_volume_fraction=0.3),
            stage("unload", 1.0, end_pressure=0.0),
        ],
        damping=damping,
        numerics={"dt_fraction": 0.1},
    )
    largest = 0.0
    start = sim.measure()
    assert energy(start) == 0.0
    for part in sim.scene.stage_sequence[:2]:
        sim.begin_stage(part)
        while (steps := sim.stage_steps(part, (0.0, sim.time))) > 0:
            sim.step(min(steps, 20))
            row = sim.measure()
            largest = max(largest, row["wall_work"])
            assert energy(row) < row["wall_work"] + most * largest
    assert largest > 0.0
    sim.begin_stage(Stage(kind="settle", name="settle"))
    for _ in range(20):
        sim.run(time=sim.time + 0.0025)
        row = sim.measure()
        assert energy(row) < row["wall_work"] + most * largest


def test_walls_and_momentum() -> None:
    """Without weight, m dv/dt of all nodes is what the lower wall pushes more than the upper one.

    k eps of the forces; the bed bounces between the walls, so that their ratio is nothing fixed.
    """
    sim = heap(
        stages=[stage("compress", 0.1, end_volume_fraction=0.35)],
        numerics={"dt_fraction": 0.3},
    )
    sim.run()
    low, high = press_of(sim).push.numpy()[0] * sim.model.units.force
    mass = np.concatenate([rod.mass for rod in layers()])
    momentum = (mass * rates(sim)[0][:, 2]).sum()
    assert high > 100.0 * EDGE**2
    assert abs(low - high - momentum) < 1e-9 * (low + high)


SCENE = """
seed = 3
[box]
size = [0.02, 0.02, 0.06]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 20
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
[[stage]]
name = "load"
kind = "compress"
wall = "z+"
speed = 0.2
end_volume_fraction = 0.4
time_limit = 0.3
[[stage]]
kind = "unload"
wall = "z+"
speed = 0.2
end_pressure = 0
time_limit = 0.3
repeat_from = "load"
repeat = 2
[record]
scalars = 900
frames = 5
figures = false
quantities = ["stress", "energy"]
[numerics]
method = "bonded_spheres"
segment_length = 2.4e-3
"""


def columns(path: Path) -> dict[str, np.ndarray]:
    """The rows of a run by column."""
    table = np.genfromtxt(path / "scalars.csv", delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names}


def test_cycles_of_a_bed(tmp_path: Path) -> None:
    """Weight on the lower wall, ends of stages, and a stop amid a stage that leaves no trace."""
    path = tmp_path / "bed.toml"
    path.write_text(SCENE)
    scene = wf.load_scene(path)
    whole = wf.Job.start(scene, out=tmp_path / "whole")
    assert whole.run() == 0
    log = (tmp_path / "whole" / "log.txt").read_text()
    ends = [
        float(line.split("time ")[1].split()[0]) for line in log.splitlines() if "ended" in line
    ]
    assert len(ends) == 5
    row = columns(tmp_path / "whole")
    settled = int(np.searchsorted(row["time"], ends[0] - 1e-6))  # told to six digits
    mass = 20.0 * ref.Rod(level(0.0, 5).rest, RADIUS, caps="capsule").mass.sum()
    assert row["pressure_low"][settled] == pytest.approx(mass * 9.81 / 0.02**2, rel=0.02)
    assert row["pressure_high"][settled] == 0.0 and row["wall_work"][settled] == 0.0
    pressed = int(np.searchsorted(row["time"], ends[1] - 1e-6))
    assert row["pressure_high"][pressed] > 100.0
    assert press_of(whole.simulation).push.numpy()[0, 1] == 0.0  # where the last stage ended

    job = wf.Job.start(scene, out=tmp_path / "parts")

    class Stop:
        """Asks for a stop amid the first compression, then amid the last unloading."""

        exit_code = 130
        at = 0.5 * (ends[0] + ends[1])

        def __enter__(self) -> Stop:
            return self

        def __exit__(self, *_: object) -> None: ...

        @property
        def reason(self) -> str:
            return "Ctrl-C" if job.simulation.time > self.at else ""

    assert job.run(Stop()) == 130
    job = wf.Job.resume(tmp_path / "parts")
    Stop.at = 0.5 * (ends[3] + ends[4])
    assert job.run(Stop()) == 130
    job = wf.Job.resume(tmp_path / "parts")
    assert job.run() == 0
    rows = [(tmp_path / name / "scalars.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]
    first, second = whole.simulation.snapshot(), job.simulation.snapshot()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_workers_and_batches(precision: str) -> None:
    """1 = 2 = 3 workers, steps in odd parts, and a restored run, to the last bit."""

    def pressed(workers: int) -> Simulation:
        return heap(
            stages=[stage("compress", 0.5, end_volume_fraction=0.3)],
            workers=workers,
            numerics={"precision": precision},
        )

    runs = [pressed(n) for n in (1, 2, 3)]
    for sim in runs:
        sim.step(300)
    parts, again = pressed(1), pressed(1)
    for count in (1, 7, 133, 10):
        parts.step(count)
    again.restore(parts.snapshot())
    again.begin_stage(again.scene.stages[0], resumed=True)
    for sim in (parts, again):
        sim.step(149)
    assert press_of(parts).push.numpy()[0, 1] > 0.0
    first = runs[0].snapshot()
    for other in (*runs[1:], parts, again):
        for name, value in other.snapshot().items():
            assert value.tobytes() == first[name].tobytes(), name
    for sim in (*runs, parts, again):
        sim.close()


def test_a_pressure_never_reached(tmp_path: Path) -> None:
    """The wall stops short of the other one: the run ends with what it waited for, state kept."""
    path = tmp_path / "bed.toml"
    head, _, rest = SCENE.partition("[[stage]]")
    press = '[[stage]]\nkind = "compress"\nwall = "z+"\nspeed = 1.0\nend_pressure = 1e9\n'
    path.write_text(head + press + rest[rest.index("[record]") :])
    keys = {"fibers.0.count": 1, "fibers.0.orientation": "aligned"}
    job = wf.Job.start(wf.load_scene(path, keys), out=tmp_path / "out")
    assert job.run() == 3
    failure = json.loads((tmp_path / "out" / "summary.json").read_text())["failure"]
    assert "stage 'compress'" in failure["message"] and "as far as it can" in failure["message"]
    assert "not met: end_pressure = 1e+09 Pa; it is" in failure["message"]
    with pytest.raises(SceneError, match="as far as it can"):
        Simulation(wf.load_scene(path, keys)).run()
