"""The native pair sweep against the plain one on the same list.

Both do the same operations in the same order. A compiler may fuse them differently, so the bound is
20 eps of the largest force (a few ulp of G0 (D/2a - 1) in the exponent) instead of equal bits;
which pairs act must agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.cell import Array, Kind, bent_fiber, isotropic, straight_fiber
from warpfiber.methods import bead_chain, step_launches
from warpfiber.methods.step_launches import pair_launch
from warpfiber.model import HALT, PAIR_COUNT
from warpfiber.passes.executor import Launch, load_kernels
from warpfiber.passes.native_pairs import BLOCK, native_chunks
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
EDGE = 26.0
CONTACT = {"law": "exponential", "strength": 10.0, "decay": 4.0}
KINDS = (Kind(3, 3.0), Kind(4, 2.0, radius=0.6, density=0.3))
CHAINS = (Kind(12, 1.0), Kind(3, 4.0))  # one bead and four beads per segment, equal radii
UNEVEN = (Kind(3, 3.4), Kind(2, 1.3, radius=0.6, density=0.3))
BOX = {"box": {"size": [EDGE] * 3}}
SHEAR = {"flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}}
CELLS: dict[str, dict[str, Any]] = {"open": {}, "periodic": BOX, "sheared": BOX | SHEAR}
UNTOUCHED = 7


def crowd(kinds: tuple[Kind, ...], seed: int, count: int) -> dict[str, Any]:
    """Fibers dropped at random; every fourth lies almost along one direction (0 to 0.2 rad)."""
    rng = np.random.default_rng(seed)
    which = np.arange(count) % len(kinds)
    fibers: list[Array] = []
    for place, k in enumerate(which):
        center = EDGE * rng.random(3)
        if place % 4 > 0:
            fibers.append(bent_fiber(kinds[k], rng, center, spread=1.0))
            continue
        tilt = rng.choice([0.0, 1e-7, 1e-3, 0.2]) * isotropic(rng, 1)[0]
        fibers.append(straight_fiber(kinds[k], np.array([1.0, 0.0, 0.0]) + tilt, center))
    nodes = sum(map(len, fibers))
    return {
        "kinds": kinds,
        "fibers": fibers,
        "fiber_kind": which,
        "velocity": rng.normal(size=(nodes, 3)),
    }


def listed(
    start: Start,
    fibers: dict[str, Any],
    lubrication: str = "none",
    precision: str = "float64",
    **keys: Any,
) -> Simulation:
    """Simulation with a built list that has not moved."""
    contact = CONTACT | {"lubrication": lubrication}
    numerics = {"dt": 1e-3, "allow_unstable_dt": True, "precision": precision}
    sim = start(**fibers, contact=contact, numerics=numerics, **keys)
    if "flow" in keys:
        lattice = EDGE * np.array([[1.0, 0.0, 0.31], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        sim.state.lattice.assign((lattice / sim.model.units.length)[None])
    sim.method.prepare()
    sim.state.lattice_now.assign(sim.state.lattice.numpy().astype(sim.model.precision.numpy))
    return sim


def launch_of(sim: Simulation, native: bool) -> Launch:
    """The pair launch, vectorized or not."""
    kept, sim.method.native = sim.method.native, native
    launch = pair_launch(sim.method)
    sim.method.native = kept
    load_kernels([launch.kernel], "cpu")
    return launch


def results(sim: Simulation, launch: Launch, workers: int = 1) -> dict[str, np.ndarray]:
    """What the launch writes: for pairs that act, and nothing of the others."""
    chain = sim.method
    names = ["pair_force", "pair_closest", "pair_arm_i", "pair_arm_j"]
    if chain.pair_features.storage == "arms":
        names.remove("pair_closest")
    else:
        names = names[:2]
    chain.pair_acts.fill_(UNTOUCHED)
    for name in names:
        getattr(chain, name).fill_(np.nan)
    for worker in range(workers):
        launch.run("cpu", worker, workers)
    acts = chain.pair_acts.numpy().copy()
    found = {"acts": acts}
    for name in names:
        values = getattr(chain, name).numpy().copy()
        assert np.isnan(values[acts != 1]).all(), name
        found[name] = np.where((acts == 1)[:, None], values, 0.0)
    return found


def assert_alike(sim: Simulation, least: int) -> None:
    """Native = plain, with at least `least` acting pairs."""
    plain = results(sim, launch_of(sim, native=False))
    native = results(sim, launch_of(sim, native=True))
    assert sim.method.native
    np.testing.assert_array_equal(plain["acts"], native["acts"])
    count = sim.method.list.pair_count
    assert set(plain["acts"][count:]) <= {UNTOUCHED}
    assert (plain["acts"] == 1).sum() >= least
    eps = np.finfo(sim.model.precision.numpy).eps
    for name in set(plain) - {"acts"}:
        bound = 20.0 * eps * np.abs(plain[name]).max()
        assert np.abs(plain[name] - native[name]).max() <= bound, name


@pytest.mark.parametrize(
    ("cell", "lubrication", "precision"),
    [
        ("open", "none", "float64"),
        ("periodic", "none", "float32"),
        ("sheared", "none", "float64"),
        ("open", "paper", "float32"),
        ("periodic", "paper", "float64"),
        ("sheared", "paper", "float64"),
        ("periodic", "shifted", "float64"),
        ("sheared", "shifted", "float32"),
    ],
)
def test_random_cells(start: Start, cell: str, lubrication: str, precision: str) -> None:
    """Two kinds of fibers with unequal radii."""
    fibers = crowd(KINDS, seed=21, count=60)
    sim = listed(start, fibers, lubrication, precision, **CELLS[cell])
    assert_alike(sim, least=40)


@pytest.mark.parametrize("kinds", [CHAINS, UNEVEN, KINDS[:1]], ids=["chains", "uneven", "alike"])
@pytest.mark.parametrize("repulsion", [True, False], ids=["both", "lubrication"])
def test_beads(start: Start, kinds: tuple[Kind, ...], repulsion: bool) -> None:
    """Numbers of beads per segment, imaginary beads that stand for more, lubrication alone."""
    sim = listed(start, crowd(kinds, seed=22, count=50), "paper", **BOX)
    sim.method.pair_features = replace(sim.method.pair_features, repulsion=repulsion)
    assert_alike(sim, least=40)


@pytest.mark.parametrize("lubrication", ["none", "paper"])
def test_named_cases(start: Start, lubrication: str) -> None:
    """Parallel, collinear, crossing at nodes, through each other, coincident, end on side."""
    kind = Kind(2, 4.0)
    x, y, z = np.eye(3)
    rods = [
        straight_fiber(kind, x, (0, 0, 0)),
        straight_fiber(kind, x, (3, 1.9, 0)),
        straight_fiber(kind, x, (0, 60, 0)),
        straight_fiber(kind, x, (17.9, 60, 0)),
        straight_fiber(kind, x, (0, 120, 0)),
        straight_fiber(kind, y, (0, 120, 1.8)),
        straight_fiber(kind, x, (0, 180, 0)),
        straight_fiber(kind, y + z, (3, 180.1, 0.05)),
        straight_fiber(kind, x, (0, 240, 0)),
        straight_fiber(kind, z, (5, 240.3, 9.7)),
        straight_fiber(kind, x, (0, 300, 0)),
        straight_fiber(kind, y, (0, 300, 0)),
        straight_fiber(kind, x, (0, 360, 0)),
        straight_fiber(kind, x, (0, 360, 0)),
    ]
    rng = np.random.default_rng(3)
    fibers = {
        "kinds": (kind,),
        "fibers": rods,
        "fiber_kind": [0] * len(rods),
        "velocity": rng.normal(size=(3 * len(rods), 3)),
    }
    assert_alike(listed(start, fibers, lubrication), least=10)


@pytest.mark.parametrize("lubrication", ["none", "paper"])
@pytest.mark.parametrize("count", [0, 1, 7, 8, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK - 5])
def test_pair_counts(start: Start, count: int, lubrication: str) -> None:
    """Any number of pairs: those listed are those of the whole list, nothing behind is written."""
    sim = listed(start, crowd(KINDS, seed=23, count=120), lubrication, **BOX)
    launch = launch_of(sim, native=True)
    whole = results(sim, launch)
    assert sim.method.list.pair_count > 3 * BLOCK
    status = sim.state.status.numpy().copy()
    status[PAIR_COUNT] = count
    sim.state.status.assign(status)
    for name, values in results(sim, launch).items():
        np.testing.assert_array_equal(values[:count], whole[name][:count])
        assert set(np.unique(values[count:])) <= {UNTOUCHED if name == "acts" else 0.0}


@pytest.mark.parametrize("lubrication", ["none", "shifted"])
def test_asking_ahead(start: Start, monkeypatch: pytest.MonkeyPatch, lubrication: str) -> None:
    """What only large cells do, in a small one: the same bits."""
    sim = listed(start, crowd(KINDS, seed=27, count=120), lubrication, **BOX)
    assert sim.method.list.pair_count > 6 * BLOCK
    expected = results(sim, launch_of(sim, native=True))
    monkeypatch.setattr(step_launches, "PREFETCH_NODES", 0)
    launch = launch_of(sim, native=True)
    assert launch.inputs[1] == 0
    for name, values in results(sim, launch).items():
        np.testing.assert_array_equal(values, expected[name])


@pytest.mark.parametrize("lubrication", ["none", "shifted"])
def test_workers(start: Start, lubrication: str) -> None:
    """1, 2 and 5 workers: the same bits."""
    sim = listed(start, crowd(KINDS, seed=24, count=150), lubrication, **BOX)
    launch = launch_of(sim, native=True)
    assert launch.dim == native_chunks(sim.model.segment_count) > 5
    one = results(sim, launch)
    for workers in (2, 5):
        for name, values in results(sim, launch, workers).items():
            np.testing.assert_array_equal(values, one[name])


def test_halted(start: Start) -> None:
    """A halted step writes nothing."""
    sim = listed(start, crowd(KINDS, seed=25, count=40), "paper", **BOX)
    launch = launch_of(sim, native=True)
    status = sim.state.status.numpy().copy()
    status[HALT] = 1
    sim.state.status.assign(status)
    assert set(results(sim, launch)["acts"]) == {UNTOUCHED}


def test_whole_run(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """40 steps in a sheared cell with and without vectors: the same to 1e-10 of the box."""
    ends = []
    for native in (True, False):
        monkeypatch.setattr(bead_chain, "NATIVE", native)
        numerics = {"dt": 1e-3, "allow_unstable_dt": True}
        contact = CONTACT | {"lubrication": "paper"}
        fibers = crowd(KINDS, seed=26, count=40)
        sim = start(**fibers, contact=contact, numerics=numerics, **BOX, **SHEAR)
        sim.step(40)
        assert sim.method.native is native
        ends.append(sim.node_pos)
    assert np.isfinite(ends[0]).all()
    assert np.abs(ends[0] - ends[1]).max() < 1e-10 * EDGE
