"""The float64 restatement of rigid rods in a linear flow: exact maps, mobility.

Source of the numbers: periods of the orbit, the orbit of a spheroid, drag and torque bead by bead.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import overdamped as od
from tests.reference import rigid
from tests.reference import rigid_rod as rr

STILL = np.zeros((3, 3))
GENERAL = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    p = rng.normal(size=(count, 3))
    return p / np.linalg.norm(p, axis=1)[:, None]


@pytest.mark.parametrize("pieces", [8, 444, 4444])
def test_rods_return_after_a_period(pieces: int) -> None:
    rng = np.random.default_rng(1)
    rods = rr.make_rods(0.0, directions(rng, 1000), 100.0)
    period = rigid.period(math.sqrt(5000.5))
    now = rods
    for _ in range(pieces):
        now = rr.map_rods_in_shear(now, 1.0, period / pieces)
    assert np.abs(now.axis - rods.axis).max() < 2e-11


def test_shear_map_is_the_exponential() -> None:
    rng = np.random.default_rng(2)
    rods = rr.make_rods(10.0 * rng.normal(size=(40, 3)), directions(rng, 40), 2.0 + np.arange(40.0))
    for time in (1e-3, 0.7, 30.0):
        closed = rr.map_rods_in_shear(rods, 1.3, time)
        general = rr.map_rods(rods, bc.shear_gradient(1.3), time)
        assert np.abs(closed.axis - general.axis).max() < 1e-12
        assert np.abs(closed.center - general.center).max() < 1e-12 * (1.0 + time) * 50.0


def test_general_map() -> None:
    """Against the closed orbit of one rod, two half steps, and small steps of the rate."""
    rng = np.random.default_rng(3)
    rods = rr.make_rods(rng.normal(size=(5, 3)), directions(rng, 5), [2.0, 5.0, 5.0, 20.0, 1.0])
    mean = np.array([0.2, -0.1, 0.4])
    whole = rr.map_rods(rods, GENERAL, 2.0, mean)
    for k in range(5):
        r_e = math.sqrt((rods.beads[k] ** 2 + 1.0) / 2.0)
        orbit = rigid.jeffery_orbit(rods.axis[k], GENERAL, r_e, 2.0)
        assert np.abs(whole.axis[k] - orbit).max() < 1e-13
    twice = rr.map_rods(rr.map_rods(rods, GENERAL, 1.0, mean), GENERAL, 1.0, mean)
    assert np.abs(twice.axis - whole.axis).max() < 1e-13
    assert np.abs(twice.center - whole.center).max() < 1e-12
    h = 1e-4
    ahead, behind = (rr.map_rods(rods, GENERAL, t, mean) for t in (h, -h))
    move, turn = rr.flow_rate(rods, GENERAL, mean)
    assert np.abs((ahead.center - behind.center) / (2 * h) - move).max() < 1e-7
    assert np.abs((ahead.axis - behind.axis) / (2 * h) - turn).max() < 1e-7


@pytest.mark.parametrize("count", [1, 2, 7, 20])
def test_rod_mobility_is_that_of_the_beads(count: int) -> None:
    """Drag and torque of all beads, written out, balance a force at a point."""
    rng = np.random.default_rng(4)
    rods = rr.make_rods(rng.normal(size=3), directions(rng, 1), count, radius=0.7, viscosity=1.4)
    p, force, arm = rods.axis[0], rng.normal(size=3), 0.3 * float(rods.half_length[0])
    move, turn = rr.force_rate(rods, 0, force, arm)
    arcs = rr.bead_positions(rods, 0)
    zeta = 6.0 * math.pi * 1.4 * 0.7
    drag = -zeta * (move + arcs[:, None] * turn)
    assert np.abs(drag.sum(0) + force).max() < 1e-13
    spin = np.cross(p, turn)
    torque = np.cross(arcs[:, None] * p, drag).sum(0) - 8.0 * math.pi * 1.4 * 0.7**3 * count * spin
    assert np.abs(torque + np.cross(arm * p, force)).max() < 1e-12
    if count > 1:
        chain = bc.Chain(1, count - 1.0, radius=0.7, viscosity=1.4)
        x = bc.straight_nodes(chain, p, rods.center[0])
        sigma = 0.5 + arm / chain.length
        push = np.array([(1 - sigma) * force, sigma * force])
        along = np.array([(push[0] @ p) * p, (push[1] @ p) * p])
        # The segment carries the force along it as tension; a rod does not stretch.
        push = push - along + along.mean(axis=0)
        v = od.velocity(od.Fiber(chain, STILL), od.Shape(x, np.zeros(1)), push)
        assert (
            np.abs(v - (move + np.array([-1, 1])[:, None] * chain.length / 2 * turn)).max() < 1e-13
        )
