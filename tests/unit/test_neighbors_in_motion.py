"""The neighbor list stays exact while fibers move, up to the limit of its skin and after rebuilds.

At every look the list in use holds all pairs within reach; brute force decides.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber, listed_pairs
from tests.pair_list import SHEAR, Start, brute_force, cell, check_list, random_fibers


@pytest.mark.parametrize(
    ("flow", "steps"),
    [
        ({"kind": "rest", "viscosity": 1.0}, 150),
        (SHEAR, 250),
        ({"kind": "planar_extension", "extension_rate": 1.0, "viscosity": 1.0}, 100),
    ],
)
def test_exact_up_to_the_skin(start: Start, flow: dict[str, Any], steps: int) -> None:
    """At every step the list in use holds every pair within reach, through many rebuilds.

    Stiff fibers of length 16 a rotate against the flow and gravity-free rest moves by start
    velocities; a list one skin test too old would miss pairs.
    """
    kind = Kind(2, 4.0, modulus=3000.0)
    edges = [36.0, 32.0, 40.0]
    fibers, _ = random_fibers((kind,), 60, edges, seed=10, spread=5.0)
    nodes = sum(map(len, fibers))
    velocity = None
    if flow["kind"] == "rest":
        drift = np.random.default_rng(1).normal(size=(len(fibers), 3))
        velocity = np.repeat(30.0 * drift, nodes // len(fibers), axis=0)
    sim = cell(
        start,
        (kind,),
        fibers,
        flow=flow,
        box={"size": edges},
        velocity=velocity,
        numerics={"dt": 2e-3},
        contact={"law": "exponential", "strength": 20.0, "decay": 5.0},
    )
    pairs = sim.method.list
    assert pairs is not None
    seen = 0
    for _ in range(steps):
        sim.step()
        near = brute_force(sim, pairs.reach)
        missing = near - listed_pairs(sim)
        assert not missing, f"step {sim.step_count}: {missing}"
        seen += len(near)
    assert pairs.build_count >= 5
    assert pairs.build_count < steps, "the skin never holds"
    assert seen > 20 * steps


@pytest.mark.parametrize("flow", [SHEAR, {**SHEAR, "kind": "planar_extension"}])
def test_exact_while_the_flow_squeezes(start: Start, flow: dict[str, Any]) -> None:
    """Short fibers go with the flow: only its strain, not their motion beside it, brings them near.

    Pairs of two beads move less than 0.3 a beside the flow while gaps of 2.6 a close to 2 a.
    """
    flow = {key: value for key, value in flow.items() if key != "shear_rate"}
    flow["extension_rate" if flow["kind"] == "planar_extension" else "shear_rate"] = 1.0
    kind = Kind(1, 1.0, density=1e-2, modulus=3000.0)
    rng = np.random.default_rng(15)
    fibers = [bent_fiber(kind, rng, 26.0 * rng.random(3), stretch=0.0) for _ in range(220)]
    sim = cell(
        start,
        (kind,),
        fibers,
        flow=flow,
        box={"size": [26.0] * 3},
        contact={"law": "exponential", "strength": 1e-3, "decay": 1.0},
        numerics={"dt": 1.8e-3},
    )
    pairs = sim.method.list
    for _ in range(80):
        sim.step(5)
        missing = brute_force(sim, pairs.reach) - listed_pairs(sim)
        assert not missing, f"strain {sim.strain}: {missing}"
    assert 3 <= pairs.build_count < 40


def test_stretched_segments(start: Start) -> None:
    """Segments far longer than at rest stay inside the cells: at the start and while they stretch.

    Node velocities pull every segment to about 1.6 rest lengths within 60 steps.
    """
    kind = Kind(2, 4.0, modulus=1e-3)
    fibers, _ = random_fibers((kind,), 40, [42.0] * 3, seed=14, spread=5.0)
    fibers = [nodes.mean(axis=0) + 1.3 * (nodes - nodes.mean(axis=0)) for nodes in fibers]
    velocity = np.concatenate([5.0 * (nodes - nodes.mean(axis=0)) for nodes in fibers])
    sim = cell(
        start,
        (kind,),
        fibers,
        velocity=velocity,
        flow={"kind": "rest", "viscosity": 1e-3},
        numerics={"dt": 1e-3},
        box={"size": [42.0] * 3},
    )
    check_list(sim, least=20)
    pairs = sim.method.list
    for _ in range(12):
        sim.step(5)
        assert not brute_force(sim, pairs.reach) - listed_pairs(sim)
    nodes = sim.node_pos.reshape(-1, 3, 3)
    stretch = np.linalg.norm(np.diff(nodes, axis=1), axis=2) / 8.0
    assert 1.5 < stretch.max() < 2.0
    sim.method.refresh_list()
    check_list(sim, least=20)


def test_cells_grow_with_what_they_hold(start: Start) -> None:
    """A segment that outgrew the cells since the last build, by any length, loses no pair."""
    kind = Kind(1, 4.0)
    fibers, _ = random_fibers((kind,), 120, [42.0] * 3, seed=16)
    sim = cell(start, (kind,), fibers, flow=SHEAR, box={"size": [42.0] * 3})
    pairs = sim.method.list
    for stretch in (1.04, 1.3, 1.9):
        nodes = np.concatenate(fibers).reshape(-1, 2, 3)
        middle = nodes.mean(axis=1, keepdims=True)
        nodes[::7] = (middle + stretch * (nodes - middle))[::7]
        sim.state.node_pos.assign(nodes.reshape(-1, 3).astype(sim.state.node_pos.numpy().dtype))
        sim.method.refresh_list()
        assert pairs.stretch_allowed >= stretch
        check_list(sim, least=20)
    assert sim.method.box_width > 8.0 * 1.9


def test_rebuilt_when_outgrown(start: Start) -> None:
    """Segments that outgrow the cells as they move widen them, and the list holds every pair."""
    kind = Kind(1, 4.0, modulus=1e-3)
    fibers, _ = random_fibers((kind,), 80, [42.0] * 3, seed=15)
    velocity = np.concatenate([5.0 * (nodes - nodes.mean(axis=0)) for nodes in fibers])
    sim = cell(
        start,
        (kind,),
        fibers,
        flow=SHEAR,
        box={"size": [42.0] * 3},
        numerics={"dt": 1e-3},
        velocity=velocity,
    )
    pairs = sim.method.list
    allowed = pairs.stretch_allowed
    while pairs.stretch_allowed == allowed:
        sim.step()
        assert sim.step_count < 200
    assert listed_pairs(sim)
    assert not brute_force(sim, pairs.reach) - listed_pairs(sim)
