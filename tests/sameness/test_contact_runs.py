"""Fibers that meet: runs that must agree to the last bit, to the tolerance, or but for rounding."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.meeting_cell import EDGES, HARD, LAYER, METHODS, Meeting, rejected
from warpfiber.placement import Placement
from warpfiber.simulation import Simulation

# Some contacts are on the verge of opening: what differs by the tolerance may grow by this much
# over the few steps that runs are compared for.
GROWTH = 100.0
SOLVED = 1e-9


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


RUNS: dict[str, dict[str, Any]] = {
    "hard": {},
    "walls": {"box": LAYER},
    "lubrication": {
        "contact": HARD | {"lubrication": "paper"},
        "box": {"size": [30.0, 30.0, 30.0]},
    },
    "again": {"numerics": {"linearizations": 2}},
    "penalty": {
        "contact": {"law": "linear", "stiffness": 300.0},
        "numerics": {"contact": "penalty"},
    },
    "float32": {"numerics": {"precision": "float32"}},
    "tolerance": {"numerics": {"dt": None, "tolerance": 1e-5}},
    "too large steps": {
        "count": 75,
        "box": {"size": [32.0, 32.0, 32.0]},
        "numerics": {"dt": 0.5, "allow_unstable_dt": True},
    },
}


def assert_same(a: Simulation, b: Simulation) -> None:
    """Every array of the state equal to the last bit."""
    first, second = a.snapshot(), b.snapshot()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("method", METHODS)
def test_workers_and_batches(meeting: Meeting, method: str, name: str) -> None:
    """1 = 2 workers; steps one by one and in odd parts; lists are built on the way."""
    runs = [meeting(method, workers=n, **RUNS[name]) for n in (1, 2, 1)]
    for sim in runs[:2]:
        sim.step(50)
    for count in (1, 1, 7, 23, 17, 1):
        runs[2].step(count)
    assert runs[0].method.list is not None and runs[0].method.list.build_count > 1
    for other in runs[1:]:
        assert_same(runs[0], other)
    assert np.isfinite(runs[0].node_pos).all()
    assert name != "too large steps" or rejected(runs[0]) > 0


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("method", METHODS)
def test_restore(meeting: Meeting, method: str, name: str) -> None:
    """Snapshot, restore into a new simulation, go on: the same as the run without a break."""
    run = meeting(method, **RUNS[name])
    run.step(17)
    saved = run.snapshot()
    run.step(23)
    again = meeting(method, **RUNS[name])
    again.restore(saved)
    again.step(23)
    assert_same(run, again)
    run.restore(saved)
    run.step(23)
    assert_same(run, again)


def test_restore_after_halved_steps(meeting: Meeting) -> None:
    """Every state on the way, sizes of steps and rejected ones included."""
    keys = RUNS["too large steps"]
    run = meeting("rigid_rod", **keys)
    states = []
    for _ in range(30):
        run.step()
        states.append(run.snapshot())
    sizes = {float(state["implicit_step_size"][0]) for state in states}
    assert len(sizes) > 1
    again = meeting("rigid_rod", **keys)
    for state, following in zip(states[:-1], states[1:], strict=True):
        again.restore(state)
        again.step()
        for name, value in again.snapshot().items():
            if not name.startswith(("list_", "skin", "stretch")):
                assert value.tobytes() == following[name].tobytes(), name


SCENE = """
[box]
size = [1.3e-4, 1.2e-4, 1.25e-4]
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
count = 40
aspect_ratio = 10
diameter = 1e-5
youngs_modulus = 5e7
[contact]
[[stage]]
kind = "flow"
end_strain = 3
[record]
frames = 4
scalars = 20
figures = false
quantities = ["orientation", "contacts", "overlap", "interactions"]
[numerics]
method = "overdamped"
segments = 3
dt = 2e-3
"""


@pytest.mark.parametrize("method", METHODS)
def test_resumed_job(tmp_path: Path, method: str) -> None:
    """A run stopped by Ctrl-C and resumed writes the rows of the run without a stop."""
    path = tmp_path / "one.toml"
    path.write_text(SCENE)
    segments = 1 if method == "rigid_rod" else 3
    keys: dict[str, object] = {"numerics.method": method, "numerics.segments": segments}
    keys |= {"record.layers": 3, "record.quantities": ["orientation", "contacts", "stress"]}
    scene = wf.load_scene(path, keys)
    whole = wf.Job.start(scene, out=tmp_path / "whole")
    assert whole.run() == 0
    job = wf.Job.start(scene, out=tmp_path / "parts")

    class Stop:
        """Asks for a stop after the first rows."""

        exit_code = 130

        def __enter__(self) -> Stop:
            return self

        def __exit__(self, *_: object) -> None: ...

        @property
        def reason(self) -> str:
            return "Ctrl-C" if job.simulation.strain > 1.1 else ""

    assert job.run(Stop()) == 130
    assert job.simulation.strain < 2.9
    assert wf.Job.resume(tmp_path / "parts").run() == 0
    for file in ("scalars.csv", "layers.csv"):
        rows = [(tmp_path / name / file).read_text() for name in ("whole", "parts")]
        assert rows[0] == rows[1]


# -- the same cell in other words -----------------------------------------------------------------

TIGHT = {"contact_tolerance": SOLVED}
STEPS = 8


def end_of(sim: Simulation) -> np.ndarray:
    """Displacement of every node since the start."""
    start = sim.node_pos
    sim.step(STEPS)
    moved: np.ndarray = sim.node_pos - start
    return moved


@pytest.mark.parametrize("method", METHODS)
def test_renumbered_fibers(meeting: Meeting, method: str) -> None:
    """Other numbers, another order of rows: the same motion to the tolerance."""
    sim = meeting(method, 40, numerics=TIGHT)
    nodes = sim.node_pos.reshape(40, -1, 3)
    order = np.random.default_rng(3).permutation(40)
    other = meeting(method, 40, numerics=TIGHT, placement=placed(nodes[order]))
    first = end_of(sim).reshape(nodes.shape)
    second = end_of(other).reshape(nodes.shape)
    assert np.abs(first[order] - second).max() < GROWTH * SOLVED


def placed(nodes: np.ndarray) -> Placement:
    """Fibers (F, n, 3) of one kind."""
    count, per = nodes.shape[:2]
    start = np.arange(count + 1, dtype=np.int32) * per
    return Placement(nodes.reshape(-1, 3), start, np.zeros(count, dtype=np.int32))


@pytest.mark.parametrize("method", METHODS)
def test_moved_through_the_box(meeting: Meeting, method: str) -> None:
    """All fibers moved along flow and vorticity: other images, the same motion."""
    sim = meeting(method, 40, numerics=TIGHT)
    nodes = sim.node_pos.reshape(40, -1, 3)
    shift = np.array([0.37 * EDGES[0], 0.61 * EDGES[1], 0.0])
    other = meeting(method, 40, numerics=TIGHT, placement=placed(nodes + shift))
    assert np.abs(end_of(sim) - end_of(other)).max() < GROWTH * SOLVED


@pytest.mark.parametrize("method", METHODS)
def test_renamed_axes(meeting: Meeting, method: str) -> None:
    """x, y, z named y, z, x: the same motion to the tolerance."""
    gradient = np.zeros((3, 3))
    gradient[0, 2] = 1.0
    move = [2, 0, 1]  # the component that becomes x, y, z
    renamed = gradient[np.ix_(move, move)]
    flows = [
        {"kind": "gradient", "viscosity": 1.0, "gradient": matrix.tolist()}
        for matrix in (gradient, renamed)
    ]
    sim = meeting(method, 40, numerics=TIGHT, flow=flows[0])
    nodes = sim.node_pos.reshape(40, -1, 3)[:, :, move]
    box = {"size": [EDGES[k] for k in move]}
    other = meeting(method, 40, numerics=TIGHT, flow=flows[1], box=box, placement=placed(nodes))
    assert np.abs(end_of(sim)[:, move] - end_of(other)).max() < GROWTH * SOLVED


@pytest.mark.parametrize("method", METHODS)
def test_single_precision(meeting: Meeting, method: str) -> None:
    """The same contacts to the tolerance of the solver, which rounding is below."""
    runs = [meeting(method, 40, numerics={"precision": p}) for p in ("float64", "float32")]
    ends = [end_of(sim) for sim in runs]
    moved = np.abs(ends[0]).max()
    assert moved > 0.1
    # float32 knows positions to 26 * 6e-8 and gaps no better; contacts are solved to 1e-3
    assert np.median(np.abs(ends[1] - ends[0])) < 1e-4
    assert np.abs(ends[1] - ends[0]).max() < 20.0 * 1e-3


@pytest.mark.parametrize("method", METHODS)
def test_a_smaller_tolerance_changes_no_more_than_the_tolerance(
    meeting: Meeting, method: str
) -> None:
    runs = [
        end_of(meeting(method, 40, numerics={"contact_tolerance": t})) for t in (1e-4, 5e-5, SOLVED)
    ]
    for tolerance, found in zip((1e-4, 5e-5), runs, strict=False):
        assert np.abs(found - runs[2]).max() < GROWTH * tolerance
        assert np.median(np.abs(found - runs[2])) < tolerance
