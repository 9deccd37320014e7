"""Loaded fibers without inertia come to rest where statics puts them.

Source: virtual work of the chain, whose joints turn by moment / k_b with k_b = E I / l (small
    loads); the elastica under a dead load at its end (large ones), by quadrature. A clamp holds a
    segment, so the free length is (N_seg - 1/2) l: the chain is then of second order in l.
Symbols: P load, E I bending stiffness of the rod, l segment length, a = eta = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, straight_fiber
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
LENGTH = 80.0
MODULUS = 1e4
STIFFNESS = MODULUS * math.pi / 4.0  # E I of a round rod of radius 1
DRAG = 3.0 * math.pi  # of a fiber, per length


def settled(
    start: Start,
    segments: int,
    loads: list[dict[str, object]],
    inextensible: bool = False,
    share: float = 1.0,
    **numerics: object,
) -> np.ndarray:
    """Node positions at rest; the fiber starts straight from 0 along x.

    A hundred steps of a `share` of the slowest mode's time, zeta L^4 / (12.4 E I) of a clamped one.
    """
    kind = Kind(segments, LENGTH / segments / 2.0, modulus=MODULUS)
    dt = share * DRAG * LENGTH**4 / (12.4 * STIFFNESS)
    sim = start(
        [kind],
        [straight_fiber(kind, (1, 0, 0), (LENGTH / 2.0, 0, 0))],
        flow={"kind": "rest", "viscosity": 1.0},
        numerics={"method": "overdamped", "dt": dt, **numerics},
        groups={"inextensible": inextensible},
        load=loads,
    )
    sim.step(100)
    rounding = 1e-9 if sim.model.precision.name == "float64" else 1e-5
    assert np.abs(sim.node_velocity).max() * sim.dt < rounding * LENGTH
    nodes: np.ndarray = sim.node_pos
    return nodes


def small_force(fraction: float, power: float) -> float:
    """Force of which `power` L^3 / (E I) is a fraction of L; squares of it are the error."""
    return fraction * STIFFNESS / (power * LENGTH**2)


@pytest.mark.parametrize("integrator", ["sdirk2", "bdf2"])
@pytest.mark.parametrize("segments", [2, 5, 20])
def test_cantilever(start: Start, segments: int, integrator: str) -> None:
    """P l^3 / (E I) (n - 1) n (2n - 1)/6, which is P L^3/(3 E I) [1 - 1/(4 (n - 1/2)^2)]."""
    force = small_force(1e-4, 1 / 3)
    loads = [{"node": 0, "hold": "clamp"}, {"force": [0.0, 0.0, -force]}]
    tip = settled(start, segments, loads, integrator=integrator)[-1]
    n, edge = segments, LENGTH / segments
    expected = force * edge**3 / STIFFNESS * (n - 1) * n * (2 * n - 1) / 6.0
    free = (n - 0.5) * edge
    smooth = force * free**3 / (3.0 * STIFFNESS)
    assert expected == pytest.approx(smooth * (1.0 - 0.25 / (n - 0.5) ** 2), rel=1e-12)
    assert tip[2] == pytest.approx(-expected, rel=1e-7)
    assert abs(tip[1]) < 1e-12 * LENGTH


@pytest.mark.parametrize("segments", [4, 10, 20])
def test_three_point_bending(start: Start, segments: int) -> None:
    """Ends held, load in the middle: moments P/2 times the distance to the nearer end."""
    force = small_force(1e-5, 1 / 48)
    loads = [
        {"node": 0, "hold": "position"},
        {"hold": "position"},
        {"node": segments // 2, "force": [0.0, force, 0.0]},
    ]
    nodes = settled(start, segments, loads)
    arms = np.minimum(np.arange(segments + 1), segments - np.arange(segments + 1))
    expected = force * (LENGTH / segments) ** 3 / (4.0 * STIFFNESS) * float((arms**2).sum())
    smooth = force * LENGTH**3 / (48.0 * STIFFNESS)
    assert expected == pytest.approx(smooth * (1.0 + 2.0 / segments**2), rel=1e-12)
    # the ends do not move closer, so the fiber also carries the load as a rope: deflection^2/8
    assert nodes[segments // 2, 1] == pytest.approx(expected, rel=1e-6)


def test_end_moment(start: Start) -> None:
    """A couple at the last segment bends a clamped fiber evenly: every joint turns by M l/(E I)."""
    segments = 12
    edge = LENGTH / segments
    moment = 1e-4 * STIFFNESS / LENGTH
    push = moment / edge
    loads = [
        {"node": 0, "hold": "clamp"},
        {"node": -2, "force": [0.0, 0.0, -push]},
        {"node": -1, "force": [0.0, 0.0, push]},
    ]
    nodes = settled(start, segments, loads)
    slope = np.diff(nodes[:, 2]) / edge
    turns = np.diff(slope) * STIFFNESS / edge
    assert turns == pytest.approx(moment, rel=1e-6)


def elastica(load: float) -> tuple[float, float, float]:
    """Deflection and shortening over L, and end angle, of P L^2/(E I) = `load`.

    ds = L dpsi / sqrt(2 load (sin psi_0 - sin psi)), psi = psi_0 - t^2 to remove the root.
    """
    points, weights = np.polynomial.legendre.leggauss(80)

    def integrals(end: float) -> tuple[float, ...]:
        t = 0.5 * math.sqrt(end) * (points + 1.0)
        psi = end - t**2
        ds = 0.5 * math.sqrt(end) * weights * 2.0 * t / np.sqrt(np.sin(end) - np.sin(psi))
        ds /= math.sqrt(2.0 * load)
        return tuple(float((ds * f).sum()) for f in (np.ones_like(psi), np.sin(psi), np.cos(psi)))

    low, high = 1e-9, math.pi / 2 * (1 - 1e-12)
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if integrals(middle)[0] < 1.0 else (low, middle)
    _, across, along = integrals(low)
    return across, 1.0 - along, low


def test_elastica_of_the_literature() -> None:
    for load, expected in ((1.0, (0.30172, 0.05643, 26.43)), (5.0, (0.71379, 0.38763, 69.64))):
        across, shorter, end = elastica(load)
        assert (across, shorter) == pytest.approx(expected[:2], abs=6e-6)
        assert math.degrees(end) == pytest.approx(expected[2], abs=6e-3)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("load", [1.0, 5.0])
def test_elastica(start: Start, load: float, precision: str) -> None:
    """Deflection and shortening of an inextensible fiber: second order in the segments."""
    across, shorter, _ = elastica(load)
    errors = []
    for segments in (10, 20, 40):
        free = (segments - 0.5) / segments * LENGTH
        force = load * STIFFNESS / free**2
        loads = [{"node": 0, "hold": "clamp"}, {"force": [0.0, 0.0, force]}]
        tip = settled(start, segments, loads, True, 0.2, precision=precision)[-1]
        errors.append([tip[2] / free - across, (LENGTH - tip[0]) / free - shorter])
    worst = np.abs(errors)
    assert (worst[2] < 2e-4).all()
    slopes = np.log2(worst[:-1] / worst[1:])
    assert (slopes > 1.8).all() and (slopes < 2.2).all()
