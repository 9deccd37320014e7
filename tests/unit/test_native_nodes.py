"""SIMD node sweep against the plain one: the same laws, fibers side by side in lanes.

Bounds: float64 1e-13, float32 16 eps of the largest change; sums are in another order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber
from warpfiber.methods import step_launches
from warpfiber.methods.step_launches import native_node_launch, node_launch, plain_node_launch
from warpfiber.model import BAD_FIBER, EXPIRED, HALT, TORN
from warpfiber.passes.executor import load_kernels
from warpfiber.passes.native_nodes import fiber_blocks
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]

# one segment, few and many, whole and real M; numbers of fibers around the numbers of lanes
KINDS = (
    Kind(1, 4.5),
    Kind(2, 3.3, radius=0.7, density=0.2),
    Kind(4, 2.0),
    Kind(3, 19.0 / 3.0, modulus=400.0),
    Kind(15, 49.0 / 15.0, modulus=30.0),
    Kind(6, 1.0),
)
COUNTS = (37, 8, 16, 33, 20, 1)
GRADIENT = [[0.2, -0.4, 1.0], [0.3, 0.1, 0.7], [-0.5, 0.2, -0.3]]
FLOW = {"kind": "gradient", "gradient": GRADIENT, "viscosity": 1.0, "origin": [0.0, 0.0, 0.0]}
EDGE = 60.0
CONTACT = {"law": "exponential", "strength": 3.0, "decay": 4.0}
BOUND = {"float64": 1e-13, "float32": 16 * np.finfo(np.float32).eps}
SCENES: dict[str, dict[str, Any]] = {
    "alone": {},
    "pairs": {"contact": CONTACT},
    "arms": {"contact": {**CONTACT, "lubrication": "paper"}},
    "layer": {  # decays slowly: nodes are far behind the walls
        "contact": {**CONTACT, "decay": 0.1},
        "box": {"size": [EDGE] * 3, "boundary": ["wall"] * 3},
        "gravity": {"acceleration": [0.3, -0.2, -1.7], "fluid_density": 0.02},
    },
}


def crowd(start: Start, precision: str, closure: str, tables: dict[str, Any]) -> Simulation:
    """All kinds of bent fibers in a small box, moving at random."""
    rng = np.random.default_rng(8)
    which = np.repeat(np.arange(len(KINDS)), COUNTS)
    fibers = [bent_fiber(KINDS[k], rng, EDGE * rng.random(3)) for k in which]
    return start(
        KINDS,
        fibers,
        which,
        velocity=rng.normal(size=(sum(map(len, fibers)), 3)),
        flow={**FLOW, "origin": [EDGE / 2.0] * 3},
        numerics={
            "closure": closure,
            "precision": precision,
            "dt": 0.01,
            "allow_unstable_dt": True,
        },
        **tables,
    )


def sweep(sim: Simulation, make: Callable[..., Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and status after one node sweep; the state is put back."""
    state = sim.state
    arrays = (state.node_pos, state.node_velocity, state.status)
    before = [a.numpy().copy() for a in arrays]
    launch = make(sim.method)
    load_kernels([launch.kernel], "cpu")
    launch.run("cpu")
    after = [a.numpy().copy() for a in arrays]
    for array, values in zip(arrays, before, strict=True):
        array.assign(values)
    return after[0], after[1], after[2]


def assert_equal_sweeps(sim: Simulation, precision: str) -> None:
    velocity = sim.state.node_velocity.numpy().copy()
    plain, native = sweep(sim, plain_node_launch), sweep(sim, native_node_launch)
    change = np.abs(plain[1] - velocity).max()
    assert change > 0.0
    assert np.abs(native[1] - plain[1]).max() < BOUND[precision] * change
    reach = np.abs(plain[0]).max()
    assert np.abs(native[0] - plain[0]).max() < BOUND[precision] * (reach + change)
    np.testing.assert_array_equal(native[2], plain[2])


@pytest.mark.parametrize("precision", BOUND)
@pytest.mark.parametrize("closure", ["none", "consistent"])
@pytest.mark.parametrize("name", SCENES)
def test_same_as_plain(start: Start, precision: str, closure: str, name: str) -> None:
    sim = crowd(start, precision, closure, SCENES[name])
    sim.method.native_nodes = False
    sim.step(2)
    if sim.method.list is not None:
        assert sim.method.pair_acts.numpy()[: sim.method.list.pair_count].any()
    assert node_launch(sim.method).kernel.key == plain_node_launch(sim.method).kernel.key
    assert_equal_sweeps(sim, precision)


@pytest.mark.parametrize("precision", BOUND)
def test_every_joint_angle(start: Start, precision: str) -> None:
    """Angles from 0 to pi - 1e-4 in one block, the stretch the same: the factor of every lane.

    Near pi the couple is theta/sin(theta) times a vector of size sin(theta), known to eps.
    """
    angles = np.array([0.0, 1e-9, 1e-5, 1e-3, 0.1, 0.6, 1.0, 1.5, np.pi / 2, 1.6, 2.0, 2.5])
    angles = np.concatenate([angles, [3.0, 3.1, np.pi - 1e-2, np.pi - 1e-4, 0.64, 0.3]])
    fibers = []
    for k, angle in enumerate(angles):
        heading = np.array([0.0, 0.0, angle, angle])
        steps = 4.0 * np.stack([np.cos(heading), 0.0 * heading, np.sin(heading)], axis=1)
        nodes = np.concatenate([np.zeros((1, 3)), steps.cumsum(axis=0)])
        fibers.append(nodes if precision == "float32" else nodes + 20.0 * k)
    sim = start(
        [Kind(4, 2.0)],
        fibers,
        velocity=np.zeros((5 * len(fibers), 3)),
        numerics={"precision": precision, "dt": 0.01, "allow_unstable_dt": True},
    )
    plain, native = sweep(sim, plain_node_launch), sweep(sim, native_node_launch)
    error = np.abs(native[1] - plain[1]).reshape(len(fibers), -1).max(axis=1)
    scale = np.abs(plain[1]).max()
    eps = np.finfo(precision).eps
    assert (error < 64.0 * eps * scale / np.maximum(np.sin(angles), 1e-3)).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e3])
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("segments", [1, 4])
def test_torn_fiber_keeps_its_state(start: Start, bad: float, last: bool, segments: int) -> None:
    """The other lanes of its block move on; of a padded block, only real lanes count."""
    rng = np.random.default_rng(5)
    kind, count, per_fiber = Kind(segments, 2.0), 11, segments + 1
    fibers = [bent_fiber(kind, rng, [30.0 * k, 0.0, 0.0]) for k in range(count)]
    torn = count - 1 if last else 3
    sim = start([kind], fibers, velocity=rng.normal(size=(per_fiber * count, 3)), flow=FLOW)
    nodes = sim.state.node_pos.numpy().copy()
    nodes[per_fiber * torn + 1, 1] = bad
    sim.state.node_pos.assign(nodes)
    velocity = sim.state.node_velocity.numpy().copy()
    plain, native = sweep(sim, plain_node_launch), sweep(sim, native_node_launch)
    np.testing.assert_array_equal(native[2], plain[2])
    assert native[2][TORN] == 1 and native[2][BAD_FIBER] == torn
    mine = slice(per_fiber * torn, per_fiber * (torn + 1))
    np.testing.assert_array_equal(native[0][mine], nodes[mine])
    np.testing.assert_array_equal(native[1][mine], velocity[mine])
    rest = np.delete(np.arange(per_fiber * count), mine)
    np.testing.assert_allclose(native[0][rest], plain[0][rest], rtol=1e-13, atol=1e-12)
    assert (native[0][rest] != nodes[rest]).any(axis=1).all()


def test_halt_changes_nothing(start: Start) -> None:
    sim = crowd(start, "float64", "consistent", {})
    status = sim.state.status.numpy().copy()
    status[HALT] = 1
    sim.state.status.assign(status)
    before = sim.state.node_pos.numpy().copy()
    after = sweep(sim, native_node_launch)
    np.testing.assert_array_equal(after[0], before)
    np.testing.assert_array_equal(after[2], status)


def test_flag_of_the_list(start: Start) -> None:
    """One fiber of many moved past the skin."""
    rng = np.random.default_rng(6)
    kind, count = Kind(4, 2.0), 13
    fibers = [bent_fiber(kind, rng, [30.0 * k, 0.0, 0.0]) for k in range(count)]
    sim = start([kind], fibers, velocity=np.zeros((5 * count, 3)), contact=CONTACT)
    sim.method.prepare()
    assert not sweep(sim, native_node_launch)[2].any()
    nodes = sim.state.node_pos.numpy().copy()
    nodes[-5:] += [0.0, 2.0, 0.0]
    sim.state.node_pos.assign(nodes)
    plain, native = sweep(sim, plain_node_launch), sweep(sim, native_node_launch)
    assert native[2][EXPIRED] == 1
    np.testing.assert_array_equal(native[2], plain[2])


def test_one_worker_or_two(start: Start) -> None:
    """Blocks are handed out whole: the same bits."""
    states = []
    for workers in (1, 2):
        sim = crowd(start, "float64", "consistent", {"contact": CONTACT, "workers": workers})
        assert "native" in node_launch(sim.method).kernel.key
        sim.step(5)
        states.append(np.concatenate([sim.node_pos, sim.node_velocity]))
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("name", ["alone", "pairs", "arms"])
def test_asking_ahead(start: Start, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """What only large cells do, in a small one: the same bits."""
    sim = crowd(start, "float64", "consistent", SCENES[name])
    sim.step(2)
    expected = sweep(sim, native_node_launch)
    monkeypatch.setattr(step_launches, "PREFETCH_NODES", 0)
    assert native_node_launch(sim.method).inputs[0] == 0
    found = sweep(sim, native_node_launch)
    for got, want in zip(found, expected, strict=True):
        np.testing.assert_array_equal(got, want)


def test_where_it_applies(start: Start) -> None:
    """Few fibers, the published closure and the switch leave the plain sweep."""
    kind = Kind(4, 2.0)
    rng = np.random.default_rng(7)
    for count, closure, expected in ((2, "consistent", False), (8, "consistent", True)):
        fibers = [bent_fiber(kind, rng, [30.0 * k, 0.0, 0.0]) for k in range(count)]
        sim = start([kind], fibers, numerics={"closure": closure})
        assert ("native" in node_launch(sim.method).kernel.key) is expected
    sim.method.native_nodes = False
    assert "native" not in node_launch(sim.method).kernel.key
    sim = start([kind], fibers, numerics={"closure": "paper"})
    assert "native" not in node_launch(sim.method).kernel.key


def test_blocks_hold_one_group() -> None:
    groups = np.array([0, 1, 0, 0, 1, 0, 0, 2])
    fibers, own = fiber_blocks(groups, 4)
    assert fibers.tolist() == [[0, 2, 3, 5], [6, 6, 6, 6], [1, 4, 4, 4], [7, 7, 7, 7]]
    assert own.tolist() == [4, 1, 2, 1]
