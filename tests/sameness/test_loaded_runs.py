"""Loaded, held and frozen fibers without inertia: runs that must agree to the last bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.cell import Kind, bent_fiber, place
from warpfiber.scene import scene_from_dict

KINDS = (Kind(3, 3.0, modulus=2000.0), Kind(7, 1.0, modulus=500.0))
RUNS: dict[str, dict[str, Any]] = {
    "sdirk2": {"dt": 0.05},
    "bdf2": {"integrator": "bdf2", "dt": 0.05},
    "tolerance": {"tolerance": 2e-4},
}
LOADS = [
    {"force": [3.0, 0.0, -4.0]},
    {"fiber": 4, "node": 1, "hold": "clamp", "velocity": [0.1, 0.0, 0.2]},
    {"fiber": 7, "node": 2, "hold": "position"},
    {"group": 1, "velocity": [0.0, 0.3, 0.0]},
]


def loaded(name: str, workers: int = 1, loads: list[dict[str, Any]] = LOADS) -> wf.Simulation:
    """Ten free and ten frozen fibers in a sheared box."""
    rng = np.random.default_rng(3)
    which = [0] * 10 + [1] * 10
    fibers = [bent_fiber(KINDS[w], rng, 25.0 * rng.random(3)) for w in which]
    groups = [kind.table(10) for kind in KINDS]
    groups[1]["frozen"] = True
    tables = {
        "box": {"size": [30.0, 26.0, 28.0]},
        "flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0},
        "fibers": groups,
        "contact": {"law": "none"},
        "load": loads,
        "stage": [{"kind": "flow", "end_strain": 2.0}],
        "record": {"frames": 2, "scalars": 10, "figures": False},
        "numerics": {"method": "overdamped", "segments": [3, 7], "device": "cpu", **RUNS[name]},
    }
    scene = scene_from_dict(tables)
    return wf.Simulation(scene, placement=place(fibers, which), workers=workers)


def assert_same(a: wf.Simulation, b: wf.Simulation) -> None:
    """Every array of the state equal to the last bit."""
    first, second = a.snapshot(), b.snapshot()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name


@pytest.mark.parametrize("name", RUNS)
def test_workers_and_restore(name: str) -> None:
    """1 = 2 = 3 workers; a run restored at step 17 = the one without a break."""
    runs = [loaded(name, workers) for workers in (1, 2, 3)]
    for run in runs:
        run.step(40)
    again = loaded(name)
    again.step(17)
    saved = again.snapshot()
    again.close()
    again = loaded(name)
    again.restore(saved)
    again.step(23)
    for other in (*runs[1:], again):
        assert_same(runs[0], other)
    assert np.isfinite(runs[0].node_pos).all()
    for run in (*runs, again):
        run.close()


@pytest.mark.parametrize("name", ["sdirk2", "bdf2"])
def test_others_do_not_feel_a_load(name: str) -> None:
    """Loads on three fibers leave the other seven as they are to the last bit."""
    ends = []
    for loads in (LOADS, [LOADS[0], *LOADS[3:]]):
        run = loaded(name, loads=loads)
        run.step(40)
        ends.append(run.node_pos[: 10 * 4].reshape(10, 4, 3))
        run.close()
    same = [a.tobytes() == b.tobytes() for a, b in zip(*ends, strict=True)]
    assert same == [fiber not in (4, 7) for fiber in range(10)]


SCENE = """
[flow]
kind = "rest"
viscosity = 1.0
[[fibers]]
count = 1
aspect_ratio = 20
diameter = 1e-5
youngs_modulus = 5e6
orientation = "aligned"
[contact]
law = "none"
[[load]]
node = 0
hold = "clamp"
[[load]]
force = [0, 0, 1e-8]
[[stage]]
kind = "flow"
name = "bend"
end_time = 1.0
[[stage]]
kind = "flow"
name = "wait"
end_time = 0.5
[record]
frames = 4
scalars = 30
figures = false
quantities = ["energy", "curvature"]
[numerics]
method = "overdamped"
segments = 19
dt = 0.01
"""


def test_resumed_relaxation(tmp_path: Path) -> None:
    """A fluid at rest, no box: two stages end by time; stopped and resumed the same rows."""
    path = tmp_path / "bend.toml"
    path.write_text(SCENE)
    scene = wf.load_scene(path)
    whole = wf.Job.start(scene, out=tmp_path / "whole")
    assert whole.run() == 0
    assert whole.simulation.time == pytest.approx(1.5, rel=1e-9)
    job = wf.Job.start(scene, out=tmp_path / "parts")

    class Stop:
        """Asks for a stop in the second stage."""

        exit_code = 130

        def __enter__(self) -> Stop:
            return self

        def __exit__(self, *_: object) -> None: ...

        @property
        def reason(self) -> str:
            return "Ctrl-C" if job.simulation.time > 1.1 else ""

    assert job.run(Stop()) == 130
    assert job.simulation.time < 1.45
    assert wf.Job.resume(tmp_path / "parts").run() == 0
    rows = [(tmp_path / name / "scalars.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]
    assert len(rows[0].splitlines()) > 20
