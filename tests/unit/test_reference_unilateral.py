"""The float64 restatement of unilateral contact of rigid rods: rows, dual problem, steps.

Source of the numbers: balance of forces and torques by hand, conditions of the contact problem.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import contact_rows as cr
from tests.reference import dual as du
from tests.reference import rigid_rod as rr
from tests.reference import segments as sg
from tests.reference import unilateral as un

STILL = np.zeros((3, 3))
SHEAR = bc.shear_gradient(1.0)
GENERAL = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])
HARD = un.Obstacles()
X, Y, Z = np.eye(3)
FLOOR = (((0.0, 0.0, 0.0), (0.0, 0.0, 2.0)),)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    p = rng.normal(size=(count, 3))
    return p / np.linalg.norm(p, axis=1)[:, None]


def random_lines(rng: np.random.Generator) -> tuple[cr.Line, cr.Line]:
    p, q = directions(rng, 2)
    return cr.Line(rng.normal(size=3) * 4.0, p, 9.0), cr.Line(rng.normal(size=3) * 4.0, q, 6.0)


def test_closest_row_is_the_closest() -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        a, b = random_lines(rng)
        rows = cr.line_rows(a, b, 1.0)
        assert 1 <= len(rows) <= 5
        ends = (a.middle - 9 * a.axis, a.middle + 9 * a.axis)
        ends += (b.middle - 6 * b.axis, b.middle + 6 * b.axis)
        s, t = sg.closest_points(*ends)
        apart = ends[2] + t * (ends[3] - ends[2]) - ends[0] - s * (ends[1] - ends[0])
        assert rows[0][3] == pytest.approx(np.linalg.norm(apart) - 2.0, abs=1e-12)
        assert min(row[3] for row in rows) == rows[0][3]
        for s, t, normal, gap in rows:
            apart = b.middle + t * b.axis - a.middle - s * a.axis
            assert apart @ normal == pytest.approx(gap + 2.0, abs=1e-12)
            assert abs(s) <= 9.0 and abs(t) <= 6.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rows_of_parallel_rods(sign: float) -> None:
    """The ends of the overlap are rows, and the middle of the first rod."""
    rows = cr.line_rows(cr.Line(0 * X, X, 9.0), cr.Line(5 * X + 2.5 * Y, sign * X, 9.0), 1.0)
    arcs = sorted(s for s, t, _, gap in rows if abs(gap - 0.5) < 1e-12)
    assert arcs == pytest.approx([-4.0, 0.0, 9.0])
    # Far along the line: the ends that face each other carry the smallest gap.
    far = cr.line_rows(cr.Line(0 * X, X, 9.0), cr.Line(20 * X + 0.1 * Y, sign * X, 9.0), 1.0)
    assert min(far, key=lambda row: row[3])[:2] == pytest.approx((9.0, -9.0 * sign))


def test_crossed_lines_have_a_normal() -> None:
    for q in (Y, X, -X):
        for _, _, normal, gap in cr.line_rows(cr.Line(0 * X, X, 5.0), cr.Line(0 * X, q, 5.0), 1.0):
            assert np.linalg.norm(normal) == pytest.approx(1.0)
            if gap < -1.9:
                assert abs(normal @ X) < 1e-12 and abs(normal @ q) < 1e-12


def random_rods(rng: np.random.Generator, count: int, size: float, beads: float = 10.0) -> rr.Rods:
    return rr.make_rods(size * rng.random((count, 3)), directions(rng, count), beads)


def test_delassus_diagonal() -> None:
    rods = random_rods(np.random.default_rng(6), 6, 8.0)
    rows = cr.rod_rows(rods, 3.0) + cr.wall_rows(rods, (0, 0, 1), (0.3, 0, 1), 9.0)
    jacobian = cr.rod_jacobian(rods, rows)
    matrix = jacobian @ cr.rod_mobility(rods) @ jacobian.T
    assert len(rows) > 10
    closed = [cr.rod_diagonal(rods, row) for row in rows]
    assert np.abs(np.diag(matrix) - closed).max() < 1e-15
    assert np.linalg.eigvalsh(matrix).min() > -1e-14


def random_dual(rng: np.random.Generator, lubricated: bool, compliance: float) -> du.Dual:
    rods = random_rods(rng, 8, 10.0)
    rows = cr.rod_rows(rods, 0.5)
    if lubricated:
        rows += cr.lubrication_rows(rods)
    jacobian = cr.rod_jacobian(rods, rows)
    free = jacobian @ rng.normal(size=jacobian.shape[1])
    gap = np.array([max(row.gap, -0.05) for row in rows])
    coefficient = [row.coefficient for row in rows]
    matrix = jacobian @ cr.rod_mobility(rods) @ jacobian.T
    return du.make_dual(matrix, free, gap, 0.05, compliance, coefficient)


@pytest.mark.parametrize("compliance", [0.0, 0.02])
@pytest.mark.parametrize("lubricated", [False, True])
def test_both_solvers_find_the_same(lubricated: bool, compliance: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(4):
        dual = random_dual(rng, lubricated, compliance)
        contact = dual.coefficient == 0.0
        assert contact.sum() >= 5 and (~contact).any() == lubricated
        sweeps, gradients = du.solve_sweeps(dual, 1e-11), du.solve_gradients(dual, 1e-9)
        for found, bound in ((sweeps, 1e-8), (gradients, 1e-9)):
            balance = du.row_balance(dual, found.force)
            f = found.force[contact]
            assert found.residual < bound
            assert f.min() >= 0.0
            assert dual.h * balance[contact].min() > -bound
            assert np.abs(f * balance[contact]).max() * dual.h < bound * max(1.0, f.max())
        # Forces may not be unique, the motion is.
        moved = dual.h * dual.delassus @ (sweeps.force - gradients.force)
        assert np.abs(moved).max() < 1e-6
        loose = du.solve_gradients(dual, 1e-3)
        assert loose.residual < 1e-3
        again = du.solve_gradients(dual, 1e-3, start=gradients.force)
        assert again.iterations == 0 and np.array_equal(again.force, gradients.force)


def test_one_lubrication_row() -> None:
    """w = w_free/(1 + c D): two spheres pushed together."""
    rods = rr.make_rods([[0, 0, 0], [2.2, 0, 0]], [Y, Y], 1.0)
    load = np.array([1.0, -1.0])[:, None] * X
    step = un.step_rods(rods, STILL, 0.01, un.Obstacles(lubricated=True), load)
    c, d = 1.5 * math.pi / 0.2, 2.0 / (6.0 * math.pi)
    lubrication = [k for k, row in enumerate(step.rows) if row.coefficient > 0.0]
    assert [step.rows[k].coefficient for k in lubrication] == pytest.approx([c])
    speed = (step.rods.center[1] - step.rods.center[0] - 2.2 * X)[0] / 0.01
    assert speed == pytest.approx(-2.0 / (6.0 * math.pi) / (1.0 + c * d), rel=1e-12)
    assert cr.lubrication_coefficient(2.0009, 1.0, 1.0) == 0.0
    assert cr.lubrication_coefficient(3.0001, 1.0, 1.0) == 0.0
    assert cr.lubrication_coefficient(2.001, 1.0, 1.0) == pytest.approx(250 * 6 * math.pi, rel=1e-9)


@pytest.mark.parametrize("arm", [0.0, 6.0])
def test_crossing_rods_under_a_load(arm: float) -> None:
    """Closed in one step to no gap, then f = (2 F/xi)/D; F itself when they cross in the middle."""
    rods = rr.make_rods([[-arm, 0, 0], [0, 0, 2.3]], [X, Y], 10.0)
    load = np.array([5.0, -5.0])[:, None] * Z
    close = 0.3 / (2.0 * 5.0 / float(rods.drag[0]))
    step = un.step_rods(rods, STILL, 2.0 * close, HARD, load)
    drag = float(rods.drag[0])
    d = 2.0 / drag + arm**2 / float(rods.turning_drag[0])
    carried = [k for k, f in enumerate(step.force) if f > 0.0]
    assert len(carried) == 1
    assert step.rows[carried[0]].arc_i == pytest.approx(arm)
    assert step.force[carried[0]] == pytest.approx(0.5 * 2.0 * 5.0 / drag / d, rel=1e-10)
    if arm == 0.0:
        for _ in range(3):
            step = un.step_rods(step.rods, STILL, 0.5, HARD, load)
            assert max(step.force) == pytest.approx(5.0, rel=1e-10)
            assert step.rods.center[1] - step.rods.center[0] == pytest.approx(2.0 * Z, abs=1e-10)
            assert np.abs(step.rods.axis - rods.axis).max() < 1e-12


def test_penalty_overlaps_by_force_over_stiffness() -> None:
    rods = rr.make_rods([[0, 0, 0], [0, 0, 2.0]], [X, Y], 10.0)
    load = np.array([5.0, -5.0])[:, None] * Z
    for _ in range(200):
        step = un.step_rods(rods, STILL, 1.0, un.Obstacles(stiffness=100.0), load)
        rods = step.rods
    assert max(step.force) == pytest.approx(5.0, rel=1e-9)
    assert 2.0 - rods.center[1, 2] + rods.center[0, 2] == pytest.approx(0.05, rel=1e-9)


def test_parallel_rods_under_a_load() -> None:
    """Pushed together in the middle, they stay parallel and carry the load in full."""
    rods = rr.make_rods([[0, 0, 0], [2, 0, 2.0]], [X, X], [10.0, 6.0])
    load = np.array([4.0, -4.0])[:, None] * Z
    # Centers that are not opposite turn the rods about the end of the overlap.
    step = un.step_rods(rods, STILL, 0.01, HARD, load)
    assert 0.0 < step.force.sum() < 4.0 and step.rods.axis[0, 2] < -1e-6
    assert overlap(step.rods) < 1e-6
    rods = rods._replace(center=rods.center * [0, 0, 1])
    step = un.step_rods(rods, STILL, 0.5, HARD, load)
    assert step.force.sum() == pytest.approx(4.0, rel=1e-9)
    # Balance of torques about the center of each rod.
    arcs = np.array([[row.arc_i, row.arc_j] for row in step.rows])
    assert np.abs(step.force @ arcs).max() < 1e-8
    assert np.abs(step.rods.axis - X).max() < 1e-12
    assert np.abs(step.rods.center - rods.center).max() < 1e-10


@pytest.mark.parametrize("arm", [0.0, 3.0])
def test_rod_on_a_wall(arm: float) -> None:
    """The two ends carry the weight by the law of the lever; nothing moves."""
    rods = rr.make_rods([[1.0, 2.0, 1.0]], [X], 10.0)
    weight = -3.0
    mobility = cr.rod_mobility(rods)
    rows = cr.wall_rows(rods, *FLOOR[0], 0.5)
    assert [row.gap for row in rows] == pytest.approx([0.0, 0.0])
    move, turn = rr.force_rate(rods, 0, weight * Z, arm)
    jacobian = cr.rod_jacobian(rods, rows)
    matrix = jacobian @ mobility @ jacobian.T
    free = np.concatenate([move, turn])
    found = du.solve_sweeps(du.make_dual(matrix, jacobian @ free, np.zeros(2), 0.1), 1e-13)
    share = 3.0 * np.array([0.5 * (1.0 + arm / 9.0), 0.5 * (1.0 - arm / 9.0)])
    assert found.force == pytest.approx(share, rel=1e-9)
    assert np.abs(free + mobility @ jacobian.T @ found.force).max() < 1e-11
    if arm == 0.0:
        step = un.step_rods(rods, STILL, 0.1, un.Obstacles(walls=FLOOR), weight * Z[None])
        assert np.abs(step.rods.center - rods.center).max() < 1e-11


def test_tumbling_rod_lands_on_the_wall() -> None:
    """In shear a rod at 2a pushes itself off; its tips never enter the wall by more than h^2."""
    deepest = {}
    for h in (0.1, 0.05):
        axis = np.array([[1.0, 0.0, 0.05]])
        rods = rr.make_rods([[0.0, 0.0, 2.0]], axis, 20.0)
        obstacles = un.Obstacles(walls=FLOOR, search=20.0)
        lowest = math.inf
        while rods.axis[0, 0] > -0.9:
            rods = un.step_rods(rods, SHEAR, h, obstacles).rods
            tips = rods.center[0, 2] + np.array([-1, 1]) * rods.axis[0, 2] * 19.0
            lowest = min(lowest, float(tips.min()) - 1.0)
        assert rods.center[0, 2] > 15.0
        deepest[h] = -lowest
    assert deepest[0.1] < 0.1
    assert deepest[0.05] < 0.5 * deepest[0.1]


def test_free_rods_move_by_the_map() -> None:
    rods = random_rods(np.random.default_rng(8), 3, 400.0)
    step = un.step_rods(rods, GENERAL, 0.3, HARD)
    exact = rr.map_rods(rods, GENERAL, 0.3)
    assert not step.rows
    assert np.abs(step.rods.center - exact.center).max() < 1e-11
    assert np.abs(step.rods.axis - exact.axis).max() < 1e-14
    load = np.array([[1.0, 2.0, -3.0]] * 3)
    pushed = un.step_rods(rods, GENERAL, 0.01, HARD, load).rods.center
    rate = load / rods.drag[:, None]
    mean = rr.map_rods(rods, GENERAL, 0.01).center
    for k in range(3):
        alone = rr.map_rods(
            rods._replace(center=rods.center[[k]], axis=rods.axis[[k]], beads=rods.beads[[k]]),
            GENERAL, 0.01, rate[k],
        )  # fmt: skip
        assert np.abs(pushed[k] - alone.center[0]).max() < 1e-6 * np.abs(rate[k]).max()
    assert np.abs(pushed - mean).max() > 1e-5


def overlap(rods: rr.Rods) -> float:
    gaps = [row.gap for row in cr.rod_rows(rods, 1.0)]
    return max(0.0, -min(gaps, default=0.0))


def press(h: float, repeat: bool) -> tuple[float, float, rr.Rods]:
    """Crossing rods pushed against each other turn: largest overlap, last force, last state."""
    rods = rr.make_rods([[-5.0, 0, 0], [0, 3, 2.0]], [X, Y + 0.2 * X], 10.0)
    load = np.array([50.0, -50.0])[:, None] * Z
    deepest = 0.0
    for _ in range(round(4.0 / h)):
        step = un.step_rods(rods, STILL, h, HARD, load, repeat)
        rods = step.rods
        deepest = max(deepest, overlap(rods))
        # Equal rods, opposite forces: the mean of the centers stays.
        assert np.abs(rods.center.mean(axis=0) - [-2.5, 1.5, 1.0]).max() < 1e-12
    return deepest, float(step.force.max()), rods


def test_order_in_time_of_contact() -> None:
    """Motion and force are first order, the overlap is second, far less with a second push."""
    runs = [press(h, False) for h in (0.4, 0.2, 0.1)]
    assert runs[0][0] / runs[1][0] == pytest.approx(4.0, rel=0.05)
    assert runs[1][0] / runs[2][0] == pytest.approx(4.0, rel=0.05)
    moved = [np.abs(a[2].axis - b[2].axis).max() for a, b in ((runs[0], runs[1]), runs[1:])]
    assert moved[0] / moved[1] == pytest.approx(2.0, rel=0.3)
    again = press(0.2, True)
    assert again[0] < 1e-4 * runs[1][0]
    assert again[1] == pytest.approx(runs[1][1], rel=1e-6)


def test_pair_passing_in_shear() -> None:
    """Two rods carried against each other touch, push and part; no overlap, and mirror motion."""
    center = np.array([[-5.0, 0.5, -0.8], [5.0, -0.5, 0.8]])
    axis = np.array([[0.3, 1.0, 0.2], [-0.3, 1.0, -0.2]])
    ends = []
    for h in (0.2, 0.1, 0.05):
        rods, pushed = rr.make_rods(center, axis, 12.0), 0.0
        for _ in range(round(6.0 / h)):
            step = un.step_rods(rods, -SHEAR, h, HARD)
            rods = step.rods
            pushed = max(pushed, float(max(step.force, default=0.0)))
            assert overlap(rods) < 1e-9
            assert np.abs(rods.center.mean(axis=0)).max() < 1e-11
        assert pushed > 10.0
        ends.append(rods.center[0])
    free = rr.map_rods(rr.make_rods(center, axis, 12.0), -SHEAR, 6.0).center[0]
    assert np.abs(ends[2] - free).max() > 0.1
    assert np.abs(ends[2] - ends[1]).max() < 0.7 * np.abs(ends[1] - ends[0]).max()


def test_cluster_in_shear() -> None:
    """Ten rods through each other's way: hardly an overlap, and one motion with both solvers."""
    rng = np.random.default_rng(11)
    rods = random_rods(rng, 1, 9.0)
    while len(rods.center) < 10:
        more = random_rods(rng, 1, 9.0)
        both = rods._replace(
            center=np.concatenate([rods.center, more.center]),
            axis=np.concatenate([rods.axis, more.axis]),
            beads=np.concatenate([rods.beads, more.beads]),
        )
        rods = both if overlap(both) == 0.0 else rods
    ends, loaded = [], 0
    for solver in (un.sweep_tightly, lambda dual: du.solve_gradients(dual, 1e-9)):
        now = rods
        for _ in range(30):
            step = un.step_rods(now, SHEAR, 0.05, un.Obstacles(solver=solver))
            now = step.rods
            loaded = max(loaded, int((step.force > 1e-9).sum()))
            assert overlap(now) < 0.02
        ends.append(now)
    assert loaded >= 3
    assert np.abs(ends[0].center - ends[1].center).max() < 1e-6
    # Equal rods: the mean of the centers is carried as if there were no contact.
    mean = rods.center.mean(axis=0)
    assert np.abs(ends[0].center.mean(axis=0) - mean - 1.5 * SHEAR @ mean).max() < 1e-11


def test_images_carry_the_flow() -> None:
    """A pair across the sheared face is the pair inside, moved by a box vector."""
    lattice = np.array([[30.0, 0, 4.0], [0, 30.0, 0], [0, 0, 30.0]])
    # The normal is not across the flow, so the image approaches by its own motion as well.
    normal = np.array([-0.5, 0.0, 1.0]) / math.sqrt(1.25)
    first = np.array([0.0, 0.0, 14.2])
    second = first + 2.1 * normal + 0.5 * Y
    inside = rr.make_rods([first, second], [Y, X + 0.5 * Z], 8.0)
    moved = inside._replace(center=inside.center - np.array([[0, 0, 0], [4.0, 0, 30.0]]))
    near = un.Obstacles(search=1.0)
    plain = un.step_rods(inside, SHEAR, 0.1, near, np.array([[0, 0, 90.0], [0, 0, -90.0]]))
    boxed = un.step_rods(
        moved, SHEAR, 0.1, un.Obstacles(search=1.0, lattice=lattice),
        np.array([[0, 0, 90.0], [0, 0, -90.0]]),
    )  # fmt: skip
    assert max(plain.force) > 1.0
    assert sorted(plain.force) == pytest.approx(sorted(boxed.force), abs=1e-9)
    box = lattice + 0.1 * SHEAR @ lattice
    back = boxed.rods.center + np.outer([0, 1], box[:, 2])
    assert np.abs(back - plain.rods.center).max() < 1e-10
    assert np.abs(boxed.rods.axis - plain.rods.axis).max() < 1e-11


def test_exponential_law() -> None:
    """The force is the law at the gap it makes, also stiff; one row and many."""
    for base in (-1.0, -0.1, 0.0, 9e-4, 0.00099999):
        for slope in (1e-6, 1e-2, 10.0):
            f = du.exponential_force(base, slope, 1000.0, 50.0, 1.0)
            gap = base + slope * f
            law = 1000.0 * math.exp(-50.0 * gap / 2.0)
            assert f > 0.0 and gap <= 0.001 + 1e-15
            if gap < 0.001 - 1e-12:
                assert f == pytest.approx(law, rel=1e-9)
            else:
                assert f <= law * (1.0 + 1e-9)
    assert du.exponential_force(0.001, 0.1, 1000.0, 50.0, 1.0) == 0.0
    dual = random_dual(np.random.default_rng(9), False, 0.0)
    found = du.solve_exponential(dual, 1000.0, 50.0, 1.0, 1e-13)
    gap = dual.gap + dual.h * (dual.free + dual.delassus @ found.force)
    for f, g in zip(found.force, gap, strict=True):
        if f == 0.0:
            assert g >= 0.001 - 1e-9
        elif g < 0.001 - 1e-9:
            assert f == pytest.approx(1000.0 * math.exp(-25.0 * g), rel=1e-5)
