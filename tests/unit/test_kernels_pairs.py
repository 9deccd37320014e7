"""Pair sweep and gather against the NumPy restatement: repulsion and lubrication on the nodes.

The pair part of the node forces is the force of a step with contact minus that of the same step
without (closure `none` keeps node forces as they are). Fibers are rods and bent chains of two radii
dropped at random, so that many overlap, some deeply; D0 = 10, G0 = 4 keep forces below 10 e^4.
Tolerance: closest points of nearly parallel segments are known to eps / sin^2, forces to G0 times
that: 1e-9 of the largest force.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber, straight_fiber
from tests.reference import bead_chain as bc
from tests.reference import interactions as ia
from warpfiber.simulation import Simulation

KINDS = (Kind(3, 3.0), Kind(4, 2.0, radius=0.6, density=0.3))
REAL_KINDS = (Kind(3, 3.4), Kind(2, 1.3, radius=0.6, density=0.3))
STRENGTH, DECAY, DT = 10.0, 4.0, 1e-3
EDGE = 26.0
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0, "origin": [0.0, 0.0, 0.0]}
Start = Callable[..., Simulation]


def drop(kinds: tuple[Kind, ...], seed: int, count: int = 40) -> dict[str, Any]:
    """`count` fibers of alternating kind with random centers in the cube and node velocities."""
    rng = np.random.default_rng(seed)
    which = np.arange(count) % len(kinds)
    fibers = [bent_fiber(kinds[k], rng, EDGE * rng.random(3), spread=1.0) for k in which]
    nodes = sum(map(len, fibers))
    return {
        "kinds": kinds,
        "fibers": fibers,
        "fiber_kind": which,
        "velocity": rng.normal(size=(nodes, 3)),
    }


def node_forces(
    start: Start, drop: dict[str, Any], lattice: np.ndarray | None = None, **tables: Any
) -> np.ndarray:
    """F^ND of the first step, SI."""
    numerics = {"closure": "none", "dt": DT, "allow_unstable_dt": True}
    numerics.update(tables.pop("numerics", {}))
    sim = start(**drop, numerics=numerics, **tables)
    if lattice is not None:
        sim.state.lattice.assign((lattice / sim.model.units.length)[None])
    sim.method.native_nodes = False  # the SIMD sweep keeps the forces to itself
    sim.step()
    return sim.state.node_force.numpy().astype(float) * sim.model.units.force


def pair_forces(
    start: Start,
    drop: dict[str, Any],
    lubrication: str = "none",
    step: str = "limited",
    lattice: np.ndarray | None = None,
    **tables: Any,
) -> np.ndarray:
    """Node forces of contact alone."""
    contact = {
        "law": "exponential",
        "strength": STRENGTH,
        "decay": DECAY,
        "lubrication": lubrication,
    }
    numerics = {"lubrication_step": step, **tables.pop("numerics", {})}
    with_contact = node_forces(start, drop, lattice, contact=contact, numerics=numerics, **tables)
    return with_contact - node_forces(start, drop, lattice, **tables)


def system_of(drop: dict[str, Any], **keys: Any) -> ia.System:
    kinds = [drop["kinds"][k] for k in drop["fiber_kind"]]
    return ia.make_system(
        np.concatenate(drop["fibers"]),
        np.cumsum([0] + [len(f) for f in drop["fibers"]]),
        node_vel=drop["velocity"],
        radius=np.array([k.radius for k in kinds]),
        spacing=np.array([k.spacing for k in kinds]),
        bead_mass=np.array([k.chain().mass for k in kinds]),
        **keys,
    )


def expected_forces(system: ia.System, lubrication: str, step: str) -> tuple[np.ndarray, int, int]:
    """Reference forces, and how many repelling pairs and bead pairs they come from."""
    repulsion = ia.repulsion(system, STRENGTH, DECAY)
    if lubrication == "none":
        return repulsion.force, len(repulsion.pairs), 0
    # the package limits over twice the step, so that a bead may have four near partners
    limit = 2.0 * DT if step == "limited" else None
    squeeze = ia.lubrication(system, 1.0, lubrication, limit)
    return repulsion.force + squeeze.force, len(repulsion.pairs), squeeze.bead_pairs


CASES = [
    ("none", "limited", KINDS),
    ("paper", "explicit", KINDS),
    ("paper", "explicit", REAL_KINDS),
    ("paper", "limited", KINDS),
    ("paper", "limited", REAL_KINDS),
    ("shifted", "limited", KINDS),
]


@pytest.mark.parametrize(("lubrication", "step", "kinds"), CASES)
def test_open_cell(start: Start, lubrication: str, step: str, kinds: tuple[Kind, ...]) -> None:
    """Equal to the reference; sum of forces and of moments zero to rounding (1e-12 of the sums)."""
    fibers = drop(kinds, seed=11)
    got = pair_forces(start, fibers, lubrication, step)
    expected, touching, beads = expected_forces(system_of(fibers), lubrication, step)
    assert touching >= 10, touching
    assert beads >= 40 or lubrication == "none"
    assert np.abs(got - expected).max() < 1e-9 * np.abs(expected).max()
    nodes = np.concatenate(fibers["fibers"])
    moment = np.cross(nodes, got)
    assert np.abs(got.sum(axis=0)).max() < 1e-12 * np.abs(got).sum()
    assert np.abs(moment.sum(axis=0)).max() < 1e-12 * np.abs(moment).sum()


@pytest.mark.parametrize("lubrication", ["none", "paper"])
def test_periodic_cell(start: Start, lubrication: str) -> None:
    """Fibers that stick out of the box meet images of others; the reference takes any image."""
    fibers = drop(KINDS, seed=12)
    got = pair_forces(start, fibers, lubrication, "limited", box={"size": [EDGE] * 3})
    lattice = EDGE * np.eye(3)
    expected, touching, _ = expected_forces(
        system_of(fibers, lattice=lattice), lubrication, "limited"
    )
    inside, _, _ = expected_forces(system_of(fibers), lubrication, "limited")
    assert np.abs(expected - inside).max() > 1.0, "no image acts"
    assert np.abs(got - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(got.sum(axis=0)).max() < 1e-12 * np.abs(got).sum()


@pytest.mark.parametrize("offset", [0.31, 0.5, -2.2])
def test_sheared_cell(start: Start, offset: float) -> None:
    """Lattice sheared by any amount: images move with the flow (a z-image at rate x its height)."""
    fibers = drop(KINDS, seed=13)
    lattice = EDGE * np.array([[1.0, 0.0, offset], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    keys = {"flow": SHEAR, "box": {"size": [EDGE] * 3}}
    got = pair_forces(start, fibers, "paper", "limited", lattice, **keys)
    gradient = bc.shear_gradient(1.0)
    system = system_of(fibers, lattice=lattice, gradient=gradient)
    expected, _, _ = expected_forces(system, "paper", "limited")
    still, _, _ = expected_forces(system_of(fibers, lattice=lattice), "paper", "limited")
    assert np.abs(expected - still).max() > 1.0, "no image moves"
    # subtracting spin and drag terms of the flow costs a few more digits than at rest
    assert np.abs(got - expected).max() < 1e-9 * np.abs(expected).max()


def test_parallel_and_crossing_rods(start: Start) -> None:
    """Named cases: exactly parallel, collinear, crossing at nodes, through each other, end on side.

    Parallel rods have no unique closest points; both codings clamp the first parameter first and
    so report the same three contacts of the four nodes that face each other.
    """
    kind = Kind(2, 4.0)
    rods = [
        straight_fiber(kind, (1, 0, 0), (0, 0, 0)),
        straight_fiber(kind, (1, 0, 0), (3, 1.9, 0)),  # parallel, shifted along itself
        straight_fiber(kind, (1, 0, 0), (0, 60, 0)),
        straight_fiber(kind, (1, 0, 0), (17.9, 60, 0)),  # collinear, tips overlap
        straight_fiber(kind, (1, 0, 0), (0, 120, 0)),
        straight_fiber(kind, (0, 1, 0), (0, 120, 1.8)),  # both middle nodes at the crossing
        straight_fiber(kind, (1, 0, 0), (0, 180, 0)),
        straight_fiber(kind, (0, 1, 1), (3, 180.1, 0.05)),  # almost through each other
        straight_fiber(kind, (1, 0, 0), (0, 240, 0)),
        straight_fiber(kind, (0, 0, 1), (5, 240.3, 9.7)),  # an end on a side
    ]
    nodes = sum(map(len, rods))
    fibers = {
        "kinds": (kind,),
        "fibers": rods,
        "fiber_kind": [0] * len(rods),
        "velocity": np.zeros((nodes, 3)),
    }
    got = pair_forces(start, fibers).reshape(len(rods), 3, 3)
    expected, touching, _ = expected_forces(system_of(fibers), "none", "limited")
    expected = expected.reshape(got.shape)
    assert touching == 7  # three of the parallel pair, one of every other
    assert np.isfinite(got).all()
    assert np.abs(got - expected).max() < 1e-9 * np.abs(expected).max()


def test_exact_crossing_has_a_direction(start: Start) -> None:
    """Center lines that cross exactly are pushed apart along their common normal, with D0 e^G0."""
    kind = Kind(1, 4.0)
    rods = [straight_fiber(kind, (1, 0, 0), (0, 0, 0)), straight_fiber(kind, (0, 1, 0), (0, 0, 0))]
    fibers = {
        "kinds": (kind,),
        "fibers": rods,
        "fiber_kind": [0, 0],
        "velocity": np.zeros((4, 3)),
    }
    got = pair_forces(start, fibers).reshape(2, 2, 3).sum(axis=1)
    np.testing.assert_allclose(np.abs(got[:, 2]), STRENGTH * np.exp(DECAY), rtol=1e-12)
    assert got[0, 2] == -got[1, 2]
    assert np.abs(got[:, :2]).max() < 1e-9


def test_float32(start: Start) -> None:
    """Single precision: distances are known to 4 eps |x|, forces to G0/2 times that.

    Bound 8 G0 eps EDGE e^G0 D0 = 1.3e-1 absolute of forces up to 500 (2.6e-4). Closest points of
    nearly parallel pairs move further; the seed has none.
    """
    fibers = drop(KINDS, seed=12)
    keys = {"box": {"size": [EDGE] * 3}, "numerics": {"precision": "float32"}}
    got = pair_forces(start, fibers, **keys)
    system = system_of(fibers, lattice=EDGE * np.eye(3))
    expected, _, _ = expected_forces(system, "none", "limited")
    error = np.abs(got - expected).max()
    assert 1e-6 < error < 8 * DECAY * np.finfo(np.float32).eps * EDGE * STRENGTH * np.exp(DECAY)
