"""Runs that must agree to the last bit: workers, batches of steps, snapshot and restore."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber, fiber_between, listed_pairs
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
KINDS = (Kind(3, 3.0, modulus=2000.0), Kind(4, 1.0, modulus=2000.0, radius=0.8))
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
WALLS: dict[str, Any] = {
    "box": {"size": [30.0, 30.0, 30.0], "boundary": ["periodic", "periodic", "wall"]},
    "contact": {"law": "exponential", "strength": 50.0, "decay": 4.0, "lubrication": "paper"},
}
LEES_EDWARDS: dict[str, Any] = {
    "box": {"size": [30.0, 26.0, 28.0]},
    "contact": {"law": "exponential", "strength": 50.0, "decay": 4.0, "lubrication": "paper"},
}
# 100 steps reach a strain of 0.4: the start is sheared by 0.4 boxes, so that the lattice is reset
CELLS = {"walls": WALLS, "Lees-Edwards": LEES_EDWARDS}


def crowd(start: Start, cell: dict[str, Any], **keys: Any) -> Simulation:
    """48 overlapping bent fibers of two kinds."""
    rng = np.random.default_rng(30)
    size = np.array(cell["box"]["size"])
    which = np.arange(48) % 2
    low = 0.03 * size  # 0.9 a from the walls: some fibers touch them
    fibers = [fiber_between(KINDS[k], rng, low, size - low) for k in which]
    sim = start(KINDS, fibers, which, flow=SHEAR, numerics={"dt": 4e-3}, **cell, **keys)
    if cell is LEES_EDWARDS:
        lattice = np.diag(size)
        lattice[0, 2] = 0.4 * size[0]
        sim.state.lattice.assign(lattice[None])
    return sim


def bits(sim: Simulation) -> dict[str, np.ndarray]:
    return sim.snapshot()


def assert_same(a: Simulation, b: Simulation) -> None:
    """Every array of the state, and the list, equal to the last bit."""
    first, second = bits(a), bits(b)
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name
    assert listed_pairs(a) == listed_pairs(b)
    for x, y in zip(a.method.list.host_pairs(), b.method.list.host_pairs(), strict=True):
        assert x.tobytes() == y.tobytes()


@pytest.mark.parametrize("name", CELLS)
def test_workers(start: Start, name: str) -> None:
    """1 worker = 2 workers = 3 workers over 200 steps with list rebuilds."""
    runs = [crowd(start, CELLS[name], workers=n) for n in (1, 2, 3)]
    for sim in runs:
        sim.step(200)
        assert sim.method.workers == sim.method.executor.workers
    assert runs[0].method.list.build_count > 5
    assert_same(runs[0], runs[1])
    assert_same(runs[0], runs[2])
    assert np.isfinite(runs[0].node_pos).all()


@pytest.mark.parametrize("name", CELLS)
def test_batches(start: Start, name: str) -> None:
    """Steps one by one, all at once, and in odd parts: the same."""
    single, whole, parts = (crowd(start, CELLS[name]) for _ in range(3))
    for _ in range(100):
        single.step()
    whole.step(100)
    for count in (7, 33, 17, 1, 42):
        parts.step(count)
    assert_same(single, whole)
    assert_same(single, parts)


def test_captured_batches_without_pairs(start: Start) -> None:
    """A small scene replays 16 steps per graph: the same as single steps."""
    rng = np.random.default_rng(1)
    fibers = [bent_fiber(KINDS[0], rng, (20.0 * k, 0, 0)) for k in range(3)]
    runs = [start(KINDS[:1], fibers, flow=SHEAR, numerics={"dt": 4e-3}) for _ in range(2)]
    assert runs[0].method.list is None
    runs[0].step(100)
    for _ in range(100):
        runs[1].step()
    assert runs[0].method.executor.batches
    for name, value in bits(runs[0]).items():
        assert value.tobytes() == bits(runs[1])[name].tobytes(), name


def test_measuring_changes_nothing(start: Start) -> None:
    """Measurements and snapshots only read."""
    quantities = ["orientation", "contacts", "interactions", "overlap", "energy"]
    quiet = crowd(start, WALLS, quantities=quantities)
    watched = crowd(start, WALLS, quantities=quantities)
    quiet.step(60)
    for _ in range(12):
        watched.step(5)
        watched.measure()
        watched.snapshot()
    assert_same(quiet, watched)


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize("at", [1, 10, 37, 90])
def test_restore(start: Start, name: str, at: int) -> None:
    """Snapshot, restore into a new simulation, go on: the same as the run without a break.

    The snapshots fall between list builds, so the list must be that of the older positions.
    """
    run = crowd(start, CELLS[name])
    run.step(at)
    saved = run.snapshot()
    run.step(100 - at)
    again = crowd(start, CELLS[name])
    again.restore(saved)
    assert again.step_count == at
    again.step(100 - at)
    assert_same(run, again)


@pytest.mark.parametrize("name", CELLS)
def test_restore_while_the_skin_changes(start: Start, name: str) -> None:
    """The choice of the skin goes on from what it knew: same skins, builds and trajectory."""
    run, slow = crowd(start, CELLS[name]), 0
    first = run.method.list.skin
    for at in (23, 61, 104):
        run.step(at - slow)
        slow = at
        saved = run.snapshot()
        again = crowd(start, CELLS[name], workers=2)
        again.restore(saved)
        whole = crowd(start, CELLS[name])
        for sim in (again, whole):
            sim.step(150 - sim.step_count)
        assert_same(again, whole)
        assert again.method.list.skin == whole.method.list.skin
        assert whole.method.list.skin != first
        assert whole.method.skin.saved().tobytes() == again.method.skin.saved().tobytes()


@pytest.mark.parametrize("name", CELLS)
def test_rewind(start: Start, name: str) -> None:
    """The same simulation, set back to an older snapshot, repeats itself."""
    sim = crowd(start, CELLS[name])
    sim.step(15)
    saved = sim.snapshot()
    sim.step(60)
    first = bits(sim)
    sim.restore(saved)
    sim.step(60)
    for key, value in bits(sim).items():
        assert value.tobytes() == first[key].tobytes(), key


def test_measure_after_restore(start: Start) -> None:
    """All measured quantities of a restored run equal those before, at once."""
    quantities = ["orientation", "contacts", "interactions", "overlap", "energy", "rotation"]
    run = crowd(start, LEES_EDWARDS, quantities=quantities)
    run.step(20)
    run.measure()
    saved = run.snapshot()
    again = crowd(start, LEES_EDWARDS, quantities=quantities)
    again.restore(saved)
    assert run.measure() == again.measure()


def test_restore_after_fibers_spread(start: Start) -> None:
    """Without a box a continued run begins with fibers elsewhere; long segments are cut alike."""
    kinds = (Kind(1, 40.0, modulus=2000.0), Kind(1, 1.0, modulus=2000.0))
    which = [0] * 6 + [1] * 300
    rng = np.random.default_rng(5)
    fibers = [bent_fiber(kinds[k], rng, 60.0 * rng.random(3)) for k in which]
    far = [nodes + 3.0 * nodes.mean(axis=0) for nodes in fibers]
    contact = {"law": "exponential", "strength": 1.0, "decay": 2.0}
    numerics = {"dt": 4e-3}
    run, again = (
        start(kinds, some, which, flow=SHEAR, contact=contact, numerics=numerics)
        for some in (fibers, far)
    )
    assert run.method.list.piece_count > run.model.segment_count
    assert run.method.list.piece_count == again.method.list.piece_count
    run.step(20)
    again.restore(run.snapshot())
    for sim in (run, again):
        sim.step(100)
    assert_same(run, again)


def test_restore_keeps_what_the_box_bears(start: Start) -> None:
    """A box that was looked at with a thin skin ends at the same strain when restored."""
    rod = Kind(2, 4.0, modulus=2000.0)

    def begin() -> Simulation:
        rng = np.random.default_rng(3)
        fibers = [bent_fiber(rod, rng, 8.0 + 10.0 * rng.random(3)) for _ in range(4)]
        return start(
            [rod],
            fibers,
            flow={"kind": "planar_extension", "extension_rate": 1.0, "viscosity": 1.0},
            box={"size": [26.0] * 3},
            contact={"law": "exponential", "strength": 1.0, "decay": 2.0},
        )

    run = begin()
    run.step(1)
    thin, pairs = run.method.skin.least, run.method.list
    run.method.search.set_skin(thin)
    run.method.search.set_stretch(1.2 * pairs.stretch_allowed)
    run.method.refresh_list()
    again = begin()
    again.restore(run.snapshot())
    assert again.method.list.skin == pairs.skin == thin
    assert again.method.strain_end == run.method.strain_end
    assert_same(run, again)


def test_restore_of_stretched_fibers(start: Start) -> None:
    """Soft fibers outgrow the cells of the list; the restored run must rebuild when the run did."""
    soft = Kind(3, 3.0, modulus=60.0)
    size = np.array(LEES_EDWARDS["box"]["size"])

    def begin() -> Simulation:
        rng = np.random.default_rng(30)
        fibers = [fiber_between(soft, rng, 0.03 * size, 0.97 * size) for _ in range(40)]
        return start([soft], fibers, flow=SHEAR, numerics={"dt": 4e-3}, **LEES_EDWARDS)

    run = begin()
    allowed = run.method.list.stretch_allowed
    while run.method.list.stretch_allowed == allowed:
        run.step(20)
        assert run.step_count < 1000
    saved = run.snapshot()
    run.step(100)
    again = begin()
    again.restore(saved)
    again.step(100)
    assert_same(run, again)
