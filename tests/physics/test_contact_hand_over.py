"""A contact that slides over nodes keeps its friction: fibers dragged across one another."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import start_rods
from warpfiber.simulation import Simulation

RADIUS, STEP = 1.2e-3, 2.4e-3
DEPTH, SPEED, N = 1e-4, 0.1, 20
# Pairs that share a patch rub across their own middles of it, up to sqrt(2 DEPTH / 2 RADIUS) askew;
# half of its square, and no part of a patch is that far from its middle on average.
TILT = 0.25 * DEPTH / RADIUS


def dragged(
    degrees: float, friction: float, velocity: list[float], part: float, step: float = STEP
) -> Simulation:
    """A prescribed fiber on a fixed one along x; they cross at the part `part` of a segment."""
    angle = math.radians(degrees)
    first = np.array([0.5, 0.5, 0.5]) + np.outer(np.arange(N + 1) * step, [1.0, 0.0, 0.0])
    along = np.array([math.cos(angle), math.sin(angle), 0.0])
    cross = first[0] + [(N // 2 + part) * step, 0.0, 2.0 * RADIUS - DEPTH]
    second = cross + np.outer((np.arange(N + 1) - N // 2 - 0.4) * step, along)
    frozen = {"diameter": 2.0 * RADIUS, "density": 1340.0, "youngs_modulus": 7.5e5, "frozen": True}
    row = {**frozen, "count": 1, "centerline_length": N * step, "orientation": "aligned"}
    return start_rods(
        [ref.Rod(nodes, RADIUS, caps="capsule") for nodes in (first, second)],
        fibers=[row | {"position": [0.01, 0.01, 0.01]} for _ in range(2)],
        load=[{"group": 1, "velocity": velocity}],
        contact={"law": "hertz", "friction": friction},
        numerics={"dt": 2e-5},
    )


def forces(sim: Simulation) -> np.ndarray:
    """On the first fiber, sum over all contacts, in run units."""
    contacts = sim.method.contacts  # type: ignore[attr-defined]
    acts = contacts.acts.numpy()[: contacts.search.list.pair_count] != 0
    return contacts.force.numpy()[: len(acts)][acts].sum(axis=0)


def pulls(sim: Simulation, steps: int, every: int) -> np.ndarray:
    """Step, normal and tangential force every few steps; a new list has no forces yet."""
    found, builds = [], 0
    for _ in range(steps // every):
        sim.step(every)
        before, builds = builds, sim.method.list.build_count  # type: ignore[union-attr]
        if builds == before:
            push = forces(sim)
            found.append([sim.step_count, -push[2], math.hypot(push[0], push[1])])
    assert builds > 1 or steps < 100
    return np.asarray(found).T


@pytest.mark.parametrize(
    ("velocity", "step"),
    [
        ([SPEED, 0.0, 0.0], STEP),
        ([-SPEED, 0.0, 0.0], STEP),
        ([0.8 * SPEED, 0.6 * SPEED, 0.0], STEP),
        ([0.8 * SPEED, 0.6 * SPEED, 0.0], 0.5 * STEP),  # the shortest that there may be
    ],
)
def test_sliding_over_nodes(velocity: list[float], step: float) -> None:
    """mu times a constant normal force over nodes of both fibers; see TILT."""
    sim = dragged(90.0, 0.3, velocity, 0.2, step)
    _, normal, drag = pulls(sim, 4000, 7)[:, 30:]  # 8 mm, without the first sticking
    assert np.ptp(normal) < TILT * normal[0]
    assert np.abs(drag / normal - 0.3).max() < 0.3 * TILT


@pytest.mark.parametrize("velocity", [[SPEED, 0.0, 0.0], [0.8 * SPEED, -0.6 * SPEED, 0.0]])
@pytest.mark.parametrize("part", [-0.02, 0.98])
def test_sticking_over_a_node(part: float, velocity: list[float]) -> None:
    """The tangential force is the stiffness times the way also where it passes a node."""
    sim = dragged(90.0, 100.0, velocity, part)
    step, normal, drag = pulls(sim, 60, 1)  # 0.12 mm; the node is 0.048 mm away
    slope = drag / normal / step
    assert np.ptp(slope) < TILT * slope[0]


@pytest.mark.parametrize("degrees", [25.0, 8.0])
def test_lines_over_nodes(degrees: float) -> None:
    """Along a line the pairs of a patch take turns; each pushes across its own two axes.

    The tilt of these pushes is at most overlap / radius over a patch: second order in the sum.
    """
    sim = dragged(degrees, 0.3, [0.0, 0.3 * SPEED, 0.0], 0.2)
    _, normal, drag = pulls(sim, 3000, 7)[:, 60:]  # the crossing goes 1.8 mm / tan(angle)
    assert np.abs(drag / normal / 0.3 - 1.0).max() < (DEPTH / RADIUS) ** 2
