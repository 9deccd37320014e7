"""The float64 restatement of unilateral contact of flexible fibers, through the matrix of a step.

Source of the numbers: balance of forces by hand, rigid rods as the limit, conditions of the contact
    problem.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import dual as du
from tests.reference import overdamped as od
from tests.reference import rigid_rod as rr
from tests.reference import unilateral as un

STILL = np.zeros((3, 3))
GENERAL = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])
HARD = un.Obstacles()
X, Y, Z = np.eye(3)
FLOOR = (((0.0, 0.0, 0.0), (0.0, 0.0, 2.0)),)


def rest(chain: bc.Chain, direction: np.ndarray, center: np.ndarray, form: str = "primal") -> tuple:
    x = bc.straight_nodes(chain, direction, center)
    return od.Fiber(chain, STILL, form), od.Shape(x, np.zeros(chain.segments))


@pytest.mark.parametrize("form", od.FORMS)
def test_flexible_fiber_on_a_wall(form: str) -> None:
    """Beads one by one on the floor: every node carries its own weight."""
    chain = bc.Chain(6, 1.0, modulus=50.0)
    fiber, shape = rest(chain, X, np.array([0, 0, 1.0]), form)
    weight = -np.linspace(1.0, 3.0, 7)[:, None] * Z
    step = un.step_fibers([fiber], [shape], 0.1, un.Obstacles(walls=FLOOR), [weight])
    assert step.force == pytest.approx(np.linspace(1.0, 3.0, 7), rel=1e-8)
    assert np.abs(step.shapes[0].node_pos - shape.node_pos).max() < 1e-10
    assert np.abs(step.shapes[0].tension).max() < 1e-8


@pytest.mark.parametrize("form", od.FORMS)
def test_crossing_fibers_under_a_load(form: str) -> None:
    """The contact carries the whole load when the state is steady; no gap at the end of a step."""
    chain = bc.Chain(4, 2.5, modulus=2e5)
    one, two = rest(chain, X, 0 * X, form), rest(chain, Y, 2.0 * Z, form)
    fibers, shapes = [one[0], two[0]], [one[1], two[1]]
    load = np.full(5, 0.5)[:, None] * Z
    for solver in (un.sweep_tightly, lambda dual: du.solve_gradients(dual, 1e-11)):
        now = shapes
        for _ in range(40):
            step = un.step_fibers(fibers, now, 0.5, un.Obstacles(solver=solver), [load, -load])
            now = step.shapes
        assert step.force.sum() == pytest.approx(2.5, rel=1e-4)
        apart = now[1].node_pos[2] - now[0].node_pos[2]
        assert apart == pytest.approx(2.0 * Z, abs=1e-5)
        sag = now[0].node_pos[[0, -1], 2] - now[0].node_pos[2, 2]
        assert sag[0] == pytest.approx(sag[1], rel=1e-2) and 0.0 < sag[0] < 1.0


def test_fiber_of_one_segment_is_a_rod() -> None:
    """The same rows, forces and motion as rigid rods in the limit of a small step."""
    rods = rr.make_rods([[-4, 0, 0], [0, 1.0, 2.05]], [X, np.array([0.1, 1, 0])], 10.0)
    chain = bc.Chain(1, 9.0, modulus=1e9)
    load = np.array([6.0, -6.0])[:, None] * Z
    fibers = [od.Fiber(chain, STILL, "inextensible")] * 2
    shapes = [
        od.Shape(bc.straight_nodes(chain, p, c), np.zeros(1))
        for p, c in zip(rods.axis, rods.center, strict=True)
    ]
    halves = [np.tile(0.5 * f, (2, 1)) for f in load]
    stiff = un.step_fibers(fibers, shapes, 2.0, HARD, halves)
    rigid_step = un.step_rods(rods, STILL, 2.0, HARD, load)
    assert stiff.force.sum() == pytest.approx(rigid_step.force.sum(), rel=1e-9)
    for k in range(2):
        middle = stiff.shapes[k].node_pos.mean(axis=0)
        assert np.abs(middle - rigid_step.rods.center[k]).max() < 1e-9


def test_fibers_lubricate_like_rods() -> None:
    chain = bc.Chain(4, 2.0, modulus=1e7)
    one, two = rest(chain, X, 0 * X), rest(chain, X + Y, 2.4 * Z)
    load = np.full(5, 0.5)[:, None] * Z
    rods = rr.make_rods([0 * X, 2.4 * Z], [X, X + Y], 9.0)
    wet = un.Obstacles(lubricated=True)
    soft = un.step_fibers([one[0], two[0]], [one[1], two[1]], 0.01, wet, [load, -load])
    hard = un.step_rods(rods, STILL, 0.01, wet, 2.5 * np.array([1.0, -1.0])[:, None] * Z)
    both = [sorted(r.coefficient for r in s.rows if r.coefficient > 0.0) for s in (soft, hard)]
    assert len(both[0]) == 3 and both[0] == pytest.approx(both[1], rel=1e-9)
    assert (soft.force < 0.0).sum() == 0
    assert soft.force.sum() == pytest.approx(hard.force.sum(), rel=0.05)


def test_response_diagonal_of_fibers() -> None:
    """D = J A_h^-1 J^T: force and displacement of a row agree with the step itself."""
    rng = np.random.default_rng(10)
    chain = bc.Chain(3, 3.0, modulus=100.0)
    fibers, shapes = [], []
    for shift in (0.0, 2.5):
        x = bc.walk_nodes(chain, rng, 0.1) + shift * Z
        fibers.append(od.Fiber(chain, GENERAL))
        shapes.append(od.Shape(x, np.zeros(3)))
    problems = [
        od.linearize(f, 0.05, s.node_pos, s.node_pos, s.tension)
        for f, s in zip(fibers, shapes, strict=True)
    ]
    step = un.solve_fibers(problems, un.Obstacles(reach=2.0))
    assert len(step.rows) > 3
    jacobian = un.node_jacobian(problems, step.rows)
    moved = np.concatenate(
        [(s.node_pos - p.guess).ravel() for s, p in zip(step.shapes, problems, strict=True)]
    )
    gap = np.array([row.gap for row in step.rows]) + jacobian @ moved
    assert gap.min() > -1e-10
    assert step.force.min() >= 0.0
    assert np.abs(gap * step.force).max() < 1e-9


@pytest.mark.parametrize("lubricated", [False, True])
def test_bent_fibers_in_shear(lubricated: bool) -> None:
    """Three soft fibers and a wall: hardly an overlap, one motion with both solvers."""
    chain = bc.Chain(5, 2.0, modulus=2e3)
    shear = bc.shear_gradient(1.0)
    fibers = [od.Fiber(chain, shear)] * 3
    start = []
    for axis, center in ((X + 0.4 * Z, 6 * Z), (X - 0.3 * Y, 9 * Z - 8 * X), (Y, 8 * Z + 9 * X)):
        start.append(od.Shape(bc.straight_nodes(chain, axis, center), np.zeros(5)))
    ends = []
    for solver in (un.sweep_tightly, lambda dual: du.solve_gradients(dual, 1e-10)):
        obstacles = un.Obstacles(walls=FLOOR, lubricated=lubricated, solver=solver)
        now, pushed = start, 0.0
        for _ in range(40):
            step = un.step_fibers(fibers, now, 0.1, obstacles)
            now = step.shapes
            dry = [f for f, r in zip(step.force, step.rows, strict=True) if r.coefficient == 0.0]
            pushed = max(pushed, max(dry, default=0.0))
            assert min(dry, default=0.0) >= 0.0
            problems = [od.linearize(f, 0.1, s.node_pos, s.node_pos, s.tension)
                        for f, s in zip(fibers, now, strict=True)]  # fmt: skip
            gaps = [row.gap for row in un.fiber_rows(problems, obstacles) if row.coefficient == 0.0]
            assert min(gaps) > -0.05
        assert pushed > 1.0
        ends.append(np.concatenate([s.node_pos for s in now]))
    assert np.abs(ends[0] - ends[1]).max() < 1e-5
