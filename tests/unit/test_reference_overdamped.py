"""The float64 restatement of one fiber without inertia: terms, elimination, steps.

Source of the numbers: energies by finite differences; sums over unreduced beads; dense solves;
    convergence to smaller steps.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import elimination as el
from tests.reference import overdamped as od
from tests.reference import overdamped_step as step
from tests.reference.gradient import central_gradient

GRADIENT = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])


def bent_fiber(
    rng: np.random.Generator, segments: int, spacing: float, form: str = "primal", **keys: float
) -> tuple[od.Fiber, od.Shape]:
    """Fiber in a general flow, bent and stretched by some percent, with its elastic tension."""
    chain = bc.Chain(segments, spacing, **{"modulus": 300.0, **keys})
    x = bc.walk_nodes(chain, rng) * (1.0 + 0.02 * rng.normal(size=(segments + 1, 1)))
    return od.Fiber(chain, GRADIENT, form), od.Shape(x, od.elastic_tension(chain, x))


@pytest.mark.parametrize(("segments", "spacing"), [(1, 99.0), (4, 2.0), (5, 3.7), (7, 1.0)])
def test_drag_matrix(segments: int, spacing: float) -> None:
    chain = bc.Chain(segments, spacing, radius=0.7, viscosity=1.3)
    drag = od.drag_matrix(chain) / chain.drag
    assert drag.sum() == pytest.approx(3.0 * chain.bead_count, rel=1e-14)
    assert np.array_equal(drag, drag.T)
    if spacing == 1.0:
        assert np.abs(drag - np.eye(len(drag))).max() < 1e-15
    if spacing == int(spacing):
        w = bc.bead_weights(segments, int(spacing))
        assert np.abs(drag - np.kron(w.T @ w, np.eye(3))).max() < 1e-13 * spacing
    assert chain.weights.sum() == pytest.approx(chain.bead_count, rel=1e-15)


def test_torque_matrix_is_the_derivative_of_the_couple() -> None:
    rng = np.random.default_rng(1)
    fiber, shape = bent_fiber(rng, 5, 2.3)
    chain, x = fiber.chain, shape.node_pos
    axis, length = bc.segment_geometry(x)
    v = rng.normal(size=x.shape)
    whole = bc.torque_force(chain, axis, length, v, GRADIENT)
    matrix = od.torque_matrix(chain, x)
    split = od.torque_couple(chain, x, GRADIENT) - (matrix @ v.ravel()).reshape(-1, 3)
    assert np.abs(split - whole).max() < 1e-13 * np.abs(whole).max()
    assert np.abs(matrix - matrix.T).max() < 1e-14 * np.abs(matrix).max()
    assert np.linalg.eigvalsh(matrix).min() > -1e-13 * np.abs(matrix).max()
    # A shift and a turn along each segment (twist, stretch) are not damped.
    assert np.abs(matrix @ np.tile([1.0, -2.0, 0.5], len(x))).max() < 1e-12


@pytest.mark.parametrize("segments", [1, 2, 6])
def test_elastic_forces_are_gradients(segments: int) -> None:
    fiber, shape = bent_fiber(np.random.default_rng(2), segments, 1.7)
    chain, x = fiber.chain, shape.node_pos
    axis, _ = bc.segment_geometry(x)
    bend = -(od.bending_matrix(chain) @ x.ravel()).reshape(-1, 3)
    pull = od.tension_force(axis, shape.tension)
    for force, energy in ((bend, od.bending_energy), (pull, bc.stretching_energy)):
        slope = central_gradient(lambda y, e=energy: e(chain, y), x, 1e-3)
        assert np.abs(force + slope).max() < 1e-8 * max(1.0, np.abs(force).max())

    def force_along(y: np.ndarray, k: int) -> float:
        axis, _ = bc.segment_geometry(y)
        total = od.tension_force(axis, od.elastic_tension(chain, y)).ravel()
        return float((total - od.bending_matrix(chain) @ y.ravel())[k])

    matrix = od.elastic_matrix(chain, x, shape.tension)
    for k in (0, 4, matrix.shape[0] - 1):
        slope = central_gradient(lambda y, k=k: force_along(y, k), x, 1e-3).ravel()
        assert np.abs(matrix[k] + slope).max() < 1e-8 * np.abs(matrix).max()


def test_bending_law_at_small_angles() -> None:
    """k_b/(2 l^2)|second difference|^2 is k_b theta^2/2 for unstretched, nearly straight joints."""
    chain = bc.Chain(6, 1.5, modulus=40.0)
    x = bc.arc_nodes(chain, 1e-2)
    assert od.bending_energy(chain, x) == pytest.approx(bc.bending_energy(chain, x), rel=1e-5)


def test_momentum_of_the_unreduced_fiber() -> None:
    rng = np.random.default_rng(3)
    worst = 0.0
    for _ in range(300):
        segments, spacing = int(rng.integers(1, 7)), int(rng.integers(1, 6))
        fiber, shape = bent_fiber(rng, segments, spacing)
        chain, x = fiber.chain, shape.node_pos
        push = rng.normal(size=x.shape) * 10.0 ** rng.integers(-1, 3)
        v = od.velocity(fiber, shape, push)
        w = bc.bead_weights(segments, spacing)
        drag = chain.drag * (w @ (x @ GRADIENT.T - v))
        axis, length = bc.segment_geometry(x)
        couple = bc.torque_force(chain, axis, length, v, GRADIENT)
        size = np.abs(drag).sum() + np.abs(push).sum() + np.abs(couple).sum()
        worst = max(worst, np.abs(drag.sum(0) + push.sum(0)).max() / size)
        turn = np.cross(w @ x, drag).sum(0) + np.cross(x, push + couple).sum(0)
        worst = max(worst, np.abs(turn).max() / (size * np.abs(x).max()))
    assert worst < 1e-14


@pytest.mark.parametrize("segments", [1, 2, 3, 9])
def test_elimination_by_blocks(segments: int) -> None:
    fiber, shape = bent_fiber(np.random.default_rng(4), segments, 2.5)
    x = shape.node_pos
    problem = od.linearize(fiber, 0.1, x, x, np.abs(shape.tension))
    matrix, right = od.primal_system(problem)
    assert np.abs(matrix - matrix.T).max() < 1e-14 * np.abs(matrix).max()
    diagonal, lower, kappa = el.blocks_of(matrix)
    if segments > 1:
        bend = fiber.chain.bending_stiffness / fiber.chain.rest_length**2
        assert kappa == pytest.approx(0.1 * bend, rel=1e-12)
        assert el.half_bandwidth(matrix) == 6
    dense = np.linalg.solve(matrix, right)
    found = el.solve_blocks(diagonal, lower, kappa, right.reshape(-1, 3)).ravel()
    assert np.abs(found - dense).max() < 1e-12 * np.abs(dense).max()


@pytest.mark.parametrize("form", ["compliant", "inextensible"])
@pytest.mark.parametrize("modulus", [2.0, 2e4, 2e11])
def test_elimination_with_multipliers(form: str, modulus: float) -> None:
    """Node by node, no pivot vanishes even without compliance."""
    rng = np.random.default_rng(5)
    fiber, shape = bent_fiber(rng, 6, 2.0, form, modulus=modulus, bending_modulus=30.0)
    x = shape.node_pos
    problem = od.linearize(fiber, 0.1, x, x, 5.0 * rng.random(6))
    matrix, right = od.multiplier_system(problem)
    order = od.node_order(6)
    assert sorted(order) == list(range(len(right)))
    banded = matrix[np.ix_(order, order)]
    assert el.half_bandwidth(banded) == 8
    found, pivots = el.solve_in_order(banded, right[order])
    dense = np.linalg.solve(matrix, right)[order]
    assert np.abs(found - dense).max() < 1e-10 * np.abs(dense).max()
    assert (pivots > 0.0).sum() == 21 and (pivots < 0.0).sum() == 6


def test_compression_makes_the_matrix_indefinite() -> None:
    """Buckling within a step shows in the sign of a pivot; without compression there is none."""
    chain = bc.Chain(6, 2.0, modulus=100.0, bending_modulus=0.0)
    fiber = od.Fiber(chain, GRADIENT)
    x = bc.arc_nodes(chain, 0.3)
    smallest = []
    for tension in (-500.0, 0.0):
        problem = od.linearize(fiber, 1.0, x, x, np.full(6, tension))
        matrix, right = od.primal_system(problem)
        found, pivots = el.solve_in_order(matrix, right)
        smallest.append(pivots.min())
        assert (pivots < 0.0).sum() == (np.linalg.eigvalsh(matrix) < 0.0).sum()
        assert np.abs(found - np.linalg.solve(matrix, right)).max() < 1e-9 * np.abs(found).max()
    assert smallest[0] < 0.0 < smallest[1]


@pytest.mark.parametrize("modulus", [1.0, 1e3, 2e7])
def test_multipliers_give_the_primal_step(modulus: float) -> None:
    fiber, shape = bent_fiber(np.random.default_rng(6), 6, 2.0, modulus=modulus)
    shape = od.Shape(shape.node_pos, 0.01 * shape.tension)
    push = np.random.default_rng(7).normal(size=shape.node_pos.shape)
    primal = step.step_euler(fiber, shape, 0.05, push)
    compliant = step.step_euler(fiber._replace(form="compliant"), shape, 0.05, push)
    assert np.abs(primal.node_pos - compliant.node_pos).max() < 1e-10
    assert np.abs(primal.tension - compliant.tension).max() < 1e-8 * np.abs(primal.tension).max()


def test_tension_is_that_of_the_linearized_length() -> None:
    fiber, shape = bent_fiber(np.random.default_rng(8), 4, 2.0)
    errors = []
    for dt in (1e-2, 1e-3):
        new = step.step_euler(fiber, shape, dt)
        errors.append(np.abs(new.tension - od.elastic_tension(fiber.chain, new.node_pos)).max())
    assert errors[1] < 0.02 * errors[0]  # second order in the motion of a step


def test_response_is_the_derivative_of_the_step() -> None:
    for form in od.FORMS:
        fiber, shape = bent_fiber(np.random.default_rng(9), 4, 2.0, form)
        x = shape.node_pos
        problem = od.linearize(fiber, 0.1, x, x, shape.tension)
        push = np.random.default_rng(10).normal(size=x.shape)
        moved = od.solve_step(problem, push).node_pos - od.solve_step(problem).node_pos
        answer = 0.1 * od.step_response(problem, push.reshape(-1, 1)).reshape(-1, 3)
        assert np.abs(moved - answer).max() < 1e-13 * max(1.0, np.abs(answer).max())
        direct = od.solve_step(od.linearize(fiber, 0.1, x, x, shape.tension, push)).node_pos
        assert (
            np.abs(direct - problem.guess - (moved + od.solve_step(problem).node_pos - x)).max()
            < 1e-12
        )


def test_inextensible_segments_keep_their_length() -> None:
    """The constraint is linear in a step: the length errs by O(dt^2) and does not drift."""
    chain = bc.Chain(12, 1.0, modulus=800.0)
    fiber = step.shear_fiber(chain, "inextensible")
    worst = {}
    for dt in (0.1, 0.05):
        start = od.Shape(bc.straight_nodes(chain, (1, 0, 1), (0, 0, 0)), np.zeros(12))
        errors = []
        for k, shape in enumerate(step.fixed_steps(fiber, start, "bdf2", dt), start=1):
            errors.append(np.abs(bc.segment_geometry(shape.node_pos)[1] / 2.0 - 1.0).max())
            if k * dt > 20.0:
                break
        worst[dt] = max(errors)
        assert errors[-1] < 0.1 * max(errors)
    assert worst[0.1] < 5e-3
    assert worst[0.05] < 0.35 * worst[0.1]


def test_translation_and_still_fluid() -> None:
    chain = bc.Chain(5, 2.0, modulus=3000.0)
    still = od.Fiber(chain, np.zeros((3, 3)))
    x = bc.arc_nodes(chain, 2.0)
    pull = np.tile([0.3, -0.2, 0.1], (6, 1)) * chain.matrix.sum(1)[:, None]
    straight = bc.straight_nodes(chain, (0, 1, 0), (1, 2, 3))
    v = od.velocity(still, od.Shape(straight, np.zeros(5)), pull)
    assert np.abs(v - np.array([0.3, -0.2, 0.1]) / chain.drag).max() < 1e-13
    # A bent fiber relaxes; the mean over beads stays.
    shape = od.Shape(x, od.elastic_tension(chain, x))
    energy = od.bending_energy(chain, x)
    mass = chain.matrix.sum(1)
    for k, new in enumerate(step.fixed_steps(still, shape, "bdf2", 0.2)):
        assert np.abs(mass @ (new.node_pos - x)).max() < 1e-12 * chain.bead_count
        if k == 20:
            break
    assert od.bending_energy(chain, new.node_pos) < 0.5 * energy


def positions_after(fiber: od.Fiber, scheme: str, dt: float, count: int) -> np.ndarray:
    for _, shape in zip(
        range(count), step.fixed_steps(fiber, step.start_along_x(fiber), scheme, dt), strict=False
    ):
        last = shape
    return last.node_pos


@pytest.mark.parametrize(
    ("form", "bending"),
    [("primal", "difference"), ("inextensible", "difference"), ("primal", "angle")],
)
@pytest.mark.parametrize(("scheme", "order"), [("bdf2", 2), ("sdirk2", 2), ("euler", 1)])
def test_order_of_convergence(scheme: str, order: int, form: str, bending: str) -> None:
    """r_f = 25, E = 3125, 12 segments, strain 18 (the fiber is strongly bent)."""
    fiber = step.shear_fiber(bc.Chain(12, 2.0, modulus=3125.0), form)._replace(bending=bending)
    ladder = [positions_after(fiber, scheme, 18.0 / n, n) for n in (180, 360, 720)]
    coarse = np.abs(ladder[1] - ladder[0]).max()
    fine = np.abs(ladder[2] - ladder[1]).max()
    assert abs(math.log2(coarse / fine) - order) < 0.3


def test_error_estimate_is_the_distance_to_first_order() -> None:
    fiber, shape = bent_fiber(np.random.default_rng(11), 5, 2.0)
    dt = 0.01
    new, k2, error = step.step_sdirk2(fiber, shape, dt)
    first = od.solve_step(
        od.linearize(fiber, step.CHI * dt, shape.node_pos, shape.node_pos, shape.tension)
    )
    k1 = (first.node_pos - shape.node_pos) / (step.CHI * dt)
    apart = np.linalg.norm(new.node_pos - (shape.node_pos + dt * k1), axis=1).max()
    assert error == pytest.approx(apart / fiber.chain.length, rel=1e-9)
    whole = shape.node_pos + dt * ((1.0 - step.CHI) * k1 + step.CHI * k2)
    assert np.abs(whole - new.node_pos).max() < 1e-12


def test_rule_of_the_next_step() -> None:
    for error, accepted, factor in (
        (1.0, True, 0.85),
        (0.25, True, 1.7),
        (0.0, True, 2.0),
        (1e-9, True, 2.0),
        (1.5, True, 0.85 / math.sqrt(1.5)),
        (4.0, False, 0.4),
        (1e9, False, 0.2),
    ):
        assert step.next_step(0.1, error, 1.0, accepted) == pytest.approx(0.1 * factor)


def test_adaptive_steps() -> None:
    """Smaller tolerance: more steps, smaller error; the last step ends at the asked time."""
    fiber = step.shear_fiber(bc.Chain(12, 2.0, modulus=3125.0))
    start = step.start_along_x(fiber)
    exact = positions_after(fiber, "sdirk2", 18.0 / 1440, 1440)
    errors, counts = [], []
    for tolerance in (1e-3, 1e-4, 1e-5):
        run = step.run_adaptive(fiber, start, tolerance, 0.05, 18.0)
        assert run.time[-1] == pytest.approx(18.0, rel=1e-12)
        errors.append(np.abs(run.node_pos[-1] - exact).max() / fiber.chain.length)
        counts.append(len(run.time) - 1)
    assert counts[0] < counts[1] < counts[2]
    assert errors[0] > errors[1] > errors[2]
    assert errors[0] < 2e-2
