"""Rigid rods: runs that must agree to the last bit, or but for rounding."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.cell import Kind, isotropic, straight_fiber
from warpfiber.simulation import Diverged, Simulation

Start = Callable[..., Simulation]
KINDS = (Kind(1, 9.0, density=2.0), Kind(1, 4.3, radius=0.8))
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
RUNS: dict[str, dict[str, Any]] = {
    "shear": {"flow": SHEAR},
    "single": {"flow": SHEAR, "numerics": {"precision": "float32"}},
    "scheduled": {"flow": SHEAR | {"schedule": [[0.0, 0.5], [3.0, 2.0]]}},
    "extension": {"flow": {"kind": "planar_extension", "extension_rate": 1.0, "viscosity": 1.0}},
    "sinking": {"flow": SHEAR, "gravity": {}},
}
SIZE = np.array([30.0, 26.0, 28.0])


def crowd(start: Start, name: str, order: list[int] | None = None, **keys: Any) -> Simulation:
    """30 rods of two kinds in a sheared periodic box or none, in `order` within each kind."""
    rng = np.random.default_rng(11)
    which = [k % 2 for k in range(30)]
    axis, center = isotropic(rng, 30), rng.random((30, 3)) * SIZE
    order = order if order is not None else sorted(range(30), key=lambda f: which[f])
    tables = dict(RUNS[name])
    numerics = {"method": "rigid_rod", "dt": 0.05} | tables.pop("numerics", {})
    box = {"box": {"size": SIZE.tolist()}} if keys.pop("boxed", True) else {}
    return start(
        KINDS,
        [straight_fiber(KINDS[which[f]], axis[f], center[f]) for f in order],
        [which[f] for f in order],
        numerics=numerics,
        **tables,
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
@pytest.mark.parametrize("at", [0, 1, 31])
def test_restore(start: Start, name: str, at: int) -> None:
    """Snapshot, restore into another simulation, go on: the same as the run without a break."""
    run = crowd(start, name)
    run.step(at)
    saved = run.snapshot()
    run.step(60 - at)
    again = crowd(start, name)
    again.step(3)
    again.restore(saved)
    again.step(60 - at)
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
youngs_modulus = 5e9
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
method = "rigid_rod"
"""


@pytest.mark.parametrize("keys", [{}, {"numerics.method": "auto"}])
def test_resumed_job(tmp_path: Path, keys: dict[str, object]) -> None:
    """A run stopped by Ctrl-C and resumed writes the rows of the run without a stop."""
    path = tmp_path / "one.toml"
    path.write_text(SCENE)
    scene = wf.load_scene(path, keys)
    assert scene.numerics.method == "rigid_rod"
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
    resumed = wf.Job.resume(tmp_path / "parts")
    assert resumed.scene.method_reason == scene.method_reason
    assert resumed.run() == 0
    rows = [(tmp_path / name / "scalars.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]


def test_renumbered_rods(start: Start) -> None:
    """No rod knows of the others: in another order each moves the same to the last bit."""
    plain = sorted(range(30), key=lambda f: f % 2)
    mixed = sorted(range(30), key=lambda f: (f % 2, (7 * f) % 30))
    found = []
    for order in (plain, mixed):
        sim = crowd(start, "shear", order)
        sim.step(40)
        ends = sim.node_pos.reshape(30, 2, 3)
        found.append({f: ends[k] for k, f in enumerate(order)})
    for f in plain:
        assert found[0][f].tobytes() == found[1][f].tobytes()


def test_box_only_counts(start: Start) -> None:
    """Without pairs rods move as without a box; the lattice follows the flow."""
    boxed, free = crowd(start, "shear"), crowd(start, "shear", boxed=False)
    for sim in (boxed, free):
        sim.step(40)
    shift = 14.0 * boxed.strain  # the flow is at rest in the center of the box, else at 0
    assert np.abs(boxed.node_pos - (free.node_pos - [shift, 0.0, 0.0])).max() < 1e-11
    assert boxed.lattice is not None and free.lattice is None
    assert boxed.lattice[0, 2] == pytest.approx(28.0 * boxed.strain, rel=1e-12)


def test_torn_rod(start: Start) -> None:
    """A rod that is not finite stops the run and is named; the others stay as they are."""
    sim = crowd(start, "shear")
    sim.step(5)
    nodes = sim.state.node_pos.numpy()
    nodes[9] = np.nan
    sim.state.node_pos.assign(nodes)
    with pytest.raises(Diverged, match="fiber 4 is torn at node") as found:
        sim.step(200)
    assert found.value.report["fiber"] == 4
    assert sim.step_count == 6
    others = np.ones(len(nodes), dtype=bool)
    others[8:10] = False
    assert np.isfinite(sim.node_pos[others]).all()
