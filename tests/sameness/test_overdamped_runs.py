"""Fibers without inertia: runs that must agree to the last bit, or but for rounding."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.cell import Kind, bent_fiber
from warpfiber.simulation import Diverged, Simulation

Start = Callable[..., Simulation]
KINDS = (Kind(3, 3.0, modulus=2000.0), Kind(7, 1.0, modulus=500.0, radius=0.8))
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
RUNS: dict[str, dict[str, Any]] = {
    "sdirk2": {"dt": 0.05},
    "bdf2": {"integrator": "bdf2", "dt": 0.05},
    "tolerance": {"tolerance": 2e-5},
}
BOX = {"size": [30.0, 26.0, 28.0]}


def fibers() -> tuple[list[np.ndarray], list[int]]:
    """30 bent fibers of two kinds in turn."""
    rng = np.random.default_rng(11)
    which = [k % 2 for k in range(30)]
    centers = rng.random((30, 3)) * BOX["size"]
    return [bent_fiber(KINDS[w], rng, c) for w, c in zip(which, centers, strict=True)], which


def crowd(start: Start, name: str, order: list[int] | None = None, **keys: Any) -> Simulation:
    """The fibers in a sheared periodic box or none, in the given order within each kind."""
    nodes, which = fibers()
    order = order if order is not None else sorted(range(30), key=lambda f: which[f])
    numerics = {"method": "overdamped", **RUNS[name]}
    box = {"box": BOX} if keys.pop("boxed", True) else {}
    return start(
        KINDS,
        [nodes[f] for f in order],
        [which[f] for f in order],
        numerics=numerics,
        flow=SHEAR,
        **box,
        **keys,
    )


def assert_same(a: Simulation, b: Simulation) -> None:
    """Every array of the state equal to the last bit."""
    first, second = a.snapshot(), b.snapshot()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name


@pytest.mark.parametrize("name", RUNS)
def test_workers_and_batches(start: Start, name: str) -> None:
    """1 = 2 = 3 workers; steps one by one and in odd parts."""
    runs = [crowd(start, name, workers=n) for n in (1, 2, 3)]
    for sim in runs:
        sim.step(60)
        assert sim.method.executor.workers == sim.method.workers
    single = crowd(start, name)
    for count in (1, 1, 7, 33, 17, 1):
        single.step(count)
    for other in (*runs[1:], single):
        assert_same(runs[0], other)
    assert np.isfinite(runs[0].node_pos).all()


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("at", [1, 2, 31])
def test_restore(start: Start, name: str, at: int) -> None:
    """Snapshot, restore into a new simulation, go on: the same as the run without a break."""
    run = crowd(start, name)
    run.step(at)
    saved = run.snapshot()
    run.step(60 - at)
    again = crowd(start, name)
    again.restore(saved)
    again.step(60 - at)
    assert_same(run, again)


def test_a_start_is_restored(start: Start) -> None:
    """A snapshot before the first step still has the start of BDF2 before it."""
    run, again = crowd(start, "bdf2"), crowd(start, "bdf2")
    again.step(3)
    again.restore(run.snapshot())
    run.step(5)
    again.step(5)
    assert_same(run, again)


SCENE = """
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
count = 1
aspect_ratio = 20
diameter = 1e-5
youngs_modulus = 5e7
orientation = "aligned"
direction = [1, 0.2, 0.3]
[contact]
law = "none"
[[stage]]
kind = "flow"
end_strain = 20
[record]
frames = 4
scalars = 20
figures = false
quantities = ["orientation", "energy", "axial_strain", "curvature", "rotation"]
[numerics]
method = "overdamped"
segments = 19
"""


@pytest.mark.parametrize(
    "keys", [{}, {"numerics.integrator": "bdf2"}, {"numerics.tolerance": 1e-4}]
)
def test_resumed_job(tmp_path: Path, keys: dict[str, object]) -> None:
    """A run stopped by Ctrl-C and resumed writes the rows of the run without a stop."""
    path = tmp_path / "one.toml"
    path.write_text(SCENE)
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
            return "Ctrl-C" if job.simulation.strain > 7.3 else ""

    assert job.run(Stop()) == 130
    assert job.simulation.strain < 19.0
    assert wf.Job.resume(tmp_path / "parts").run() == 0
    rows = [(tmp_path / name / "scalars.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]
    head = rows[0].partition("\n")[0]
    assert "energy_bending" in head and "energy_kinetic" not in head


@pytest.mark.parametrize("name", RUNS)
def test_turned_axes(start: Start, name: str) -> None:
    """x, y, z renamed: the same motion but for rounding."""
    gradient = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    axes = [2, 0, 1]  # new axis of x, y, z
    renamed = np.zeros((3, 3))
    renamed[np.ix_(axes, axes)] = gradient
    nodes, which = fibers()
    ends = []
    for matrix, move in ((gradient, [0, 1, 2]), (renamed, [1, 2, 0])):
        sim = start(
            KINDS[:1],
            [nodes[f][:, move] for f in range(30) if which[f] == 0],
            [0] * 15,
            flow={"kind": "gradient", "viscosity": 1.0, "gradient": matrix.tolist()},
            numerics={"method": "overdamped", **RUNS[name]},
        )
        sim.step(40)
        ends.append(sim.node_pos)
    assert np.abs(ends[0][:, [1, 2, 0]] - ends[1]).max() < 1e-10


@pytest.mark.parametrize("name", ["sdirk2", "bdf2"])
def test_renumbered_fibers(start: Start, name: str) -> None:
    """No fiber knows of the others: in another order each moves the same to the last bit."""
    _, which = fibers()
    plain = sorted(range(30), key=lambda f: which[f])
    mixed = sorted(range(30), key=lambda f: (which[f], (7 * f) % 30))
    found = []
    for order in (plain, mixed):
        sim = crowd(start, name, order)
        sim.step(40)
        begin = sim.fiber_node_start
        mine = {f: sim.node_pos[begin[k] : begin[k + 1]] for k, f in enumerate(order)}
        found.append(mine)
    for f in plain:
        assert found[0][f].tobytes() == found[1][f].tobytes()


def test_box_only_counts(start: Start) -> None:
    """Without pairs the fibers move as without a box; the lattice follows the flow."""
    boxed = crowd(start, "sdirk2")
    free = crowd(start, "sdirk2", boxed=False)
    for sim in (boxed, free):
        sim.step(40)
    shift = 14.0 * boxed.strain  # the flow is at rest in the center of the box, else at 0
    moved = free.node_pos - [shift, 0.0, 0.0]
    assert np.abs(boxed.node_pos - moved).max() < 1e-11
    assert boxed.lattice is not None and free.lattice is None
    assert boxed.lattice[0, 2] == pytest.approx(28.0 * boxed.strain, rel=1e-12)


@pytest.mark.parametrize("name", RUNS)
def test_torn_fiber(start: Start, name: str) -> None:
    """A fiber that is not finite stops the run, is named, and its neighbors stay as they are."""
    sim = crowd(start, name)
    sim.step(5)
    nodes = sim.state.node_pos.numpy()
    first = sim.fiber_node_start[4]
    nodes[first + 1] = np.nan
    sim.state.node_pos.assign(nodes)
    with pytest.raises(Diverged) as found:
        sim.step(200)
    assert found.value.report["fiber"] == 4
    assert "fiber 4 is torn at node" in found.value.report["message"]
    assert "largest term" in found.value.report["message"]
    begin = sim.fiber_node_start
    others = np.ones(len(nodes), dtype=bool)
    others[begin[4] : begin[5]] = False
    assert np.isfinite(sim.node_pos[others]).all()
