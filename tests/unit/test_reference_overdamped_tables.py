"""The float64 restatement of one fiber without inertia against tables: rigid half turn, S-turn.

Source of the numbers: the Jeffery period of r_e = sqrt((r_f^2 + 1)/2); an S-turn with three Newton
    iterations at dt = 0.0025 (halving changes at most 1.2e-7 L); errors of single runs. Errors over
    a run are the largest component of a node on a grid of whole strains.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import overdamped as od
from tests.reference import overdamped_step as step
from tests.reference import rigid

PERIOD = rigid.period(math.sqrt(5000.5))


# Error of the half turn against the exact period, r_f = 100, E = 2e11, by (scheme, dt).
RIGID_ROWS = {
    ("bdf2", 0.05): -3.7e-7,
    ("bdf2", 0.2): -1.4e-5,
    ("bdf2", 0.5): -4.1e-4,
    ("sdirk2_history", 0.05): 2.2e-6,
    ("sdirk2_history", 0.2): 3.5e-5,
    ("sdirk2_history", 0.5): 1.9e-4,
    ("sdirk2_history", 1.0): 2.9e-4,
    ("euler", 0.2): -1.0e-6,
    ("euler", 0.5): -3.8e-4,
    ("euler", 1.0): -7.7e-2,
}


def assert_rigid_row(scheme: str, dt: float, segments: int) -> None:
    """Within the last digit shown and what 1, 3 and 9 segments differ by."""
    fiber = step.shear_fiber(bc.Chain(segments, 99.0 / segments, modulus=2e11))
    half = step.half_turn(fiber, scheme, dt, 240.0)
    expected = RIGID_ROWS[scheme, dt]
    digit = 10.0 ** (math.floor(math.log10(abs(expected))) - 1)
    error = 2.0 * half / PERIOD - 1.0
    assert abs(error - expected) < 0.51 * digit + 2.5e-7


@pytest.mark.parametrize(("scheme", "dt"), [row for row in RIGID_ROWS if row[1] >= 0.5])
@pytest.mark.parametrize("segments", [1, 3, 9])
def test_rigid_period(scheme: str, dt: float, segments: int) -> None:
    assert_rigid_row(scheme, dt, segments)


@pytest.mark.parametrize(("scheme", "dt"), [row for row in RIGID_ROWS if row[1] == 0.2])
def test_rigid_period_middle_step(scheme: str, dt: float) -> None:
    assert_rigid_row(scheme, dt, 3)


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "dt"), [row for row in RIGID_ROWS if row[1] <= 0.2])
@pytest.mark.parametrize("segments", [1, 3, 9])
def test_rigid_period_small_steps(scheme: str, dt: float, segments: int) -> None:
    assert_rigid_row(scheme, dt, segments)


def test_bdf2_fails_at_a_strain_of_one() -> None:
    fiber = step.shear_fiber(bc.Chain(3, 33.0, modulus=2e11))
    half = step.half_turn(fiber, "bdf2", 1.0, 240.0)
    assert not abs(2.0 * half / PERIOD - 1.0) < 0.1


STRAINS = (20, 30, 35, 40, 45, 60)
TURN_Z = (-0.01589661, -0.03944748, -0.1278601, -0.1408430, -0.1237738, -0.02325492)
TURN_X = (0.49901462, 0.49493013, 0.4208568, -0.0624327, -0.4902699, -0.50070480)


def turn_error(scheme: str, dt: float, strain_end: int) -> tuple[float, dict[str, float]]:
    """Largest error of the end node over the table, in L, and measures of the run."""
    fiber = step.shear_fiber(bc.Chain(49, 1.0, modulus=5e4))
    table = {k: (x, z) for k, x, z in zip(STRAINS, TURN_X, TURN_Z, strict=True)}
    found = {"error": 0.0, "angle": 0.0, "at": 0.0, "strain": 0.0, "drift": 0.0}

    def watch(time: float, shape: od.Shape) -> None:
        x = shape.node_pos
        if round(time) in table and abs(time - round(time)) < 1e-9:
            off = np.abs(x[-1, [0, 2]] / 98.0 - table[round(time)]).max()
            found["error"] = max(found["error"], float(off))
        angle = float(bc.joint_angles(x).max())
        if angle > found["angle"]:
            found.update(angle=angle, at=time)
        stretch = float(np.abs(bc.segment_geometry(x)[1] / 2.0 - 1.0).max())
        found["strain"] = max(found["strain"], stretch)
        found["drift"] = max(found["drift"], float(np.abs(x.mean(0)).max() / 98.0))

    return step.half_turn(fiber, scheme, dt, strain_end, watch), found


@pytest.mark.parametrize(
    ("scheme", "dt", "bound"), [("sdirk2_history", 0.2, 4.4e-4), ("bdf2", 0.2, 1.0e-3)]
)
def test_flexible_turn(scheme: str, dt: float, bound: float) -> None:
    """r_f = 50, E = 5e4, 49 segments, up to strain 45."""
    _, found = turn_error(scheme, dt, 45)
    assert 0.05 * bound < found["error"] < bound
    assert found["angle"] == pytest.approx(0.506, abs=2e-3)
    assert found["drift"] < 1e-12


@pytest.mark.slow
def test_flexible_turn_small_steps() -> None:
    half, found = turn_error("sdirk2_history", 0.02, 92)
    assert abs(half - 90.1247) < 1e-4
    assert found["error"] < 3.2e-6
    assert found["angle"] == pytest.approx(0.506, abs=5e-4)
    assert found["at"] == pytest.approx(42.3, abs=0.05)
    assert found["strain"] == pytest.approx(0.0213, abs=1e-4)
    assert found["drift"] < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "dt", "bound"),
    [("sdirk2_history", 0.1, 8.6e-5), ("bdf2", 0.1, 3.8e-4), ("bdf2", 0.05, 1.0e-4)],
)
def test_flexible_turn_error_bounds(scheme: str, dt: float, bound: float) -> None:
    _, found = turn_error(scheme, dt, 60)
    assert found["error"] < bound


def test_period_in_closed_form() -> None:
    assert math.isclose(math.sqrt(5000.5), 70.7142135642, rel_tol=1e-11)
    assert math.isclose(PERIOD, 444.3993608914, rel_tol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("modulus", "shift"), [(2e9, -1.65e-5), (2e7, -1.7e-3)])
def test_bending_shifts_the_period(modulus: float, shift: float) -> None:
    fiber = step.shear_fiber(bc.Chain(9, 11.0, modulus=modulus))
    error = 2.0 * step.half_turn(fiber, "bdf2", 0.05, 240.0) / PERIOD - 1.0
    assert error == pytest.approx(shift, rel=0.03)


def turning_error(carried: bool) -> float:
    """Largest error of the angle over half a turn: BDF2 at 0.05, E = 1e9, one segment."""
    fiber = step.shear_fiber(bc.Chain(1, 99.0, modulus=1e9))
    before = step.start_along_x(fiber)
    now, worst = step.start_bdf2(fiber, before, 0.05), 0.0
    for k in range(2, 4800):
        guess = 2.0 * now.node_pos - before.node_pos
        tension = 2.0 * now.tension - before.tension
        if not carried:
            tension = od.elastic_tension(fiber.chain, guess)
        base = (4.0 * now.node_pos - before.node_pos) / 3.0
        problem = od.linearize(fiber, 0.1 / 3.0, base, guess, tension)
        before, now = now, od.solve_step(problem)
        span = now.node_pos[1] - now.node_pos[0]
        off = math.atan2(span[2], span[0]) - rigid.jeffery_angle(math.sqrt(5000.5), 0.05 * k)
        worst = max(worst, abs((off + math.pi) % (2.0 * math.pi) - math.pi))
    return worst


@pytest.mark.slow
def test_tension_has_to_be_carried() -> None:
    """The stretch of an extrapolated length makes a stiffness that turns the fiber wrongly."""
    assert turning_error(True) == pytest.approx(5e-5, rel=0.1)
    assert turning_error(False) == pytest.approx(0.20, rel=0.05)


@pytest.mark.parametrize(("dt", "worst", "bound"), [(0.5, 0.13, 1e-7), (0.1, 2.3e-4, 1e-9)])
def test_length_errs_but_does_not_drift(dt: float, worst: float, bound: float) -> None:
    """r_f = 50, inextensible, BDF2 over an S-turn."""
    fiber = step.shear_fiber(bc.Chain(49, 1.0, modulus=5e4), "inextensible")
    errors: list[float] = []

    def watch(time: float, shape: od.Shape) -> None:
        errors.append(float(np.abs(bc.segment_geometry(shape.node_pos)[1] / 2.0 - 1.0).max()))

    step.half_turn(fiber, "bdf2", dt, 60.0, watch)
    assert max(errors) == pytest.approx(worst, rel=0.03)
    assert errors[-1] < bound


ANGLE_Z = (-0.0158837, -0.0392774, -0.12649, -0.14193, -0.12488)


@pytest.mark.slow
def test_flexible_turn_with_the_angle_law() -> None:
    """k_b theta^2/2, the force of it on the right side; the error falls as dt^2."""
    fiber = step.shear_fiber(bc.Chain(49, 1.0, modulus=5e4))._replace(bending="angle")
    table = dict(zip(STRAINS, ANGLE_Z, strict=False))
    errors, halves = [], []
    for dt in (0.1, 0.05):
        off = [0.0]

        def watch(time: float, shape: od.Shape, off: list[float] = off) -> None:
            if round(time) in table and abs(time - round(time)) < 1e-9:
                off.append(abs(shape.node_pos[-1, 2] / 98.0 - table[round(time)]))

        halves.append(step.half_turn(fiber, "sdirk2_history", dt, 92.0, watch))
        errors.append(max(off))
    assert errors[0] < 7e-5 and errors[1] < 2.5e-5
    assert abs((4.0 * halves[1] - halves[0]) / 3.0 - 90.1355) < 3e-4


def turn_grid(fiber: od.Fiber, scheme: str, dt: float) -> np.ndarray:
    """Nodes at strains 1, 2, ..., 120, in lengths of the fiber."""
    steps = step.fixed_steps(fiber, step.start_along_x(fiber), scheme, dt)
    every = round(1.0 / dt)
    kept = itertools.islice(steps, every - 1, 120 * every, every)
    return np.array([shape.node_pos for shape in kept]) / fiber.chain.length


# Largest error of a node over strain 0-120 in L.
TURN_ROWS = {
    ("bdf2", 0.1): 3.8e-4,
    ("bdf2", 0.2): 1.0e-3,
    ("bdf2", 0.5): 8.8e-3,
    ("sdirk2_history", 0.1): 8.6e-5,
    ("sdirk2_history", 0.2): 4.4e-4,
    ("sdirk2_history", 0.5): 4.2e-3,
    ("sdirk2_history", 1.0): 4.4e-2,
    ("euler", 0.1): 1.1e-2,
    ("euler", 0.2): 2.3e-2,
    ("euler", 0.5): 7.0e-2,
    ("euler", 1.0): 0.32,
}


@pytest.mark.slow
def test_flexible_turn_error_table() -> None:
    fiber = step.shear_fiber(bc.Chain(49, 1.0, modulus=5e4))
    exact = turn_grid(fiber, "sdirk2", 0.02)
    for (scheme, dt), expected in TURN_ROWS.items():
        error = np.abs(turn_grid(fiber, scheme, dt) - exact).max()
        assert error == pytest.approx(expected, rel=0.05), (scheme, dt)


@pytest.mark.slow
def test_flexible_turn_without_stretch() -> None:
    fiber = step.shear_fiber(bc.Chain(49, 1.0, modulus=5e4))
    apart = [turn_grid(fiber._replace(form=f), "sdirk2", 0.1) for f in ("primal", "inextensible")]
    assert np.abs(apart[1] - apart[0]).max() == pytest.approx(6.6e-3, rel=0.02)


@pytest.mark.slow
def test_flexible_turn_with_fewer_segments() -> None:
    """49 beads, z of the end node against 48 segments."""
    runs = {
        count: turn_grid(
            step.shear_fiber(bc.Chain(count, 48.0 / count, modulus=5e4)), "sdirk2", 0.1
        )
        for count in (48, 24, 16, 8)
    }
    for count, expected in ((24, 3e-3), (16, 8e-3), (8, 5.6e-2)):
        error = np.abs(runs[count][:, -1, 2] - runs[48][:, -1, 2]).max()
        assert error == pytest.approx(expected, rel=0.07)
