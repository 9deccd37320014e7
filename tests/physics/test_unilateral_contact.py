"""Steps with contact against restatements made from dense matrices.

Source: predictor without contact, rows at the start of the step, dual problem, response. Rods by
    `reference.unilateral`; flexible fibers by SDIRK2, their response to a constant force by two
    solves with the matrix of its second stage.
Tolerance: dual problems are solved to SOLVED lengths here; a displacement is apart by no more than
    a few of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
import warp as wp

from tests.cell import Kind
from tests.meeting_cell import (
    BOX,
    CHAINS,
    HARD,
    LAYER,
    SHEAR,
    Meeting,
    Snapshot,
    followed,
    last_rows,
    meeting_scene,
    rejected,
    rod_nodes,
    rods_at,
    snapshot,
)
from tests.reference import contact_rows as cr
from tests.reference import dual as du
from tests.reference import overdamped as od
from tests.reference import rigid_rod as rr
from tests.reference import unilateral as un
from tests.reference.bead_chain import Array, shear_gradient
from tests.reference.overdamped_step import CHI, step_sdirk2
from tests.row_cell import RowCell
from warpfiber.methods.contact import KEEP, KEEP_BENT, KEEP_RODS, NEAR_BENT
from warpfiber.placement import place_fibers
from warpfiber.simulation import Simulation

SOLVED = 1e-9
FAR = 1e3  # radii: every row that there may be
DT = 0.05
TIGHT: dict[str, Any] = {"dt": DT, "contact_tolerance": SOLVED}
AT_ORIGIN = SHEAR | {"origin": [0.0, 0.0, 0.0]}
GRADIENT = shear_gradient(1.0)
REST = {"kind": "rest", "viscosity": 1.0}


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


class Begun(NamedTuple):
    """What a step started from; tensions of flexible fibers, contact forces on packed ones."""

    at: Snapshot
    velocity: Array
    tension: Array
    load: Array


def begun(sim: Simulation) -> Begun:
    """The state now."""
    carried = sim.method.tensions()[0].numpy().copy()  # type: ignore[attr-defined]
    load = getattr(sim.method, "load", None)
    push = load.contact_load.numpy().copy() if load is not None else np.zeros(0)
    return Begun(snapshot(sim), sim.state.node_velocity.numpy().copy(), carried, push)


def one_step(sim: Simulation, walls: bool = False) -> Begun:
    """A step on the present list with loaded contacts, on walls too if asked for.

    Of packed fibers one whose motion without contact already has the forces of the last.
    """
    pairs = sim.method.list
    assert pairs is not None
    for _ in range(40):
        before, builds, count = begun(sim), pairs.build_count, rejected(sim)
        sim.step()
        rows = last_rows(sim)
        loaded = (rows["force"] > 0.0) & (rows["compliance"] == 0.0)
        on_walls = not walls or (loaded & (rows["j"] < 0)).any()
        on_walls &= len(before.load) == 0 or before.load.any()
        if pairs.build_count == builds and rejected(sim) == count and on_walls and loaded.sum() > 2:
            return before
    raise AssertionError("no such step")


# -- one step of rods -----------------------------------------------------------------------------


def walls_of(box: dict[str, Any]) -> tuple[Any, ...]:
    if "boundary" not in box:
        return ()
    return (((0, 0, 0), (0, 0, 1)), ((0, 0, box["size"][2]), (0, 0, -1)))


def lattice_of(before: Snapshot, box: dict[str, Any]) -> Array:
    """Box vectors; between walls there are no images along z."""
    lattice = before.lattice.copy()
    if "boundary" in box:
        lattice[:, 2] = (0.0, 0.0, 1e9)
    return lattice


def kicked(
    rods: rr.Rods, base: rr.Rods, rows: list[cr.Row], force: Array, h: float
) -> tuple[Array, Array]:
    """Centers and directions of `rods` moved by row forces; rows and response are of `base`."""
    response = cr.rod_mobility(base) @ cr.rod_jacobian(base, rows).T @ force
    move = h * response.reshape(2, -1, 3)
    axis = rods.axis + move[1]
    return rods.center + move[0], axis / np.linalg.norm(axis, axis=1)[:, None]


WIDE = {"size": [28.0, 27.0, 29.0]}
RODS_MEET: dict[str, dict[str, Any]] = {
    "box": {},
    "walls": {"box": LAYER},
    "lubrication": {"contact": HARD | {"lubrication": "paper"}},
    "penalty": {
        "contact": {"law": "linear", "stiffness": 300.0},
        "numerics": TIGHT | {"contact": "penalty"},
    },
    "lengths": {"kinds": (Kind(1, 9.0), Kind(1, 3.0)), "which": [0] * 20 + [1] * 20},
}


@pytest.mark.parametrize("name", RODS_MEET)
def test_one_step_of_rods(meeting: Meeting, name: str) -> None:
    """Positions after a step of a cell in which contacts are loaded."""
    keys = {"numerics": TIGHT, "box": WIDE, **RODS_MEET[name]}
    sim = meeting("rigid_rod", 40, flow=AT_ORIGIN, **keys)
    before = one_step(sim, name == "walls").at
    beads = np.array([10.0, 4.0])[sim.model.host["fiber_group"]]
    rods = rods_at(before.nodes, beads if name == "lengths" else 10.0)
    soft = keys.get("contact", {}).get("stiffness")
    obstacles = un.Obstacles(
        reach=KEEP_RODS,
        lattice=lattice_of(before, keys["box"]),
        walls=walls_of(keys["box"]),
        lubricated=name == "lubrication",
        stiffness=soft,
    )
    step = un.step_rods(rods, GRADIENT, DT, obstacles)
    free = rr.map_rods(rods, GRADIENT, DT)
    center, axis = kicked(free, rods, step.rows, step.force, DT)
    found = last_rows(sim)
    assert len(found["force"]) == len(step.rows)
    wet = found["compliance"] > 0.0
    assert (wet.sum() > 5) == (name == "lubrication")
    shift = rod_nodes(center, axis, rods.half_length)
    pushed = np.abs(shift - rod_nodes(free.center, free.axis, rods.half_length)).max()
    assert pushed > 1e-3
    assert np.abs(followed(sim, before) - shift).max() < 20.0 * SOLVED


def test_second_linearization_of_rods(meeting: Meeting) -> None:
    """Rows of the result push once more, by the response at the start of the step."""
    sim = meeting("rigid_rod", 40, flow=AT_ORIGIN, box=WIDE, numerics=TIGHT | {"linearizations": 2})
    before = one_step(sim).at
    rods = rods_at(before.nodes, 10.0)
    obstacles = un.Obstacles(reach=KEEP_RODS, lattice=before.lattice)
    first = un.step_rods(rods, GRADIENT, DT, obstacles)
    free = rr.map_rods(rods, GRADIENT, DT)
    center, axis = kicked(free, rods, first.rows, first.force, DT)
    end = snapshot(sim)
    new = rods._replace(center=center, axis=axis)
    again = cr.rod_rows(new, KEEP_RODS, GRADIENT, end.lattice)
    jacobian = cr.rod_jacobian(new, again)
    gaps = np.array([row.gap for row in again])
    delassus = jacobian @ cr.rod_mobility(rods) @ jacobian.T
    dual = du.make_dual(delassus, np.zeros(len(gaps)), gaps, DT)
    push = du.solve_sweeps(dual, 1e-13).force
    assert (push > 0.0).any()
    response = cr.rod_mobility(rods) @ jacobian.T @ push
    move = DT * response.reshape(2, -1, 3)
    turned = axis + move[1]
    expected = rod_nodes(
        center + move[0],
        turned / np.linalg.norm(turned, axis=1)[:, None],
        rods.half_length,
    )
    assert np.abs(followed(sim, before) - expected).max() < 40.0 * SOLVED


# -- one step of flexible fibers ------------------------------------------------------------------


def chain_response(
    fiber: od.Fiber, now: od.Shape, h_step: float, drift: Array, load: Array
) -> Array:
    """Displacements (3n, 3n) by constant node forces, from the matrix of the second stage."""
    h, c = CHI * h_step, (1.0 - CHI) / CHI
    x = now.node_pos
    first = od.solve_step(od.linearize(fiber, h, x, x + h * drift, now.tension, load))
    moved = first.node_pos - x
    problem = od.linearize(fiber, h, x + c * moved, x + moved / CHI, first.tension)
    matrix, _ = od.multiplier_system(problem)
    chain = fiber.chain
    tau = od.torque_strength(chain, np.full(chain.segments, chain.rest_length))
    across = np.eye(3) - od.outer(problem.axis)
    resist = od.drag_matrix(chain) + od.segment_sum(tau[:, None, None] * across)
    size = x.size

    def solve(right: Array) -> Array:
        padded = np.concatenate([right, np.zeros((chain.segments, right.shape[1]))])
        solution: Array = np.linalg.solve(matrix, padded)[:size]
        return solution

    push = h * np.eye(size)
    return solve(push + c * resist @ solve(push))


def expected_rows(
    sim: Simulation,
    before: Snapshot,
    free: Array,
    foreseen: Array | None = None,
    keep: float = KEEP,
) -> list[Any]:
    """Rows of pairs of the step from `before`, whose fibers would end at `free`.

    Those that are near where the step is `foreseen` to end, or whose free ends are near already.
    """
    lattices = sim.method.ends_lattice.numpy()  # type: ignore[attr-defined]

    def put(values: Array, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device="cpu")

    now = sim.state.node_pos.numpy().copy()
    sim.state.node_pos.assign(free)
    cell = RowCell(
        sim,
        sim.method.list,  # type: ignore[arg-type]
        put(before.nodes, wp.vec3d),
        put(lattices[:1], wp.mat33d),
        put(lattices[1:], wp.mat33d),
        sim.method.step_size,  # type: ignore[attr-defined]
    )
    found = cell.expected(keep)
    if foreseen is not None:
        sim.state.node_pos.assign(foreseen)
        near = cell.expected(keep, NEAR_BENT)
        places = {(i, j, round(row.s, 9), round(row.t, 9)) for i, j, _, row in near}
        sim.state.node_pos.assign(free)
        found = [
            (i, j, key, row)
            for i, j, key, row in cell.expected(FAR)
            if (i, j, round(row.s, 9), round(row.t, 9)) in places
        ]
    sim.state.node_pos.assign(now)
    return found


def wall_pushes(free: Array, height: float) -> list[tuple[int, Array, float]]:
    """(node, normal, predicted gap) of all nodes near the walls."""
    rows = []
    for node, y in enumerate(free):
        for normal, gap in (
            ((0, 0, -1), y[2] - 1.0),
            ((0, 0, 1), height - y[2] - 1.0),
        ):
            if gap < KEEP:
                rows.append((node, np.array(normal, float), float(gap)))
    return rows


CHAINS_MEET: dict[str, dict[str, Any]] = {
    "box": {},
    "walls": {"box": LAYER},
    "stiff": {"kinds": (Kind(3, 3.0, modulus=1e6),)},
    "inextensible": {"groups": {"inextensible": True}},
    "packed": {},
    "penalty": {
        "contact": {"law": "linear", "stiffness": 300.0},
        "numerics": TIGHT | {"contact": "penalty"},
    },
}


@pytest.mark.parametrize("name", CHAINS_MEET)
def test_one_step_of_chains(meeting: Meeting, name: str) -> None:
    """A step without contact and what the rows do to it; `packed`: on top of the last forces.

    Fibers of that cell are straight and slow, so that none is slowed or has its tension clipped.
    """
    keys = {"numerics": TIGHT, "box": BOX, "kinds": CHAINS, **CHAINS_MEET[name]}
    packed, keep = name == "packed", KEEP
    if packed:
        placed = place_fibers(meeting_scene("overdamped", 40, flow=AT_ORIGIN, **keys))
        keys["placement"] = dataclasses.replace(placed, starts_bent=True)
        keep = KEEP_BENT
    sim = meeting("overdamped", 40, flow=AT_ORIGIN, **keys)
    if packed:
        sim.method.paced = sim.method.clips = False  # type: ignore[attr-defined]
        sim.method.contact.packed = False  # type: ignore[attr-defined]
    before, drift, tension, load = one_step(sim, name == "walls")
    assert (load.size > 0) == packed
    load = load if packed else np.zeros_like(before.nodes)
    form = "inextensible" if name == "inextensible" else "compliant"
    fiber = od.Fiber(keys["kinds"][0].chain(), GRADIENT, form)
    foreseen, blocks = [], []
    for k in range(40):
        nodes, segments = slice(4 * k, 4 * k + 4), slice(3 * k, 3 * k + 3)
        now = od.Shape(before.nodes[nodes], tension[segments])
        foreseen.append(step_sdirk2(fiber, now, DT, drift[nodes], load[nodes]).shape.node_pos)
        blocks.append(chain_response(fiber, now, DT, drift[nodes], load[nodes]))
    held = np.concatenate(foreseen)
    end = np.concatenate(
        [
            foreseen[k] - (block @ load[4 * k : 4 * k + 4].ravel()).reshape(-1, 3)
            for k, block in enumerate(blocks)
        ]
    )
    rows = expected_rows(sim, before, end, held if packed else None, keep)
    node = sim.model.host["segment_node"]
    jacobian, base = [], []
    for i, j, _, row in rows:
        line = np.zeros((160, 3))
        for segment, s, sign in ((i, row.s, -1.0), (j, row.t, 1.0)):
            line[node[segment]] += sign * (1.0 - s) * row.normal
            line[node[segment] + 1] += sign * s * row.normal
        jacobian.append(line.ravel())
        base.append(row.base)
    for at, normal, gap in wall_pushes(end, 25.0) if name == "walls" else []:
        line = np.zeros((160, 3))
        line[at] = -normal
        jacobian.append(line.ravel())
        base.append(gap)
    mine = np.array(jacobian)
    response = np.zeros((480, 480))
    for k, block in enumerate(blocks):
        response[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] = block
    soft = keys.get("contact", {}).get("stiffness")
    compliance = 1.0 / soft if soft else 0.0
    dual = du.make_dual(
        mine @ response @ mine.T, np.zeros(len(base)), np.array(base), 1.0, compliance
    )
    force = du.solve_sweeps(dual, 1e-12).force
    found = last_rows(sim)
    assert len(found["force"]) == len(base)
    expected = end + (response @ mine.T @ force).reshape(-1, 3)
    assert np.abs(expected - end).max() > 1e-3
    assert np.abs(followed(sim, before) - expected).max() < 100.0 * SOLVED
