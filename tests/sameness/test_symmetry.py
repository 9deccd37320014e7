"""The same physics seen otherwise: turned, renumbered, shifted, single precision, other boxes.

Differences start at rounding (1e-16 of the coordinates) and grow with the run; the runs are a few
dozen steps of cells whose forces amplify a difference less than 1e4 times: bound 1e-10.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, fiber_between, straight_fiber
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
KINDS = (Kind(3, 3.0, modulus=2000.0), Kind(4, 1.5, modulus=2000.0, radius=0.8))
CONTACT = {"law": "exponential", "strength": 50.0, "decay": 4.0, "lubrication": "paper"}
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
DT = {"dt": 2e-3}
CUBE = 28.0
GENERAL = np.array([[0.2, -0.4, 1.0], [0.3, 0.1, 0.7], [-0.5, 0.2, -0.3]])


def crowd(count: int = 30, seed: int = 40) -> tuple[list[np.ndarray], np.ndarray]:
    """Overlapping fibers of two kinds in the cube, along z all of them inside."""
    rng = np.random.default_rng(seed)
    which = np.arange(count) % 2
    fibers = [fiber_between(KINDS[k], rng, [0.9] * 3, [CUBE - 0.9] * 3) for k in which]
    return fibers, which


def flow_of(gradient: np.ndarray) -> dict[str, Any]:
    return {"kind": "gradient", "gradient": gradient.tolist(), "viscosity": 1.0}


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    n = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@pytest.mark.parametrize("closure", ["paper", "consistent"])
@pytest.mark.parametrize(("axis", "angle"), [((0, 1, 0), np.pi / 2), ((1, 2, -1), 1.1)])
def test_turned(start: Start, closure: str, axis: Any, angle: float) -> None:
    """Fibers, flow and gravity turned together: the run is turned, 1e-10 over 40 steps."""
    turn = rotation(axis, angle)
    fibers, which = crowd()
    gravity = np.array([0.0, 3.0, -9.0])
    ends = []
    for matrix in (np.eye(3), turn):
        sim = start(
            KINDS,
            [nodes @ matrix.T for nodes in fibers],
            which,
            flow=flow_of(matrix @ GENERAL @ matrix.T),
            gravity={"acceleration": (matrix @ gravity).tolist()},
            contact=CONTACT,
            numerics={"closure": closure, **DT},
        )
        begin = sim.node_pos
        sim.step(40)
        assert np.abs(sim.node_pos - begin).max() > 0.5
        ends.append(sim.node_pos @ matrix)
    assert np.abs(ends[1] - ends[0]).max() < 1e-10


@pytest.mark.parametrize("cycle", [1, 2])
def test_axes_of_a_sheared_box(start: Start, cycle: int) -> None:
    """Flow along y with its gradient along x, and so on: the same cell with its axes renamed.

    The lattice starts 0.45 boxes sheared and is reset within the 60 steps.
    """
    fibers, which = crowd()
    edges = np.array([CUBE, 24.0, 26.0])
    plain = np.zeros((3, 3))
    plain[0, 2] = 1.0
    ends = []
    for shift in (0, cycle):
        order = np.roll(np.eye(3), shift, axis=0)
        sim = start(
            KINDS,
            [nodes @ order.T for nodes in fibers],
            which,
            flow=flow_of(order @ plain @ order.T),
            box={"size": (order @ edges).tolist()},
            contact=CONTACT,
            numerics=DT,
        )
        lattice = np.diag(edges)
        lattice[0, 2] = 0.45 * edges[0]
        sim.state.lattice.assign((order @ lattice @ order.T)[None] / sim.model.units.length)
        sim.step(60)
        now = order.T @ sim.lattice @ order
        assert now[0, 2] < 0.0
        ends.append(sim.node_pos @ order)
    assert np.abs(ends[1] - ends[0]).max() < 1e-10


def test_renumbered(start: Start) -> None:
    """Fibers in another order, nodes from the other end: the same motion, 1e-10 over 40 steps."""
    fibers, which = crowd()
    order = np.random.default_rng(1).permutation(len(fibers))
    keys: dict[str, Any] = {
        "flow": SHEAR,
        "box": {"size": [CUBE] * 3},
        "contact": CONTACT,
        "numerics": DT,
    }
    plain = start(KINDS, fibers, which, **keys)
    mixed = start(KINDS, [fibers[f][::-1] for f in order], which[order], **keys)
    plain.step(40)
    mixed.step(40)
    a, b = plain.node_pos, mixed.node_pos
    begins, others = plain.fiber_node_start, mixed.fiber_node_start
    for k, f in enumerate(order):
        nodes = a[begins[f] : begins[f + 1]]
        assert np.abs(b[others[k] : others[k + 1]][::-1] - nodes).max() < 1e-10


@pytest.mark.parametrize("boundary", [["periodic"] * 3, ["periodic", "periodic", "wall"]])
def test_shifted_through_the_box(start: Start, boundary: list[str]) -> None:
    """All fibers moved by a part of the box, and some by whole boxes: the same motion.

    Along z of the sheared box a shift by b adds the velocity b to every node of the run, so the
    flow's origin moves along. 1e-10 over 40 steps.
    """
    fibers, which = crowd()
    shift = np.array([0.37 * CUBE, -0.71 * CUBE, 0.0 if "wall" in boundary else 0.43 * CUBE])
    rng = np.random.default_rng(2)
    boxes = CUBE * rng.integers(-2, 3, size=(len(fibers), 3)) * np.array([1.0, 1.0, 0.0])
    center = np.full(3, 0.5 * CUBE)
    ends = []
    for move, turns in ((0.0 * shift, 0.0 * boxes), (shift, boxes)):
        moved = [nodes + move + by for nodes, by in zip(fibers, turns, strict=True)]
        sim = start(
            KINDS,
            moved,
            which,
            flow={**SHEAR, "origin": (center + move).tolist()},
            box={"size": [CUBE] * 3, "boundary": boundary},
            contact=CONTACT,
            numerics=DT,
        )
        sim.step(40)
        counts = [len(nodes) for nodes in fibers]
        ends.append(sim.node_pos - move - np.repeat(turns, counts, axis=0))
    assert np.abs(ends[1] - ends[0]).max() < 1e-10


def test_single_precision(start: Start) -> None:
    """float32 follows float64: 40 steps of rounding at |x| <= 30, forces as above.

    Step by step a position loses eps |x|; 40 steps at random and a growth of at most 30 give
    30 sqrt(40) 1.2e-7 30 = 7e-4. It must also be worse than 1e-7.
    """
    fibers, which = crowd()
    ends = []
    for name in ("float64", "float32"):
        sim = start(
            KINDS,
            fibers,
            which,
            flow=SHEAR,
            box={"size": [CUBE] * 3},
            contact=CONTACT,
            numerics={"precision": name, **DT},
        )
        sim.step(40)
        assert sim.state.node_pos.numpy().dtype == np.dtype(name)
        ends.append(sim.node_pos)
    error = np.abs(ends[1] - ends[0]).max()
    assert 1e-7 < error < 7e-4


def test_alone_in_a_sheared_box(start: Start) -> None:
    """One fiber that leaves through the z face goes on as if there were no box.

    It starts near the upper face, turns through it and is carried many boxes along x; its unwrapped
    motion is that of the same fiber without a box. Bound 1e-9: rounding at |x| of 300 a, and every
    wrap changes the velocity by the flow's difference between the images.
    """
    kind = Kind(3, 3.0, modulus=2000.0)
    nodes = straight_fiber(kind, (1.0, 0.4, 1.0), (5.0, 6.0, 37.0))
    origin = [20.0, 20.0, 20.0]
    keys: dict[str, Any] = {"flow": {**SHEAR, "origin": origin}, "numerics": {"dt": 4e-3}}
    boxed = start([kind], [nodes], box={"size": [40.0] * 3}, contact=CONTACT, **keys)
    free = start([kind], [nodes], **keys)
    crossed = set()
    for _ in range(40):
        boxed.step(100)
        free.step(100)
        assert np.abs(boxed.node_pos - free.node_pos).max() < 1e-9
        crossed.add(tuple(boxed.state.fiber_image.numpy()[0]))
    assert np.abs(free.node_pos).max() > 250.0
    assert len(crossed) > 3


def test_pair_across_the_sheared_face(start: Start) -> None:
    """Two fibers that touch through the z face move as the same two side by side without a box.

    The second is stored one box below, where the flow is one box height slower: its velocity and
    its offset must be those of the image. 1e-10 over 200 steps, the lattice sheared by 0.8 boxes.
    """
    kind = Kind(3, 3.0, modulus=2000.0)
    edge = 60.0
    first = straight_fiber(kind, (1.0, 0.2, 0.1), (30.0, 30.0, 59.2))
    second = straight_fiber(kind, (-0.2, 1.0, 0.0), (31.0, 30.0, 61.0))
    keys: dict[str, Any] = {
        "flow": {**SHEAR, "origin": [30.0, 30.0, 60.0]},
        "contact": CONTACT,
        "numerics": {"dt": 4e-3},
    }
    below = second - np.array([0.0, 0.0, edge])
    boxed = start([kind], [first, below], box={"size": [edge] * 3}, **keys)
    free = start([kind], [first, second], **keys)
    boxed.step(200)
    free.step(200)
    alone = start([kind], [first, second], **{**keys, "contact": {"law": "none"}})
    alone.step(200)
    assert np.abs(free.node_pos - alone.node_pos).max() > 0.1, "they do not touch"
    moved = np.zeros((8, 3))
    # the image in the box above is ahead by the shear of the lattice since the start
    moved[4:] = (boxed.strain * edge, 0.0, edge)
    assert np.abs(boxed.node_pos + moved - free.node_pos).max() < 1e-10
