"""Motion of flexible fibers by forces on their rows: dense solves, limits, and contact forces.

Tolerance 1e-11 of the largest value: rounding of two eliminations of well conditioned blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest
import warp as wp

from tests import contact_cell
from tests.cell import Kind, bent_fiber, straight_fiber
from tests.contact_cell import WALL, FlatRow, Solved, in_order, row_arrays, solve_rows
from tests.reference import dual as du
from tests.reference import overdamped as od
from tests.reference.bead_chain import Array
from tests.reference.contact_rows import line_rows
from tests.reference.unilateral import segment_line
from warpfiber.passes.chain_response import ChainResponse
from warpfiber.passes.unilateral import ContactLaw
from warpfiber.scene.tables import strain_rate
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
DT = 0.05
CHI = 1.0 - 1.0 / math.sqrt(2.0)
ROUGH = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])
GRADIENT = ROUGH / strain_rate(tuple(map(tuple, ROUGH)))  # rate 1: the run's units are SI
FLOW = {"kind": "gradient", "viscosity": 1.0, "gradient": GRADIENT.tolist()}
KINDS = [
    Kind(1, 9.0),
    Kind(2, 2.3),
    Kind(7, 1.0),
    Kind(6, 2.71),
    Kind(5, 3.4, modulus=2e7),
    Kind(4, 1.6, radius=1.3, modulus=30.0),
]


@pytest.fixture(params=["relaxed", "gradients"], autouse=True)
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both solvers: row after row, and passes over all rows."""
    monkeypatch.setattr(contact_cell, "RELAXES", request.param == "relaxed")
    return str(request.param)


class Response(NamedTuple):
    """Displacements (3n, 3n) and tensions (N_seg, 3n) of one fiber per node force."""

    shift: Array
    tension: Array


def dense_response(kind: Kind, form: str, x: Array, dt: float, gradient: Array) -> Response:
    """The two solves of a step that starts at x without tension, from dense matrices."""
    chain, h, c = kind.chain(), CHI * dt, (1.0 - CHI) / CHI
    fiber = od.Fiber(chain, gradient, form)
    none = np.zeros(kind.segments)
    first = od.solve_step(od.linearize(fiber, h, x, x, none))
    moved = first.node_pos - x
    problem = od.linearize(fiber, h, x + c * moved, x + moved / CHI, first.tension)
    tau = od.torque_strength(chain, np.full(kind.segments, chain.rest_length))
    across = np.eye(3) - od.outer(problem.axis)
    resist = od.drag_matrix(chain) + od.segment_sum(tau[:, None, None] * across)
    matrix, _ = od.multiplier_system(problem)
    size = x.size

    def solve(right: Array) -> Array:
        padded = np.concatenate([right, np.zeros((kind.segments, right.shape[1]))])
        solution: Array = np.linalg.solve(matrix, padded)
        return solution

    push = h * np.eye(size)
    whole = solve(push + c * resist @ solve(push)[:size])
    return Response(whole[:size], whole[size:] / h)


class Chains:
    """Fibers after one step from rest, factors kept, with the dense response of each."""

    def __init__(
        self,
        start: Start,
        kinds: Sequence[Kind],
        fibers: Sequence[Array],
        *,
        form: str = "compliant",
        dt: float = DT,
        flow: dict[str, object] | None = None,
        precision: str = "float64",
        dense: bool = True,
    ) -> None:
        self.kinds, self.dt = kinds, dt
        sim = self.sim = start(
            kinds,
            fibers,
            list(range(len(kinds))),
            numerics={"method": "overdamped", "dt": dt, "precision": precision},
            flow=flow or FLOW,
            groups={"inextensible": form == "inextensible"},
        )
        sim.method.row_stride = abs(sim.method.row_stride)
        sim.step()
        self.dense = [
            dense_response(kind, form, x, dt, GRADIENT)
            for kind, x in zip(kinds, fibers, strict=True)
            if dense
        ]
        self.response = ChainResponse(
            sim.model, sim.method.rows, sim.method.row_stride, sim.method.tension
        )

    def jacobian(self, rows: Sequence[FlatRow]) -> Array:
        """J (R, 3N)."""
        node = self.sim.model.host["segment_node"]
        jacobian = np.zeros((len(rows), self.sim.model.node_count, 3))
        for k, row in enumerate(rows):
            for segment, s, sign in ((row.i, row.s, -1.0), (row.j, row.t, 1.0)):
                if segment != WALL:
                    jacobian[k, node[segment]] += sign * (1.0 - s) * row.normal
                    jacobian[k, node[segment] + 1] += sign * s * row.normal
        return jacobian.reshape(len(rows), -1)

    def respond(self, force: Array) -> tuple[Array, Array]:
        """Displacements (N, 3) and tensions (S,) by node forces (3N,), from dense matrices."""
        shifts, tensions, begin = [], [], 0
        for kind, dense in zip(self.kinds, self.dense, strict=True):
            mine = force[begin : begin + 3 * (kind.segments + 1)]
            shifts.append(dense.shift @ mine)
            tensions.append(dense.tension @ mine)
            begin += len(mine)
        return np.concatenate(shifts).reshape(-1, 3), np.concatenate(tensions)

    def mobility(self, rows: Sequence[FlatRow]) -> Array:
        """J S J^T."""
        jacobian = self.jacobian(rows)
        columns = [self.respond(row)[0].ravel() for row in jacobian]
        product: Array = jacobian @ np.array(columns).T
        return product

    def solve(self, rows: Sequence[FlatRow], **keys: object) -> Solved:
        """The solve of the device."""
        return solve_rows(self.sim, rows, self.response, self.dt, **keys)  # type: ignore


def bent_chains(start: Start, form: str = "compliant", **keys: object) -> Chains:
    """One fiber of every kind."""
    rng = np.random.default_rng(3)
    return Chains(
        start,
        KINDS,
        [bent_fiber(kind, rng, stretch=0.002) for kind in KINDS],
        form=form,
        **keys,  # type: ignore
    )


def random_rows(segments: int, count: int, seed: int = 1, size: float = 1.0) -> list[FlatRow]:
    """Rows anywhere, some of one fiber with itself, a fifth with a wall, warm forces given."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(count):
        i, j = sorted(rng.choice(segments, 2, replace=False).tolist())
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        s, t = rng.random(2)
        partner = WALL if k % 5 == 0 else j
        force = size * rng.random()
        rows.append(FlatRow(i, partner, s, t, normal, 0.01 * rng.normal(), 0.0, force))
    return in_order(rows)


@pytest.mark.parametrize("form", ["compliant", "inextensible"])
def test_response_is_that_of_dense_matrices(start: Start, form: str) -> None:
    chains = bent_chains(start, form)
    rows = random_rows(chains.sim.model.segment_count, 60)
    got = chains.solve(rows, most=0)
    force = np.array([row.force for row in rows])
    assert (got.force == force).all()
    shift, tension = chains.respond(chains.jacobian(rows).T @ force)
    assert np.abs(shift).max() > 1e-3
    assert np.abs(got.shift - shift).max() < 1e-11 * np.abs(shift).max()
    impulse = chains.response.segment_impulse.numpy() / (CHI * DT)
    assert np.abs(impulse - tension).max() < 1e-11 * np.abs(tension).max()


def test_response_is_symmetric(start: Start) -> None:
    """F.S(G) = G.S(F) of forces on the same rows."""
    chains = bent_chains(start)
    rows = random_rows(chains.sim.model.segment_count, 40)
    jacobian = chains.jacobian(rows)
    found = []
    for seed in (5, 6):
        force = np.random.default_rng(seed).random(len(rows))
        loaded = [row._replace(force=f) for row, f in zip(rows, force, strict=True)]
        got = chains.solve(loaded, most=0)
        found.append((force, jacobian @ got.shift.ravel()))
    (f, sf), (g, sg) = found
    assert abs(f @ sg - g @ sf) < 1e-12 * np.sqrt((f @ sf) * (g @ sg))
    assert f @ sf > 0.0


def test_rigid_and_bending_modes(start: Start) -> None:
    """A stiff straight fiber moves as a rod by dt F/R; its ends give way by F/K of a beam."""
    kind = Kind(8, 3.0, modulus=1e9)
    x = straight_fiber(kind, (0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    shear = {"kind": "simple_shear", "viscosity": 1.0, "shear_rate": 1.0}  # the fiber rests in it
    chains = Chains(start, [kind], [x], flow=shear, dt=0.2, dense=False)
    up = np.array([0.0, 0.0, 1.0])
    dt = 0.2

    def shift(points: Sequence[tuple[int, float, float]]) -> Array:
        rows = [FlatRow(i, WALL, s, 0.0, -f * up, 0.0, 0.0, 1.0) for i, s, f in points]
        return chains.solve(rows, most=0).shift

    drag = 6.0 * np.pi * kind.chain().matrix
    arc = x[:, 1]
    whole = shift([(0, 0.0, 1.0), (7, 1.0, 1.0)])
    # forces on the nodes sum up to what drag takes: exact, whatever the fiber bends
    assert np.abs(drag.sum(axis=0) @ whole - 2.0 * dt * up).max() < 1e-11
    turn = shift([(0, 0.0, -1.0), (7, 1.0, 1.0)])
    # so do moments: bending and tension have none
    tau = od.torque_strength(kind.chain(), np.diff(arc))
    moment = arc @ drag @ turn[:, 2] + (tau * np.diff(arc)) @ np.diff(turn[:, 2])
    assert moment == pytest.approx(dt * (arc[-1] - arc[0]), rel=1e-9)
    # three-point bending: what K allows, but for R(z) = -(1 - 2 chi) z/(chi z)^2 of SDIRK2, 0.5 %
    # of the slowest mode, z = -1000
    bend = shift([(0, 0.0, -0.5), (3, 1.0, 1.0), (7, 1.0, -0.5)])
    stiffness = np.pi * kind.modulus / (8.0 * kind.spacing) / (2.0 * kind.spacing) ** 2
    d2 = od.second_difference(9)
    load = np.zeros(9)
    load[[0, 4, 8]] = -0.5, 1.0, -0.5
    static = np.linalg.lstsq(stiffness * d2.T @ d2, load, rcond=None)[0]
    found = bend[:, 2] - bend[0, 2]
    assert np.abs(found - (static - static[0])).max() < 1e-2 * np.abs(static).max()


class Crowd(NamedTuple):
    """Chains near one another, and the rows between their segments."""

    chains: Chains
    rows: list[FlatRow]


def crowd(start: Start, seed: int = 0, count: int = 10, **keys: object) -> Crowd:
    """Bent fibers in a small space; rows of all pairs of segments of different fibers."""
    rng = np.random.default_rng(seed)
    kinds = [Kind(5, 3.0, modulus=1e4 * 10.0 ** (k % 3)) for k in range(count)]
    fibers = [bent_fiber(kind, rng, 14.0 * rng.random(3), 0.3, 0.001) for kind in kinds]
    chains = Chains(start, kinds, fibers, **keys)  # type: ignore
    x = np.concatenate(fibers)
    node = chains.sim.model.host["segment_node"]
    fiber = chains.sim.model.host["segment_fiber"]
    lines = [segment_line(x, int(k)) for k in node]
    rows = []
    for i in range(len(lines)):
        for j in range(i + 1, len(lines)):
            if fiber[i] == fiber[j]:
                continue
            for s, t, normal, gap in line_rows(lines[i], lines[j], 1.0):
                if gap < 1.0:
                    fractions = 0.5 + 0.5 * s / lines[i].half, 0.5 + 0.5 * t / lines[j].half
                    base = 0.05 * max(gap, -1.0) - 0.02 + 0.02 * rng.normal()
                    rows.append(FlatRow(i, j, *fractions, normal, base))
    return Crowd(chains, in_order(rows))


def row_dual(crowd: Crowd, compliance: float = 0.0) -> du.Dual:
    """The dense problem, displacements for velocities."""
    soft = np.array([row.compliance for row in crowd.rows])
    base = np.array([row.base for row in crowd.rows])
    wet = soft > 0.0
    return du.make_dual(
        crowd.chains.mobility(crowd.rows),
        np.where(wet, base, 0.0),
        np.where(wet, 0.0, base),
        1.0,
        compliance,
        np.where(wet, 1.0 / np.where(wet, soft, 1.0), 0.0),
    )


@pytest.mark.parametrize("form", ["compliant", "inextensible"])
def test_contacts_of_chains(start: Start, form: str) -> None:
    """Every row keeps its sign conditions and displacements are those of Gauss-Seidel."""
    cell = crowd(start, form=form)
    got = cell.chains.solve(cell.rows, most=20000)
    dual = row_dual(cell)
    assert got.fault < 1e-9
    assert du.residual(dual, got.force) < 1.1e-9
    assert (got.force >= 0.0).all()
    assert (got.force > 0.0).sum() > 20
    expected = du.solve_sweeps(dual, 1e-12).force
    apart = got.force - expected
    d = dual.delassus
    assert apart @ d @ apart <= 2e-9 * (got.force.sum() + expected.sum())


@pytest.mark.parametrize("law", [ContactLaw("linear", 500.0), ContactLaw()])
def test_lubrication_rows_and_soft_contacts(start: Start, law: ContactLaw) -> None:
    cell = crowd(start, seed=2)
    rng = np.random.default_rng(4)
    rows = [
        row._replace(compliance=10.0 ** rng.uniform(-4.0, -2.0)) if k % 3 == 0 else row
        for k, row in enumerate(cell.rows)
    ]
    cell = Crowd(cell.chains, rows)
    got = cell.chains.solve(rows, most=20000, law=law)
    assert got.fault < 1e-9
    soft = 1.0 / law.stiffness if law.stiffness else 0.0
    balance = du.row_balance(row_dual(cell, soft), got.force)
    wet = np.array([row.compliance > 0.0 for row in rows])
    assert (got.force[wet] < 0.0).any()
    assert (got.force[~wet] >= 0.0).all()
    assert np.abs(balance[~wet & (got.force > 0.0)]).max() < 1.1e-9
    assert balance[~wet].min() > -1.1e-9


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_same_for_any_number_of_workers(start: Start, precision: str) -> None:
    found = []
    for workers in (1, 2):
        cell = crowd(start, precision=precision, dense=False)
        got = cell.chains.solve(cell.rows, workers=workers, tolerance=1e-3, most=200)
        found.append((got, cell.chains.response.segment_impulse.numpy().copy()))
    (one, impulse), (two, other) = found
    assert 1 < one.updates == two.updates < 200
    assert (one.force == two.force).all()
    assert (one.shift == two.shift).all()
    assert (impulse == other).all()


def test_apply(start: Start) -> None:
    cell = crowd(start)
    sim = cell.chains.sim
    got = cell.chains.solve(cell.rows, tolerance=1e-4)
    before = [a.numpy().copy() for a in (sim.state.node_pos, sim.method.tension)]
    velocity = sim.state.node_velocity.numpy().copy()
    cell.chains.response.apply(got.dual, 0.25).run("cpu")
    force = cell.chains.jacobian(cell.rows).T @ got.force
    shift, tension = cell.chains.respond(force)
    moved = sim.state.node_pos.numpy() - before[0]
    assert np.abs(moved - shift).max() < 1e-11
    pulled = sim.method.tension.numpy() - before[1]
    assert np.abs(pulled - tension).max() < 1e-9 * np.abs(tension).max()
    faster = sim.state.node_velocity.numpy() - velocity
    assert np.abs(faster - 0.25 * shift / DT).max() < 1e-11


def test_fibers_whose_block_has_no_room(start: Start, solver: str) -> None:
    """Some or all fibers, or ends, without: the same but for rounding."""
    cell = crowd(start, dense=False)
    found, kept = [], []
    for share in (96, 2 if solver == "relaxed" else 6, 0):
        method = cell.chains.sim.method
        response = cell.chains.response = ChainResponse(
            cell.chains.sim.model, method.rows, method.row_stride, method.tension, share
        )
        found.append(cell.chains.solve(cell.rows, most=6, tolerance=0.0))
        here = response.column_at.numpy()[: 2 * len(cell.rows)]
        if solver != "relaxed":
            here = response.block_start.numpy()[np.diff(response.end_start.numpy()) > 0]
        kept.append(int((here >= 0).sum()))
    assert kept[0] > kept[1] > kept[2] == 0
    for other in found[1:]:
        assert np.abs(other.force - found[0].force).max() < 1e-9 * found[0].force.max()
        assert np.abs(other.shift - found[0].shift).max() < 1e-11


def test_fibers_that_nothing_pushes_stay(start: Start) -> None:
    """Rows that open on their own leave no shift, whatever the solve before did."""
    cell = crowd(start)
    arrays = row_arrays(cell.chains.sim.model, cell.rows)
    pushed = cell.chains.solve(cell.rows, arrays=arrays)
    assert pushed.shift.any()
    open_rows = [row._replace(base=0.5) for row in cell.rows]
    loaded = cell.chains.solve([row._replace(force=1.0) for row in open_rows])
    assert not loaded.force.any()
    assert not loaded.shift.any()
    assert not cell.chains.response.segment_impulse.numpy().any()


def test_frozen_fibers(start: Start) -> None:
    cell = crowd(start)
    marks = np.zeros(10, np.uint8)
    marks[::4] = 1
    frozen = wp.array(marks, dtype=wp.uint8, device="cpu")
    got = cell.chains.solve(cell.rows, fiber_frozen=frozen, law=ContactLaw("linear", 200.0))
    shift = got.shift.reshape(10, 6, 3)
    assert not shift[::4].any()
    assert shift[1::4].any()
    assert got.fault < 1e-9
