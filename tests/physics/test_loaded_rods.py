"""Forces on the ends of rigid rods: settling, turning by a couple, in a fluid at rest and in flow.

Units a = eta = 1. At rest steps of any size are exact: tolerance some roundings per step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, isotropic, straight_fiber
from tests.reference import rigid_rod as rr
from tests.reference.bead_chain import Array
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
SHEAR_GRADIENT = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
ROD = Kind(1, 19.0)
DRAG = 6.0 * math.pi * 20.0
TURNING_DRAG = 2.0 * math.pi * 20.0 * 403.0
HALF = 19.0


def loaded(
    start: Start, axis: Array, first: Array, last: Array, dt: float, **keys: Any
) -> Simulation:
    """One rod of 20 beads per direction, with these forces on its ends."""
    center = keys.pop("center", np.zeros_like(axis))
    fibers = [straight_fiber(ROD, p, c) for p, c in zip(axis, center, strict=True)]
    numerics = {"method": "rigid_rod", "dt": dt, **keys.pop("numerics", {})}
    rows = [
        {"fiber": fiber, "node": node, "force": force.tolist()}
        for node, forces in ((0, first), (-1, last))
        for fiber, force in enumerate(forces)
    ]
    return start([ROD], fibers, [0] * len(axis), numerics=numerics, load=rows, **keys)


def split(sim: Simulation) -> tuple[Array, Array]:
    """Centers and unit directions."""
    ends = sim.node_pos.reshape(-1, 2, 3)
    span = ends[:, 1] - ends[:, 0]
    return ends.mean(axis=1), span / np.linalg.norm(span, axis=1)[:, None]


@pytest.mark.parametrize("dt", [0.01, 7.0])
def test_settling_along_across_and_aslant(start: Start, dt: float) -> None:
    """Beads that do not feel each other fall alike: F/(6 pi eta a N), along the force."""
    axis = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0] / np.sqrt(2.0)])
    half = np.tile([0.0, 0.0, -40.0], (3, 1))
    sim = loaded(start, axis, half, half, dt)
    sim.step(100)
    center, direction = split(sim)
    fallen = 80.0 / DRAG * 100.0 * dt
    assert np.abs(center - [0.0, 0.0, -fallen]).max() < 1e-13 * max(fallen, HALF)
    assert np.abs(direction - axis).max() < 1e-13
    assert np.abs(sim.node_velocity - [0.0, 0.0, -80.0 / DRAG]).max() < 1e-14


def test_a_couple_turns_a_rod_in_place(start: Start) -> None:
    """dp/dt = 2 H F/K_r at right angles to the couple; it ends along the force on its last node."""
    force = np.array([[0.0, 0.0, 50.0]])
    sim = loaded(start, np.array([[1.0, 0.0, 0.0]]), -force, force, 0.5)
    speed = 2.0 * HALF * 50.0 / TURNING_DRAG
    sim.step()
    _, direction = split(sim)
    # from a right angle sin and cos are tanh and 1/cosh of speed * time
    exact = [1.0 / math.cosh(0.5 * speed), 0.0, math.tanh(0.5 * speed)]
    assert np.abs(direction[0] - exact).max() < 1e-14
    swing = HALF * speed * (np.array([0.0, 0.0, 1.0]) - exact[2] * direction[0])
    assert np.abs(sim.node_velocity - [-swing, swing]).max() < 1e-13
    sim.step(1000)
    center, direction = split(sim)
    assert np.abs(center).max() < 1e-13
    assert np.abs(direction[0] - [0.0, 0.0, 1.0]).max() < 1e-6


@pytest.mark.parametrize(
    ("precision", "steps"), [("float64", 1), ("float64", 100), ("float32", 100)]
)
def test_any_forces_at_rest(start: Start, precision: str, steps: int) -> None:
    """Centers and directions after steps of any size are those of the closed form."""
    rng = np.random.default_rng(1)
    axis, first, last = isotropic(rng, 50), *(30.0 * rng.normal(size=(2, 50, 3)))
    numerics = {"precision": precision}
    sim = loaded(start, axis, first, last, 40.0 / steps, numerics=numerics)
    sim.step(steps)
    center, direction = split(sim)
    pull, couple = rr.end_rates(rr.make_rods(0.0, axis, 20.0), first, last)
    assert 0.1 < np.linalg.norm(couple, axis=1).max() * 40.0 < 10.0
    eps = steps * (1e-15 if precision == "float64" else 1e-7)
    # where a rod stands against its couple a rounding grows: by the ratio of the sines, at most
    grown = 1.0 / np.linalg.norm(np.cross(axis, couple), axis=1)[:, None]
    grown *= np.linalg.norm(couple, axis=1)[:, None]
    assert np.abs(center - 40.0 * pull).max() < 10.0 * eps * max(HALF, np.abs(40.0 * pull).max())
    off = np.abs(direction - rr.align_rods(axis, couple, 40.0))
    assert (off < 4.0 * eps * grown).all()


def test_a_rod_against_its_couple(start: Start) -> None:
    """It stands where nothing turns it, however large the step; off that by 1e-3 it turns over."""
    axis = np.array([[0.0, 0.0, -1.0], [1e-3, 0.0, -1.0]])
    force = np.tile([0.0, 0.0, 500.0], (2, 1))
    for dt in (1e-3, 1e3):
        sim = loaded(start, axis, -force, force, dt)
        sim.step(3)
        center, direction = split(sim)
        assert np.abs(center).max() < 1e-13 * HALF
        assert direction[0] == pytest.approx([0.0, 0.0, -1.0], abs=1e-15)
        assert direction[1, 2] == pytest.approx(1.0 if dt > 1.0 else -1.0, abs=1e-4)


def test_flow_and_couple_together(start: Start) -> None:
    """Second order in dt; centers are exact."""
    rng = np.random.default_rng(2)
    axis, center = isotropic(rng, 30), rng.normal(size=(30, 3))
    first, last = 300.0 * rng.normal(size=(2, 30, 3))
    rods = rr.make_rods(center, axis, 20.0)
    pull, couple = rr.end_rates(rods, first, last)
    exact = rr.drag_rods(rods, SHEAR_GRADIENT, pull, couple, 3.0)
    off = []
    for dt in (0.1, 0.05):
        sim = loaded(start, axis, first, last, dt, center=center, flow=SHEAR)
        sim.step(round(3.0 / dt))
        middle, direction = split(sim)
        assert np.abs(middle - exact.center).max() < 1e-12 * np.abs(exact.center).max()
        off.append(float(np.abs(direction - exact.axis).max()))
    assert off[1] < 1e-3
    assert 3.5 < off[0] / off[1] < 4.5
    move, turn = rr.flow_rate(exact, SHEAR_GRADIENT)
    turn = turn + couple - (couple * exact.axis).sum(axis=1)[:, None] * exact.axis
    ends = sim.node_velocity.reshape(-1, 2, 3)
    assert np.abs(ends.mean(axis=1) - move - pull).max() < 1e-12 * np.abs(move + pull).max()
    assert np.abs(0.5 * (ends[:, 1] - ends[:, 0]) / HALF - turn).max() < 5.0 * off[1]


def test_chain_that_keeps_its_length_does_alike(start: Start) -> None:
    """The method with unknowns converges to the rods, second order in its step."""
    rng = np.random.default_rng(3)
    axis, first, last = isotropic(rng, 10), *(100.0 * rng.normal(size=(2, 10, 3)))
    rods = loaded(start, axis, first, last, 6.0)
    rods.step()
    off = []
    for dt in (0.1, 0.05):
        numerics, groups = {"method": "overdamped"}, {"inextensible": True}
        sim = loaded(start, axis, first, last, dt, numerics=numerics, groups=groups)
        sim.step(round(6.0 / dt))
        off.append(float(np.abs(split(sim)[1] - split(rods)[1]).max()))
    assert off[1] < 1e-3
    assert 3.0 < off[0] / off[1] < 5.0


def test_rods_pressed_together_stay_apart(start: Start) -> None:
    """Crossed rods, pushed through each other by what would move each by 12 radii."""
    axis = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    center = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    push = np.array([[0.0, 0.0, 40.0], [0.0, 0.0, -40.0]])
    keys: dict[str, Any] = {"contact": {"law": "exponential"}, "center": center}
    sim = loaded(start, axis, push, push, 0.5, **keys)
    sim.step(60)
    middle, direction = split(sim)
    gap = middle[1, 2] - middle[0, 2] - 2.0
    assert -0.03 < gap < 1e-3
    assert middle.sum(axis=0) == pytest.approx([0.0, 0.0, 4.0], abs=1e-9)
    assert np.abs(direction - axis).max() < 1e-6


def test_workers_do_not_matter(start: Start) -> None:
    """Bitwise the same."""
    rng = np.random.default_rng(4)
    axis, first, last = isotropic(rng, 40), *(10.0 * rng.normal(size=(2, 40, 3)))
    ends = []
    for workers in (1, 2):
        sim = loaded(start, axis, first, last, 0.1, flow=SHEAR, workers=workers)
        sim.step(10)
        ends.append(sim.node_pos.tobytes())
    assert ends[0] == ends[1]


def test_auto_leaves_loads_to_fibers_that_bend() -> None:
    """What a force bends is in no bound, so rods are taken only where they are asked for."""
    tables: dict[str, Any] = {
        "flow": SHEAR,
        "fibers": [ROD.table(1, position=[[0.0, 0.0, 0.0]]) | {"youngs_modulus": 1e12}],
        "contact": {"law": "none"},
        "stage": [{"kind": "flow", "end_strain": 1.0}],
        "numerics": {"method": "auto", "segments": 4},
    }
    assert scene_from_dict(tables).numerics.method == "rigid_rod"
    scene = scene_from_dict(tables | {"load": [{"force": [0.0, 0.0, 1.0]}]})
    assert scene.numerics.method == "overdamped"
