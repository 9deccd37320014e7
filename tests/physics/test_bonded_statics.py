"""Bonded spheres on the device against statics: large deflection, end moments, rings.

Fibers settle under loads on single nodes; moments are those of prescribed turns.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import rates, start_rods

RADIUS, LENGTH, MODULUS = 1.2e-3, 62.83e-3, 7.5e5
AREA, MOMENT = math.pi * RADIUS**2, 0.25 * math.pi * RADIUS**4
SHEAR_MODULUS = MODULUS / 3.0
AWAY = np.array([0.3, 0.5, 0.5])


def straight(n: int, **keys: object) -> ref.Rod:
    """Fiber of n segments along x."""
    rest = AWAY + np.outer(np.linspace(0.0, LENGTH, n + 1), [1.0, 0.0, 0.0])
    return ref.Rod(rest, RADIUS, **keys)  # type: ignore[arg-type]


def settle(time: float) -> list[dict[str, object]]:
    """Slow bending is damped away at its own rate."""
    return [{"kind": "settle", "damping": 40.0, "end_time": time}]


@pytest.mark.parametrize(
    ("n", "shear", "most"),
    [(4, "ga", 5.9e-3), (16, "ga", 3.8e-4), (26, "ga", 1.45e-4), (26, "rbf", 1.16e-4)],
)
def test_large_deflection(n: int, shear: str, most: float) -> None:
    """P L^2 / E I = 5: tip of the rod with shear and stretch; up to twice the known error."""
    force = 5.0 * MODULUS * MOMENT / LENGTH**2
    sim = start_rods(
        [straight(n, shear=shear, damping=0.5)],
        load=[{"node": 0, "hold": "clamp"}, {"node": -1, "force": [0.0, force, 0.0]}],
        stage=settle(1.2),
    )
    sim.run()
    error = (sim.node_pos[-1] - AWAY)[:2] / LENGTH - [0.612207, 0.714514]
    assert 0.5 * most < np.abs(error).max() < 2.0 * most


@pytest.mark.parametrize("axis", [2, 0])
def test_end_moment(axis: int) -> None:
    """2 pi E I / L holds a closed n-gon, T L / G I_p a twisted fiber: inner nodes are balanced.

    Loads of the nodes from their accelerations; rounding of positions of 0.5 m in bonds of 2.4 mm.
    """
    n = 26
    rod = straight(n)
    turn = 2.0 * np.pi / n if axis == 2 else 0.3
    vector = np.zeros((n + 1, 3))
    vector[:, axis] = turn * np.arange(n + 1)
    q = ref.exponential(vector)
    middle = ref.exponential(vector[:-1] + 0.5 * turn * np.eye(3)[axis])
    edges = rod.rest_length[:, None] * ref.turn(middle, rod.axis)
    x = AWAY + np.concatenate([np.zeros((1, 3)), np.cumsum(edges, axis=0)])
    linear, angular = rates(start_rods([rod], x=x, q=q))
    moments = angular * rod.inertia[:, None]
    if axis == 2:
        expected = 2.0 * np.pi * MODULUS * MOMENT / LENGTH
        assert np.linalg.norm(x[-1] - x[0]) < 1e-10 * LENGTH
    else:
        expected = 0.3 * n * SHEAR_MODULUS * 2.0 * MOMENT / LENGTH
    assert -moments[-1, axis] == pytest.approx(expected, rel=1e-10)
    assert np.abs(moments[1:-1]).max() < 1e-10 * expected
    assert np.abs(linear * rod.mass[:, None]).max() * LENGTH < 1e-10 * rod.k_n * rod.length


@pytest.mark.parametrize(("shear", "error"), [("rbf", -6.0), ("ga", -21.8)])
def test_ring_between_two_points(shear: str, error: float) -> None:
    """P R^3 / E I (pi / 4 - 2 / pi) + pi / 4 P R (1 / E A + 1 / G A), short by `error` / n^2.

    Closing by 1e-4 R: what is not linear is of that order.
    """
    n, big = 28, 10.3e-3
    angle = 2.0 * np.pi * np.arange(n) / n
    rest = AWAY + big * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    arc = 2.0 * np.pi * big / n
    rod = ref.Rod(rest, RADIUS, closed=True, segment_length=arc, shear=shear, damping=0.5)
    bent = big**3 / (MODULUS * MOMENT) * (math.pi / 4.0 - 2.0 / math.pi)
    soft = bent + 0.25 * math.pi * big * (1.0 / (MODULUS * AREA) + 1.0 / (SHEAR_MODULUS * AREA))
    force = 1e-4 * big / soft
    sim = start_rods(
        [rod],
        load=[
            {"node": 0, "force": [-force, 0.0, 0.0]},
            {"node": n // 2, "force": [force, 0.0, 0.0]},
        ],
        stage=[{"kind": "settle", "damping": 200.0, "end_time": 0.25}],
    )
    sim.run()
    x = sim.node_pos
    closing = 2.0 * big - (x[0, 0] - x[n // 2, 0])
    assert closing / (force * soft) - 1.0 == pytest.approx(error / n**2, rel=0.05)
