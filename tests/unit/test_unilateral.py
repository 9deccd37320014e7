"""Contact forces of rigid rods against dense solves of the same rows: laws, kinds of rows, workers.

Tolerance: the solve stops at a fault of 1e-9 radii. Forces themselves need not be unique (rods have
more rows than ways to move), displacements are: J^T (f - f') of two solutions within a fault t each
has a squared mobility norm of at most t (sum f + sum f').
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import warp as wp

from tests import contact_cell
from tests.cell import Kind, isotropic, straight_fiber
from tests.contact_cell import FlatRow, Solved, row_arrays, solve_rows
from tests.reference import contact_rows as cr
from tests.reference import dual as du
from tests.reference import rigid_rod as rr
from tests.reference.bead_chain import Array
from warpfiber.model import HALT
from warpfiber.passes.executor import Executor, median_times
from warpfiber.passes.rod_response import RodResponse
from warpfiber.passes.unilateral import ContactLaw
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
H = 0.05
FAULT = 1e-9
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}


@pytest.fixture(params=["relaxed", "gradients"], autouse=True)
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both solvers: row after row, and passes over all rows."""
    monkeypatch.setattr(contact_cell, "RELAXES", request.param == "relaxed")
    return str(request.param)


class Rods:
    """Random rods in a small space, their rows and the dense problem."""

    def __init__(
        self, start: Start, count: int = 30, side: float = 22.0, seed: int = 0, **keys: object
    ) -> None:
        rng = np.random.default_rng(seed)
        kinds = [Kind(1, 19.0), Kind(1, 7.5)]
        which = [k % 2 for k in range(count)]
        axis, center = isotropic(rng, count), side * rng.random((count, 3))
        fibers = [
            straight_fiber(kinds[k], p, x) for k, p, x in zip(which, axis, center, strict=True)
        ]
        numerics = {"method": "overdamped", **keys}
        self.sim = start(kinds, fibers, which, numerics=numerics, flow=SHEAR)
        self.rods = rr.make_rods(center, axis, [kinds[k].aspect_ratio for k in which])
        rows = cr.rod_rows(self.rods, 2.5)
        rows += cr.wall_rows(self.rods, (0.0, 0.0, 2.0), (0.0, 0.0, 1.0), 1.0)
        self.rows = sorted(rows, key=lambda row: (row.i, row.j == cr.WALL, row.j))
        gaps = np.array([row.gap for row in self.rows])
        self.base = 0.1 * np.maximum(gaps, -1.0) - 0.02 + 0.02 * rng.normal(size=len(gaps))
        self.soft = np.zeros(len(gaps))

    def lubricate(self, every: int) -> None:
        """Makes every so many rows lubrication rows."""
        rng = np.random.default_rng(9)
        self.soft[::every] = 1e-3 * 10.0 ** rng.uniform(-2.0, 1.0, len(self.soft[::every]))

    def flat(self) -> list[FlatRow]:
        """The rows for the device."""

        def fraction(rod: int, arc: float) -> float:
            return 0.0 if rod == cr.WALL else 0.5 + 0.5 * arc / float(self.rods.half_length[rod])

        return [
            FlatRow(r.i, r.j, fraction(r.i, r.arc_i), fraction(r.j, r.arc_j), r.normal, b, c)
            for r, b, c in zip(self.rows, self.base, self.soft, strict=True)
        ]

    def mobility(self) -> Array:
        """J S J^T: displacements of a step per force."""
        jacobian = cr.rod_jacobian(self.rods, self.rows)
        product: Array = H * jacobian @ cr.rod_mobility(self.rods) @ jacobian.T
        return product

    def dual(self, compliance: float = 0.0) -> du.Dual:
        """The same with velocities: w = (J delta + lubricated base)/h, h = 1 step here."""
        wet = self.soft > 0.0
        coefficient = np.where(wet, 1.0 / np.where(wet, self.soft, 1.0), 0.0)
        free, gap = np.where(wet, self.base, 0.0), np.where(wet, 0.0, self.base)
        return du.make_dual(self.mobility(), free, gap, 1.0, compliance, coefficient)

    def shift(self, force: Array) -> Array:
        """Displacements of the ends (2F, 3) by row forces."""
        jacobian = cr.rod_jacobian(self.rods, self.rows)
        move = (H * cr.rod_mobility(self.rods) @ jacobian.T @ force).reshape(2, -1, 3)
        lever = self.rods.half_length[:, None] * move[1]
        return np.stack([move[0] - lever, move[0] + lever], axis=1).reshape(-1, 3)

    def solve(self, **keys: object) -> Solved:
        """The solve of the device."""
        return solve_rows(self.sim, self.flat(), RodResponse(self.sim.model), H, **keys)  # type: ignore


def same_displacement(got: Solved, rods: Rods, expected: Array, fault: float = FAULT) -> None:
    """J S J^T of both forces agrees as two solutions of that fault must."""
    d = rods.mobility()
    apart = got.force - expected
    assert apart @ d @ apart <= 2.0 * fault * np.abs(np.concatenate([got.force, expected])).sum()
    assert np.abs(d @ apart).max() < 1e-6


def test_shift_is_the_response_of_the_forces(start: Start) -> None:
    rods = Rods(start)
    got = rods.solve(most=3)
    expected = rods.shift(got.force)
    assert np.abs(expected).max() > 1e-3
    assert np.abs(got.shift - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("lubricated", [False, True])
def test_hard_rows(start: Start, lubricated: bool) -> None:
    rods = Rods(start)
    if lubricated:
        rods.lubricate(3)
    got = rods.solve()
    assert 0 < got.updates < 5000
    dual = rods.dual()
    assert du.residual(dual, got.force) < 1.01 * FAULT
    assert got.force[rods.soft == 0.0].min() == 0.0
    same_displacement(got, rods, du.solve_sweeps(dual, 1e-13).force)
    assert (got.force > 0.0).sum() > 20
    if lubricated:
        assert (got.force < 0.0).sum() > 5


@pytest.mark.parametrize("solver", ["gradients"], indirect=True)
def test_updates_are_those_of_the_restatement(start: Start) -> None:
    """The first updates agree to rounding, which the step sizes amplify later on."""
    rods = Rods(start)
    rods.lubricate(4)
    for most in (1, 2, 3, 6):
        got = rods.solve(most=most, tolerance=0.0)
        # the iterate of the smallest fault is kept, as there
        expected = du.solve_gradients(rods.dual(), 0.0, most)
        assert np.abs(got.force - expected.force).max() < 1e-9 * np.abs(expected.force).max()
        assert got.fault == pytest.approx(expected.residual, rel=1e-9)


def test_linear_law(start: Start) -> None:
    rods = Rods(start)
    got = rods.solve(law=ContactLaw("linear", 300.0))
    dual = rods.dual(1.0 / 300.0)
    assert du.residual(dual, got.force) < 1.01 * FAULT
    same_displacement(got, rods, du.solve_sweeps(dual, 1e-13).force)


def test_exponential_law(start: Start) -> None:
    rods = Rods(start)
    got = rods.solve(law=ContactLaw("exponential", 50.0, 50.0))
    gap = rods.base + rods.mobility() @ got.force
    acting = got.force > 0.0
    assert acting.sum() > 20
    assert (gap[~acting] > 0.001 - FAULT).all()
    edge = 50.0 * math.exp(-50.0 * 0.0005)
    at_edge = acting & (got.force <= edge)
    assert np.abs(gap[at_edge] - 0.001).max(initial=0.0) < 1.01 * FAULT
    law = -2.0 / 50.0 * np.log(got.force[acting & ~at_edge] / 50.0)
    assert len(law) > 5
    assert np.abs(gap[acting & ~at_edge] - law).max() < 1.01 * FAULT


def test_one_row_of_every_law(start: Start) -> None:
    """A single row has a scalar answer."""
    rods = Rods(start, count=2)
    normal = np.array([0.0, 0.6, 0.8])
    for base in (-0.3, 0.2):
        row = FlatRow(0, 1, 0.3, 0.9, normal, base)
        rods.rows = [cr.Row(0, 1, (2 * 0.3 - 1) * 19.0, (2 * 0.9 - 1) * 7.5, normal, base)]
        d = float(rods.mobility()[0, 0])
        for law, expected in (
            (ContactLaw(), max(0.0, -base / d)),
            (ContactLaw("linear", 40.0), max(0.0, -base / (d + 1.0 / 40.0))),
            (
                ContactLaw("exponential", 10.0, 4.0),
                du.exponential_force(base, d, 10.0, 4.0, 1.0),
            ),
        ):
            got = solve_rows(rods.sim, [row], RodResponse(rods.sim.model), H, law=law)
            assert got.force[0] == pytest.approx(expected, rel=3 * FAULT / 0.1)


def test_rows_that_stand_twice(start: Start) -> None:
    """Every row doubled: the same displacement, half the forces."""
    rods = Rods(start)
    once = rods.solve()
    rows = [row for row in rods.flat() for _ in range(2)]
    twice = solve_rows(rods.sim, rows, RodResponse(rods.sim.model), H)
    same_displacement(once, rods, twice.force.reshape(-1, 2).sum(axis=1))


def test_no_rows(start: Start) -> None:
    rods = Rods(start)
    arrays = row_arrays(rods.sim.model, rods.flat())
    got = rods.solve(arrays=arrays)
    assert np.abs(got.shift).max() > 0.0
    none = solve_rows(rods.sim, [], RodResponse(rods.sim.model), H)
    assert none.updates == 0
    assert none.fault == 0.0
    assert not none.shift.any()


def test_halted_step_changes_nothing(start: Start) -> None:
    rods = Rods(start)
    arrays = row_arrays(rods.sim.model, [r._replace(force=5.0) for r in rods.flat()])
    status = rods.sim.state.status.numpy()
    status[HALT] = 1
    rods.sim.state.status.assign(status)
    got = rods.solve(arrays=arrays)
    assert (got.force == 5.0).all()
    assert not got.shift.any()


def test_warm_start_of_the_solution(start: Start, solver: str) -> None:
    """A repeated solve starts from the forces found; passes over all rows accept them as is."""
    rods = Rods(start)
    cold = rods.solve()
    warm = rods.solve(repeats=2)
    assert warm.updates <= 1
    if solver == "gradients":
        assert warm.updates == 0
        assert (warm.force == cold.force).all()
        assert (warm.shift == cold.shift).all()
    same_displacement(warm, rods, cold.force)


@pytest.mark.parametrize("solver", ["gradients"], indirect=True)
def test_best_iterate_is_kept(start: Start) -> None:
    """Stopped early, forces and shifts are of the update with the smallest fault."""
    rods = Rods(start)
    faults = []
    for most in range(12):
        got = rods.solve(most=most)
        faults.append(got.fault)
        assert du.residual(rods.dual(), got.force) == pytest.approx(got.fault, rel=1e-9)
        assert np.abs(got.shift - rods.shift(got.force)).max() < 1e-12
    assert faults == sorted(faults, reverse=True)
    assert len(set(faults)) < 12  # some updates made it worse


def test_solves_that_stop_at_their_limit_are_counted(start: Start) -> None:
    rods = Rods(start)
    assert rods.solve().dual.unsolved == 0
    assert rods.solve(most=1, tolerance=1e-12, repeats=3).dual.unsolved == 3


def test_frozen_rods_do_not_move(start: Start) -> None:
    rods = Rods(start)
    frozen = np.arange(30) % 3 == 0
    marks = wp.array(frozen.astype(np.uint8), dtype=wp.uint8, device="cpu")
    got = rods.solve(fiber_frozen=marks, law=ContactLaw("linear", 300.0))
    assert not got.shift.reshape(-1, 2, 3)[frozen].any()
    mobility = cr.rod_mobility(rods.rods).reshape(2, 30, 3, 2, 30, 3)
    mobility[:, frozen] = 0.0
    jacobian = cr.rod_jacobian(rods.rods, rods.rows)
    d = H * jacobian @ mobility.reshape(180, 180) @ jacobian.T
    dual = du.make_dual(d, np.zeros(len(d)), rods.base, 1.0, 1.0 / 300.0)
    assert du.residual(dual, got.force) < 1.01 * FAULT
    assert (np.diag(d) == 0.0).any()
    # hard against a wall, nothing can give way and nothing is waited for
    row = FlatRow(0, cr.WALL, 0.0, 0.0, np.array([0.0, 0.0, -1.0]), -0.1)
    stuck = solve_rows(rods.sim, [row], RodResponse(rods.sim.model), H, fiber_frozen=marks)
    assert (stuck.updates, stuck.fault) == (0, 0.0)


def test_rod_that_meets_its_own_image(start: Start) -> None:
    """Its ends move apart by what they overlap, its middle stays."""
    rods = Rods(start)
    normal, overlap = np.array([0.6, 0.0, 0.8]), 0.1
    row = FlatRow(3, 3, 0.0, 1.0, normal, -overlap)
    got = solve_rows(rods.sim, [row], RodResponse(rods.sim.model), H)
    first, last = got.shift.reshape(-1, 2, 3)[3]
    assert normal @ (last - first) == pytest.approx(overlap, abs=1.01 * got.fault + 1e-12)
    assert np.abs(first + last).max() < 1e-12
    assert got.fault < FAULT
    assert got.updates <= 12  # a relaxation leaves a fifth: 0.1 / 5^12 < 1e-9


@pytest.mark.parametrize("solver", ["gradients"], indirect=True)
def test_sums_that_are_folded(start: Start) -> None:
    """Many chunks, as on CUDA, change nothing but the rounding of the sums."""
    rods = Rods(start)
    few = rods.solve(most=6, tolerance=0.0)
    many = rods.solve(most=6, tolerance=0.0, chunks=(500, 7))
    assert "fold_sums" in [x.name for x in many.dual.launches()[-1].launches]
    assert np.abs(few.force - many.force).max() < 1e-9 * few.force.max()
    assert rods.solve(chunks=(500, 7)).fault < FAULT


@pytest.mark.parametrize("solver", ["gradients"], indirect=True)
def test_launches_timed_apart(start: Start) -> None:
    """Replaying launch by launch repeats as often, and names every launch."""
    rods = Rods(start)
    got = rods.solve()
    arrays = got.dual.rows
    arrays.row_force.zero_()
    executor = Executor(got.dual.launches(), "cpu")
    times = median_times([executor.time_step()])
    names = ["dual_begin", "dual_lists", "dual_step", "rod_response", "dual_balance"]
    assert list(times) == names
    assert got.dual.updates == got.updates
    assert (arrays.row_force.numpy()[: len(got.force)] == got.force).all()


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_same_for_any_number_of_workers(start: Start, precision: str) -> None:
    found = []
    for workers in (1, 2, 3):
        rods = Rods(start, precision=precision)
        rods.lubricate(5)
        found.append(rods.solve(workers=workers, tolerance=1e-3, most=200))
    assert 1 < found[0].updates < 200
    for other in found[1:]:
        assert other.updates == found[0].updates
        assert (other.force == found[0].force).all()
        assert (other.shift == found[0].shift).all()


def test_single_precision(start: Start) -> None:
    """Gaps agree with float64 to the tolerance that runs take."""
    rods = Rods(start, precision="float32")
    got = rods.solve(tolerance=1e-4)
    assert got.fault < 1e-4
    # rounding of a balance: eps times the forces times the mobility of a row
    assert du.residual(rods.dual(), got.force) < 1.5e-4


def test_apply_keeps_lengths(start: Start) -> None:
    rods = Rods(start)
    got = rods.solve()
    before = rods.sim.state.node_pos.numpy().copy()
    RodResponse(rods.sim.model).apply(got.dual, 0.5).run("cpu")
    after = rods.sim.state.node_pos.numpy()
    ends = after.reshape(-1, 2, 3)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert np.abs(length - 2.0 * rods.rods.half_length).max() < 1e-13 * 40.0
    moved = (before + got.shift).reshape(-1, 2, 3)
    assert np.abs(moved.mean(axis=1) - ends.mean(axis=1)).max() < 1e-13 * 100.0
    across = np.cross(moved[:, 1] - moved[:, 0], ends[:, 1] - ends[:, 0])
    assert np.abs(across).max() < 1e-12 * 40.0**2
    velocity = rods.sim.state.node_velocity.numpy()
    assert np.abs(velocity - 0.5 * got.shift / H).max() < 1e-13
