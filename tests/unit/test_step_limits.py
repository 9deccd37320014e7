"""The step limit from diagonals is the one that the eigenvalues of the full matrices give."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warpfiber.methods.stability import stable_limit, step_limits
from warpfiber.scene import Scene, scene_from_dict

BISECTION = 1e-6  # relative width at which `stable_limit` stops


def dense(bands: np.ndarray) -> np.ndarray:
    """The symmetric matrix of these diagonals."""
    n = bands.shape[1]
    upper = sum(np.diag(bands[d, : n - d], d) for d in range(1, min(3, n)))
    return np.diag(bands[0]) + upper + np.transpose(upper)


def chain(nodes: int, rng: np.random.Generator, width: int) -> np.ndarray:
    """Diagonals of a sum of squares of rows that join `width` neighboring nodes, each in turn."""
    bands = np.zeros((3, nodes))
    for first in range(nodes - width + 1):
        row = rng.normal(size=width)
        for i in range(width):
            for j in range(i, width):
                bands[j - i, first + i] += row[i] * row[j]
    return bands


@pytest.mark.parametrize("nodes", [1, 2, 3, 4, 17])
@pytest.mark.parametrize("seed", range(4))
def test_limit_is_where_an_eigenvalue_vanishes(nodes: int, seed: int) -> None:
    """Just below the limit the smallest eigenvalue is positive, just above it is not."""
    rng = np.random.default_rng(seed)
    stiffness, damping = chain(nodes, rng, min(nodes, 3)), chain(nodes, rng, min(nodes, 2))
    mass, drag = chain(nodes, rng, 1), chain(nodes, rng, 1)
    mass[0] += 0.1
    limit = stable_limit(stiffness, damping, mass, drag)
    assert math.isfinite(limit)
    for share, sign in ((1.0 - 3.0 * BISECTION, 1.0), (1.0 + 3.0 * BISECTION, -1.0)):
        dt = share * limit
        inertia = dense(np.maximum(mass, 0.5 * dt * drag))
        rest = 4.0 * inertia - 2.0 * dt * dense(damping) - dt * dt * dense(stiffness)
        assert sign * np.linalg.eigvalsh(rest)[0] > 0.0


def test_no_limit_without_forces() -> None:
    still, mass = np.zeros((3, 5)), np.array([[1.0] * 5, [0.0] * 5, [0.0] * 5])
    assert stable_limit(still, still, mass, mass) == math.inf


def test_long_chain_has_the_limit_of_its_highest_mode() -> None:
    """Springs k in a row of masses m: omega = 2 sqrt(k / m) cos(pi / (2 N)), dt = 2 / omega."""
    nodes, k, m = 1000, 3.0, 0.7
    bands = np.zeros((3, nodes))
    bands[0], bands[1, :-1] = 2.0 * k, -k
    bands[0, [0, -1]] = k
    still, mass = np.zeros((3, nodes)), np.zeros((3, nodes))
    mass[0] = m
    exact = 1.0 / (math.sqrt(k / m) * math.cos(math.pi / (2.0 * nodes)))
    assert stable_limit(bands, still, mass, still) == pytest.approx(exact, rel=2.0 * BISECTION)


def crossed_scene(**contact: float) -> Scene:
    """Fibers of bonded spheres that may meet."""
    return scene_from_dict(
        {
            "fibers": [
                {
                    "count": 2,
                    "centerline_length": 0.024,
                    "diameter": 2.4e-3,
                    "density": 1340.0,
                    "youngs_modulus": 7.5e5,
                    "position": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.01]],
                }
            ],
            "contact": contact,
            "stage": [{"kind": "settle", "end_time": 1.0}],
            "numerics": {"method": "bonded_spheres", "segments": 10, "device": "cpu"},
        }
    )


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_contacts_of_an_inner_node(friction: float) -> None:
    """2 / omega of a node that two crossed fibers hold at 0.1 radii, moving against it.

    Sliding and rolling together the node has 1 / m + a^2 / J = 3.5 / m, the stiffness two thirds.
    """
    scene = crossed_scene(friction=friction, modulus=7.5e7)
    limits = {limit.term: limit.dt for limit in step_limits(scene)}
    a = 1.2e-3
    mass = 1340.0 * math.pi * a * a * 2.4e-3
    modulus = 0.5 * 7.5e7 / 0.75
    stiffness = 2.0 * 2.0 * (2.0 * modulus * math.sqrt(a * 0.1 * a))
    parts = 3.5 * 2.0 / 3.0 if friction else 1.0
    exact = 2.0 * math.sqrt(mass / (parts * stiffness))
    assert limits["contacts"] == pytest.approx(exact, rel=1e-6)
    assert step_limits(scene)[0].term == "contacts"
    damped = crossed_scene(friction=friction, modulus=7.5e7, damping=0.3)
    assert step_limits(damped)[0].dt < 0.8 * exact
