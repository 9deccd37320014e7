"""Friction of contacts that fibers do not pass: sticking, sliding, rolling, walls, whole cells.

Source: closed forms of two crossed rods and of one on a wall; steps of dense cells against
    `reference.friction`; balances of forces, torques and energy.
Tolerance: forces are solved to TIGHT lengths, so what they do is apart by some of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, start_cell, straight_fiber
from tests.friction_cell import (
    DRAG,
    HALF,
    ROLLING,
    TURNING,
    by,
    crossed,
    loads,
    middles,
)
from tests.meeting_cell import (
    HARD,
    LAYER,
    SHEAR,
    Meeting,
    contact_rows,
    followed,
    last_rows,
    rejected,
    rod_nodes,
    rods_at,
    snapshot,
)
from tests.reference import friction as fr
from tests.reference import rigid_rod as rr
from tests.reference.bead_chain import shear_gradient
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
METHODS = [("rigid_rod", 1), ("overdamped", 3)]
TIGHT = 1e-9
DT = 0.01
PRESS = 100.0


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


@pytest.fixture(params=["relaxed", "gradients"])
def solver(request: pytest.FixtureRequest) -> str:
    """Row after row, or passes over all rows."""
    return str(request.param)


# -- two crossed rods -----------------------------------------------------------------------------

STICKING = DRAG * (2.0 / DRAG + 1.0 / ROLLING + 1.0 / TURNING)  # drag over the force that it needs


@pytest.mark.parametrize(("method", "segments"), METHODS)
@pytest.mark.parametrize("share", [0.3, 0.98])
def test_stick(start: Start, solver: str, method: str, segments: int, share: float) -> None:
    """Below the limit surfaces do not slip: the upper rod drags the lower along, and rolls."""
    friction = 0.4
    drag = np.array([share * friction * PRESS * STICKING, 0.0, 0.0])
    sim = by(crossed(start, friction, PRESS, drag, method=method, segments=segments, dt=DT), solver)
    before = middles(sim)
    sim.step()
    force, flat, _ = loads(sim)
    assert len(force) == 1
    unit = sim.model.units.force
    # chains bend under these loads, by some 1e-3 of the way
    near = 1e-6 if segments == 1 else 1e-2
    assert force[0] * unit == pytest.approx(PRESS, rel=near)
    assert flat[0] * unit == pytest.approx([-drag[0] / STICKING, 0.0, 0.0], rel=near, abs=1e-6)
    moved = (middles(sim) - before)[:, 0] / DT
    held = drag[0] / STICKING
    assert sim.method.step_report()["sliding_contacts"] == 0.0
    assert moved == pytest.approx([held / DRAG, (drag[0] - held) / DRAG], rel=near)


@pytest.mark.parametrize(("method", "segments"), METHODS)
def test_slide(start: Start, solver: str, method: str, segments: int) -> None:
    """Beyond the limit: (T - mu N)/xi, against the force whatever its direction."""
    friction = 0.4
    drag = np.array([400.0, -300.0, 0.0])
    sim = by(crossed(start, friction, PRESS, drag, method=method, segments=segments, dt=DT), solver)
    before = middles(sim)
    sim.step()
    force, flat, _ = loads(sim)
    limit = friction * float(force[0])
    assert np.linalg.norm(flat[0]) == pytest.approx(limit, rel=1e-9)
    assert sim.method.step_report()["sliding_contacts"] == 1.0
    near = 1e-6 if segments == 1 else 1e-2
    # the slip: both along x and y, of which rods roll, tilt and follow differently
    turned = 1.0 / ROLLING + 1.0 / TURNING
    pushed = flat[0] * sim.model.units.force
    slip = drag / DRAG + pushed * (2.0 / DRAG + turned)
    assert np.cross(slip, pushed)[2] == pytest.approx(0.0, abs=near * np.linalg.norm(slip) * PRESS)
    assert slip @ pushed < 0.0
    moved = (middles(sim) - before)[1] / DT
    assert moved[:2] == pytest.approx(((drag + pushed) / DRAG)[:2], rel=near)


def test_turning_of_rods(start: Start, solver: str) -> None:
    """The force acts on the surfaces: it tilts the rod along which it goes, about its middle."""
    sim = by(crossed(start, 0.4, PRESS, np.array([1000.0, 0.0, 0.0]), dt=DT), solver)
    sim.step()
    ends = sim.node_pos.reshape(2, 2, 3)
    span = ends[:, 1] - ends[:, 0]
    force = 0.4 * PRESS
    # on the lower along +x, at z = +a: a torque about +y
    assert span[0] / np.linalg.norm(span[0]) == pytest.approx(
        [1.0, 0.0, -DT * force / TURNING], abs=1e-8
    )
    assert span[1] / np.linalg.norm(span[1]) == pytest.approx([0.0, 1.0, 0.0], abs=1e-8)
    assert HALF == pytest.approx(0.5 * np.linalg.norm(span[0]))


def test_no_dissipation_below_zero_and_no_net_force(start: Start) -> None:
    """Momentum: drag of both rods balances the loads; friction takes energy out of the slip."""
    drag = np.array([250.0, 80.0, 0.0])
    sim = crossed(start, 0.3, PRESS, drag, dt=DT)
    before = middles(sim)
    sim.step()
    total = DRAG * (middles(sim) - before).sum(axis=0) / DT
    assert total == pytest.approx(drag, abs=1e-5 * PRESS)


@pytest.mark.parametrize("friction", [0.3, 1.0])
def test_rod_on_a_wall(start: Start, solver: str, friction: float) -> None:
    """Loaded across its axis it rolls where it can, and slides as a sled along its axis."""
    kind = Kind(1, HALF)
    box = {"size": [60.0, 60.0, 30.0], "boundary": ["periodic", "periodic", "wall"]}
    pushes = {"along": [60.0, 0.0, 0.0], "across": [0.0, 60.0, 0.0]}
    for name, push in pushes.items():
        rows = [
            {"node": node, "force": [0.5 * push[0], 0.5 * push[1], -0.5 * PRESS]}
            for node in (0, -1)
        ]
        fiber = straight_fiber(kind, (1.0, 0.0, 0.0), (30.0, 30.0, 1.0))
        sim = by(
            start(
                [kind],
                [fiber],
                box=box,
                load=rows,
                contact={"law": "exponential", "wall_friction": friction},
                numerics={"method": "rigid_rod", "dt": DT, "contact_tolerance": TIGHT},
            ),
            solver,
        )
        before = middles(sim)
        sim.step()
        moved = (middles(sim) - before)[0] / DT
        if name == "along":
            slid = max(0.0, 60.0 - friction * PRESS) / DRAG
            assert moved == pytest.approx([slid, 0.0, 0.0], abs=1e-6)
            continue
        # sticks where F <= mu N; rolling, v = a omega: F = T (1/xi)/(1/xi + a^2/rolling)
        held = min(60.0 * ROLLING / (ROLLING + DRAG), friction * PRESS)
        assert moved == pytest.approx([0.0, (60.0 - held) / DRAG, 0.0], abs=1e-6)


@pytest.mark.parametrize("side", [0, 1])
def test_walls_move_with_the_fluid(start: Start, side: int) -> None:
    """A rod at rest between flowing plates is dragged by the one that it is pressed to."""
    kind = Kind(1, HALF)
    height, short = 30.0, 1e-5
    at = 1.0 if side == 0 else height - 1.0
    flow = SHEAR | {"origin": [0.0, 0.0, 0.5 * height]}
    box = {"size": [60.0, 60.0, height], "boundary": ["periodic", "periodic", "wall"]}
    down = -1.0 if side == 0 else 1.0
    fiber = straight_fiber(kind, (0.0, 1.0, 0.0), (30.0, 30.0, at))
    sim = start(
        [kind],
        [fiber],
        box=box,
        flow=flow,
        load=[{"node": node, "force": [0.0, 0.0, 0.5 * down * PRESS]} for node in (0, -1)],
        contact={"law": "exponential", "wall_friction": 50.0},
        numerics={"method": "rigid_rod", "dt": short, "contact_tolerance": 1e-12},
    )
    before = middles(sim)
    sim.step()
    moved = (middles(sim) - before)[0, 0] / short
    # the middle moves as the fluid, the wall a faster, of which the spin of the fluid makes up half
    free = at - 0.5 * height
    slip = 0.5 * down
    held = slip / (1.0 / DRAG + 1.0 / ROLLING)
    assert moved == pytest.approx(free + held / DRAG, rel=1e-5)


def standing_force(friction: float) -> tuple[float, int]:
    """Push of a plate on a rod that stands across the gap against the flow; unsolved steps."""
    up, kind = 0.6, Kind(1, HALF)
    height = 2.0 * HALF * up + 2.0
    axis = (-np.sqrt(1.0 - up * up), 0.0, up)
    box = {"size": [40.0, 40.0, height], "boundary": ["periodic", "periodic", "wall"]}
    tables: dict[str, Any] = {
        "box": box,
        "flow": SHEAR,
        "contact": {"law": "exponential", "wall_friction": friction},
        "numerics": {"method": "rigid_rod", "dt": DT, "contact_tolerance": TIGHT},
    }
    sim = start_cell([kind], [straight_fiber(kind, axis, (20.0, 20.0, 0.5 * height))], **tables)
    sim.step()
    force = loads(sim)[0]
    unsolved = sim.method.contact.unsolved  # type: ignore[attr-defined]
    sim.close()
    assert len(force) == 2
    assert force[0] == pytest.approx(force[1], rel=1e-3)
    return float(force.mean()), unsolved


def test_rods_across_the_gap_lock() -> None:
    """Plates that drag its ends apart press on it the more: H p_x f = M + mu f (H p_z + a).

    From mu = H p_x/(H p_z + a) on no force balances the flow: that is told as unsolved.
    """
    free, _ = standing_force(0.0)
    across, lever = HALF * 0.8, HALF * 0.6 + 1.0
    for friction in (0.3, 0.7):
        force, unsolved = standing_force(friction)
        assert unsolved == 0
        assert force / free == pytest.approx(across / (across - friction * lever), rel=1e-6)
    assert across / lever < 1.2
    with pytest.warns(RuntimeWarning, match="not within numerics.contact_tolerance"):
        assert standing_force(1.3)[1] > 0


# -- whole cells ----------------------------------------------------------------------------------


def touches(sim: Simulation, before: Any, friction: float, walls: float) -> tuple[list, rr.Rods]:
    """The rows of the last step for the restatement, and the rods that they act on."""
    rods = rods_at(before.nodes, 10.0)
    gradient = shear_gradient(1.0)
    height = before.lattice[2, 2]
    origin = np.asarray(sim.method.flow_origin)  # type: ignore[attr-defined]
    carried = rr.map_rods(rods, gradient, 0.05, -gradient @ origin)
    spin = 0.05 * 0.5 * rods.axis[:, 1]
    lattice, later = before.lattice, np.eye(3)
    later = later + 0.05 * gradient
    found, half = [], rods.half_length
    rows = last_rows(sim)
    for i, j, s, t, n, base in zip(
        *(rows[name] for name in ("i", "j", "s", "t", "normal", "base")), strict=True
    ):
        arc_i = float((2.0 * s - 1.0) * half[i])
        at = rods.center[i] + arc_i * rods.axis[i]
        if j < 0:
            wall = height if n[2] > 0.0 else 0.0
            offset = 0.05 * gradient @ (np.array([0.0, 0.0, wall]) - origin)
            row = fr.Touch(int(i), -1, arc_i, 0.0, n, float(base), np.zeros(3), walls)
        else:
            arc_j = float((2.0 * t - 1.0) * half[j])
            apart = rods.center[j] + arc_j * rods.axis[j] - at
            image = np.rint(np.linalg.solve(lattice, 2.0 * n - apart))
            offset = (later - np.eye(3)) @ lattice @ image
            row = fr.Touch(int(i), int(j), arc_i, arc_j, n, float(base), np.zeros(3), friction)
        found.append(row._replace(slip=fr.free_slip(rods, carried, spin, row, offset)))
    return found, rods


CELLS: dict[str, dict[str, Any]] = {
    "periodic": {"box": {"size": [28.0, 27.0, 29.0]}},
    "walls": {"box": LAYER},
}


@pytest.mark.parametrize("name", CELLS)
def test_one_step_of_rods(meeting: Meeting, solver: str, name: str) -> None:
    """A dense cell: forces within Coulomb's law, and the motion of the restatement."""
    friction, walls = 0.3, 0.2
    sim = by(
        meeting(
            "rigid_rod",
            40,
            contact=HARD | {"friction": friction, "wall_friction": walls},
            numerics={"contact_tolerance": TIGHT},
            **CELLS[name],
        ),
        solver,
    )
    sim.step(3)
    pairs = sim.method.list
    assert pairs is not None
    for _ in range(40):
        before, builds, count = snapshot(sim), pairs.build_count, rejected(sim)
        sim.step()
        rows = last_rows(sim)
        loaded = rows["force"] > 0.0
        on_walls = (loaded & (rows["j"] < 0)).any() or name != "walls"
        if pairs.build_count == builds and rejected(sim) == count:
            if on_walls and loaded.sum() > 3:
                break
    else:
        raise AssertionError("no such step")
    found, rods = touches(sim, before, friction, walls)
    expected = fr.solve_friction(rods, found, 0.05)
    got = contact_rows(sim).rub.force.numpy()[: len(found)]
    limit = np.where(rows["j"] < 0, walls, friction) * rows["force"]
    sliding = np.linalg.norm(expected.slip, axis=1) > 1e-6
    assert (sliding & loaded).any()
    assert (np.linalg.norm(got, axis=1) <= limit * (1.0 + 1e-9)).all()
    assert np.abs(np.einsum("ri,ri->r", got, rows["normal"])).max() < 1e-12 * np.abs(got).max()
    # work of friction is never done on the fibers
    assert (np.einsum("ri,ri->r", got, expected.slip) <= 1e-7).all()
    carried = rr.map_rods(
        rods, shear_gradient(1.0), 0.05, -shear_gradient(1.0) @ np.asarray(sim.method.flow_origin)
    )
    axis = carried.axis + np.cross(expected.turn, rods.axis)
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    shift = rod_nodes(carried.center + expected.move, axis, rods.half_length)
    without = rod_nodes(carried.center, carried.axis, rods.half_length)
    assert np.abs(shift - without).max() > 1e-3
    assert np.abs(followed(sim, before) - shift).max() < 1e-6
