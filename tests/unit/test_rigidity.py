"""Bounds of what rods leave out: deflection under a force, contact force, stretch, by brute force.

The beam is integrated by sums over 4000 parts, the contacts are drawn at random.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.cell import isotropic
from tests.reference import bead_chain as bc
from tests.reference import rigid_rod as rr
from warpfiber.scene.rigidity import (
    contact_deflection,
    flow_deflection,
    flow_stretch,
    largest_contact_force,
)
from warpfiber.scene.tables import strain_rate

SHEAR = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def beam_deflection(at: float) -> float:
    """Largest distance from the chord of a free beam, L = E I = f = 1, force at arc -1/2 ... 1/2.

    Drag that a moving and turning line feels balances it: 1 + 12 `at` s per length.
    """
    s = np.linspace(-0.5, 0.5, 4001)
    step = s[1] - s[0]
    load = 1.0 + 12.0 * at * s
    shear = np.cumsum(load) * step - np.where(s > at, 1.0, 0.0)
    bent = np.cumsum(np.cumsum(np.cumsum(shear) * step) * step) * step
    chord = bent[0] + (bent[-1] - bent[0]) * (s + 0.5)
    return float(np.abs(bent - chord).max())


def test_deflection_of_a_beam() -> None:
    """A force in the middle and at an end as derived; none bends more than the bound."""
    radius, length, modulus = 0.5, 40.0, 3e4
    scale = 2.0 * length**2 / (modulus * 0.25 * math.pi * radius**4)  # f L^2 / (E I)
    bound = contact_deflection(2.0, length, radius, modulus) / scale
    assert beam_deflection(0.0) == pytest.approx(1.0 / 128.0, rel=0.01)
    assert beam_deflection(0.5) == pytest.approx(bound, rel=0.02)
    assert all(beam_deflection(at) < 1.01 * bound for at in np.linspace(0.0, 0.5, 11))
    assert contact_deflection(1.0, 1.0, 1.0, 0.0) == math.inf


def test_no_lone_contact_is_stronger() -> None:
    """Pairs that touch at random points in random flows: force that stops their approach."""
    rng, largest = np.random.default_rng(1), 0.0
    for _ in range(3000):
        beads = float(rng.choice([2.0, 5.0, 20.0, 100.0]))
        raw = rng.normal(size=(3, 3)) if rng.random() < 0.7 else SHEAR
        gradient = raw - np.trace(raw) / 3.0 * np.eye(3)
        normal = isotropic(rng, 1)[0]
        axis = np.cross(normal, rng.normal(size=(2, 3)))
        arms = (beads - 1.0) * rng.choice([-1.0, 1.0, 0.0, 0.5], size=2)
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        # the point of contact is at 0: the second rod lies 2a along the normal
        center = np.array([[0.0, 0.0, 0.0], 2.0 * normal]) - arms[:, None] * axis
        pair = rr.make_rods(center, axis, beads)
        move, turn = rr.flow_rate(pair, gradient)
        points = move + arms[:, None] * turn
        approach = -float(normal @ (points[1] - points[0]))
        give = 0.0
        for k, sign in ((0, -1.0), (1, 1.0)):
            moved, turned = rr.force_rate(pair, k, sign * normal, arms[k])
            give += sign * float(normal @ (moved + arms[k] * turned))
        shear = strain_rate(tuple(map(tuple, gradient))) / math.sqrt(3.0)
        bound = largest_contact_force(beads, 1.0, shear, 1.0)
        largest = max(largest, approach / give / bound)
    assert 0.3 < largest <= 1.0


def test_stretch_of_a_fiber_along_an_extension() -> None:
    """Tension of a line of beads that does not move, over its section and modulus."""
    beads, modulus, rate = 60, 2e4, 0.7
    chain = bc.Chain(1, beads - 1.0, modulus=modulus)
    along = (np.arange(beads) - (beads - 1) / 2.0) * 2.0
    drag = 6.0 * math.pi * rate * along
    tension = float(drag[along > 0.0].sum())
    strain = tension / (math.pi * chain.radius**2 * modulus)
    bound = flow_stretch(float(beads), modulus, rate, 1.0)
    assert strain == pytest.approx(bound, rel=2.0 / beads)


def test_bending_by_the_flow() -> None:
    """The measured shifts of the period at S_eff 0.98; a soft fiber is no rod at all."""
    assert flow_deflection(0.98) == pytest.approx(1.65e-5, rel=0.02)
    assert flow_deflection(0.03) == math.inf
