"""Fibers that are poured: when and from where they fall, what waits, and runs to the last bit."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from warpfiber.methods.pour import Pour
from warpfiber.scene import Fault, Scene, SceneError, scene_from_dict
from warpfiber.simulation import Simulation

RADIUS, HEIGHT, GRAVITY = 1.2e-3, 0.08, 9.81
FIBERS = {
    "count": 12,
    "length": 0.012,
    "diameter": 2.0 * RADIUS,
    "density": 1340,
    "youngs_modulus": 7.5e5,
    "bond_damping": 0.0335,
}
POUR = {"kind": "pour", "interval": 0.01, "damping": 0.0, "end_time": 0.3}


def scene(poured: dict[str, Any] | None = None, **tables: Any) -> Scene:
    """Fibers poured into a small box."""
    made = {
        "seed": 4,
        "box": {"size": [0.02, 0.02, HEIGHT], "boundary": ["periodic", "periodic", "wall"]},
        "gravity": {},
        "fibers": [FIBERS | tables.pop("fibers", {})],
        "contact": {"damping": 0.113, "friction": 0.3, "wall_friction": 0.6},
        "stage": [POUR | (poured or {})],
        "record": {"quantities": ["stress", "contacts", "orientation", "energy"]},
        "numerics": {"method": "bonded_spheres", "segments": 4, "device": "cpu"},
    }
    return scene_from_dict(made | tables)


def pour_of(sim: Simulation) -> Pour:
    """What is poured in a simulation."""
    pour = sim.method.bed.pour  # type: ignore[attr-defined]
    assert isinstance(pour, Pour)
    return pour


def fibers(sim: Simulation) -> list[np.ndarray]:
    """Nodes of every fiber, m."""
    return np.split(sim.node_pos, sim.fiber_node_start[1:-1])


@pytest.mark.parametrize(("interval", "batch"), [(0.01, 1), (0.02, 3)])
def test_when_fibers_fall(interval: float, batch: int) -> None:
    """The k-th batch falls from the top at k intervals; what waits hangs above the box."""
    wide = {"size": [0.1, 0.1, HEIGHT], "boundary": ["periodic", "periodic", "wall"]}
    sim = Simulation(scene({"interval": interval, "batch": batch}, box=wide))
    assert min(nodes[:, 2].min() for nodes in fibers(sim)) > HEIGHT
    placed = fibers(sim)
    sim.run(time=2.4 * interval)
    poured = 3 * batch
    assert pour_of(sim).count == poured
    for k, nodes in enumerate(fibers(sim)):
        if k >= poured:
            assert (nodes == placed[k]).all()
            continue
        steps = sim.step_count - math.ceil(k // batch * interval / sim.dt - 1e-6)
        # from rest: half a step of it without weight in the first kick
        fallen = 0.5 * GRAVITY * steps * (steps - 1) * sim.dt**2
        top = HEIGHT - RADIUS * (1.0 + 1e-3) - fallen
        assert nodes[:, 2].max() == pytest.approx(top, rel=1e-9)
        assert nodes[:, :2] == pytest.approx(placed[k][:, :2], abs=1e-12)
        assert np.diff(nodes[:, 2]) == pytest.approx(np.diff(placed[k][:, 2]), abs=1e-12)


def test_what_waits_does_not_count() -> None:
    """Means are of the poured fibers; walls and weight feel those alone."""
    sim = Simulation(scene({"interval": 0.45, "end_time": 6.0, "damping": 30.0}))
    sim.run(time=0.89)
    count = pour_of(sim).count
    assert count == 2
    row, mine = sim.measure(), fibers(sim)[:count]
    chords = np.concatenate([np.diff(nodes, axis=0) for nodes in mine])
    sizes = np.linalg.norm(chords, axis=1)
    a33 = float((chords[:, 2] ** 2 / sizes).sum() / sizes.sum())
    assert row["a33"] == pytest.approx(a33, rel=1e-9)
    ends = np.stack([nodes[-1] - nodes[0] for nodes in mine])
    ends /= np.linalg.norm(ends, axis=1)[:, None]
    assert row["a33_fiber"] == pytest.approx(float((ends[:, 2] ** 2).mean()), rel=1e-9)
    volume = math.pi * RADIUS**2 * (0.012 - 2.0 * RADIUS + 4.0 / 3.0 * RADIUS)
    assert row["volume_fraction"] == pytest.approx(count * volume / (0.02**2 * HEIGHT), rel=1e-9)
    assert row["pressure_high"] == 0.0
    weight = count * volume * 1340.0 * GRAVITY / 0.02**2
    assert row["pressure_low"] == pytest.approx(weight, rel=0.02)


def test_no_fiber_falls_into_another() -> None:
    """Without an interval each waits until its place is free: contacts stay as shallow as ever."""
    sim = Simulation(scene({"interval": 0.0, "damping": 5.0}))
    sim.step(1)
    first = pour_of(sim).count
    assert 0 < first < 12
    deepest, counts = 0.0, [first]
    quantities = {"record": {"quantities": ["overlap"]}}
    sim = Simulation(scene({"interval": 0.0, "damping": 5.0}, **quantities))
    while pour_of(sim).waits:
        sim.step(16)
        if pour_of(sim).count > counts[-1]:
            counts.append(pour_of(sim).count)
        deepest = max(deepest, sim.measure()["overlap_max"])
    assert len(counts) > 2 and sim.time < 0.2
    # 1 m/s at most, at which a fiber of 12 mm is stopped within less than a third of its radius
    assert deepest < 0.33


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_workers_parts_and_resume(precision: str) -> None:
    """1 = 2 workers, steps in odd parts and a restored run, to the last bit."""
    numerics = {"method": "bonded_spheres", "segments": 4, "device": "cpu", "precision": precision}
    poured = scene({"interval": 3e-3}, numerics=numerics)
    runs = [Simulation(poured, workers=n) for n in (1, 2)]
    for sim in runs:
        sim.step(1800)
    parts, again = Simulation(poured, workers=1), Simulation(poured, workers=1)
    for count in (1, 7, 142, 300):
        parts.step(count)
    assert 1 < pour_of(parts).count < 12
    again.restore(parts.snapshot())
    again.begin_stage(again.scene.stages[0], resumed=True)
    for sim in (parts, again):
        sim.step(1350)
    first = runs[0].snapshot()
    assert 3 < pour_of(runs[0]).count < 12
    for other in (runs[1], parts, again):
        for name, value in other.snapshot().items():
            assert value.tobytes() == first[name].tobytes(), name
    for sim in (*runs, parts, again):
        sim.close()


def test_the_shape_is_that_of_the_placement() -> None:
    """In float32, too: what hung far above the box is as long and as straight as it was placed."""
    numerics = {"method": "bonded_spheres", "segments": 4, "device": "cpu", "precision": "float32"}
    sim = Simulation(scene({"interval": 0.0}, numerics=numerics))
    sim.step(1)
    place = sim.method.place.numpy()[:5] * sim.model.units.length  # type: ignore[attr-defined]
    length = np.linalg.norm(np.diff(place, axis=0), axis=1)
    # one step of weight, and float32 of the placed nodes
    assert length == pytest.approx((0.012 - 2.0 * RADIUS) / 4.0, rel=5e-6)


SCENE = """
seed = 4
[box]
size = [0.02, 0.02, 0.08]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 12
length = 0.012
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
bond_damping = 0.0335
[contact]
damping = 0.113
friction = 0.3
wall_friction = 0.6
[[stage]]
kind = "pour"
interval = 0.02
damping = 20
end_speed = 0.05
time_limit = 2
save = true
[[stage]]
kind = "compress"
wall = "z+"
speed = 0.3
end_volume_fraction = 0.3
[record]
figures = false
scalars = 1000
frames = 3
quantities = ["stress", "energy"]
[numerics]
method = "bonded_spheres"
segments = 4
"""


def test_poured_then_pressed(tmp_path: Path) -> None:
    """All fall and come to rest; the wall comes back; a stop amid the pouring leaves no trace."""
    path = tmp_path / "bed.toml"
    path.write_text(SCENE)
    poured = wf.load_scene(path)
    whole = wf.Job.start(poured, out=tmp_path / "whole")
    assert whole.run() == 0
    log = (tmp_path / "whole" / "log.txt").read_text()
    end = float(log.split("stage 'pour' ended at time ")[1].split()[0])
    assert end > 11 * 0.02
    assert whole.simulation.node_pos[:, 2].max() < HEIGHT
    job = wf.Job.start(poured, out=tmp_path / "parts")

    class Stop:
        """Asks for a stop amid the pouring."""

        exit_code = 130

        def __enter__(self) -> Stop:
            return self

        def __exit__(self, *_: object) -> None: ...

        @property
        def reason(self) -> str:
            return "Ctrl-C" if job.simulation.time > 0.09 else ""

    assert job.run(Stop()) == 130
    assert wf.Job.resume(tmp_path / "parts").run() == 0
    rows = [(tmp_path / name / "scalars.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]
    head, _, press = SCENE.partition("[[stage]]")[2].partition("[[stage]]")
    rest = SCENE[SCENE.index("[contact]") : SCENE.index("[[stage]]")]
    path.write_text('[start]\nfrom = "whole"\n' + rest + "[gravity]\n[[stage]]" + press)
    assert 'kind = "pour"' in head
    text = path.read_text().replace("segments = 4", "")
    path.write_text(text)
    pressed = wf.Job.start(wf.load_scene(path), out=tmp_path / "pressed")
    assert pressed.run() == 0
    first, second = whole.simulation.snapshot(), pressed.simulation.snapshot()
    for name, value in second.items():
        assert value.tobytes() == first[name].tobytes(), name


def test_not_all_poured(tmp_path: Path) -> None:
    """Past the limit, and at an end that comes too early: exit code 3 with how many were poured."""
    path = tmp_path / "bed.toml"
    path.write_text(SCENE)
    job = wf.Job.start(wf.load_scene(path, {"stage.0.time_limit": 0.05}), out=tmp_path / "out")
    assert job.run() == 3
    failure = json.loads((tmp_path / "out" / "summary.json").read_text())["failure"]
    assert "within 0.05 s: 3 of 12 fibers are poured" in failure["message"]
    keys = {"stage.0.end_time": 1e-3, "stage.0.interval": 0.0}
    job = wf.Job.start(wf.load_scene(path, keys), out=tmp_path / "early")
    assert job.run() == 3
    failure = json.loads((tmp_path / "early" / "summary.json").read_text())["failure"]
    assert "of 12 fibers were poured until then; pour longer" in failure["message"]


REFUSED: list[tuple[dict[str, Any], dict[str, Any], str, str]] = [
    ({"end_time": 0.11}, {}, "stage.0.end_time", "poured at 0.11 s; give more"),
    ({"end_pressure": 10.0}, {}, "stage.0.end_pressure", "end_speed or end_time"),
    ({"end_strain": 1.0}, {}, "stage.0.end_strain", "end_speed or end_time"),
    ({"batch": 0}, {}, "stage.0.batch", ">= 1"),
    ({}, {"gravity": {"acceleration": [0, 0, 9.81]}}, "stage.0.kind", "nothing makes the fibers"),
    (
        {},
        {"stage": [{"kind": "settle", "end_time": 1.0}, POUR]},
        "stage.1.kind",
        "pour in the first stage",
    ),
]


@pytest.mark.parametrize(("stage", "changes", "key", "advice"), REFUSED)
def test_what_is_refused(
    stage: dict[str, Any], changes: dict[str, Any], key: str, advice: str
) -> None:
    """One fault, of the key that is wrong, with a remedy."""
    with pytest.raises(SceneError) as caught:
        scene(stage, **changes)
    found: list[Fault] = list(caught.value.faults)
    assert [fault.key for fault in found] == [key], [str(fault) for fault in found]
    assert advice in str(found[0])


def test_a_bottom_is_needed() -> None:
    """A periodic height is refused."""
    box = {"size": [0.02] * 3, "boundary": ["periodic"] * 3}
    with pytest.raises(SceneError, match="fibers fall through a periodic box"):
        scene(box=box, record={"quantities": ["contacts"]})
