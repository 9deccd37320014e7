"""Check of a step's end: overlaps, center lines that passed through each other, list validity.

Crossings are compared with the jumps of the Gauss integral in fine steps of the time. Overlaps are
distances: float64 1e-9 (nearly parallel closest points), float32 1e-4 (eps times the box).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.cell import Kind, bent_fiber, straight_fiber
from tests.reference.crossing import crossings
from tests.reference.segments import closest_points, find_pairs
from tests.row_cell import RowCell, never, row_cell, shaken
from warpfiber.passes.contact_check import ContactCheck
from warpfiber.passes.executor import Executor
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
RODS = (Kind(1, 8.0),)
CHAINS = (Kind(3, 3.0), Kind(4, 1.5, radius=0.6))
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
BOX = {"size": [26.0, 22.0, 24.0]}


def checked(cell: RowCell, workers: int = 1, **keys: Any) -> ContactCheck:
    """The check of this cell, launched."""
    check = ContactCheck(
        cell.sim.model,
        cell.sim.state,
        cell.pairs,
        node_back=cell.node_back,
        lattice_back=cell.lattice_back,
        lattice_now=cell.lattice_now,
        **keys,
    )
    executor = Executor(check.launches(), cell.sim.model.device, workers)
    executor.run(1, never)
    executor.close()
    return check


def pair_ends(cell: RowCell) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
    """(i, j, four ends before, after) of all listed pairs."""
    node = cell.sim.model.host["segment_node"]
    before = cell.node_back.numpy().astype(float)
    after = cell.sim.state.node_pos.numpy().astype(float)
    found = []
    for i, j, image in cell.listed():
        back, now = cell.offsets(image)
        four = [node[i], node[i] + 1, node[j], node[j] + 1]
        shift = np.array([0.0, 0.0, 1.0, 1.0])[:, None]
        found.append((i, j, before[four] + shift * back, after[four] + shift * now))
    return found


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("size", [0.3, 3.0])
@pytest.mark.parametrize("kinds", [RODS, CHAINS])
def test_crossings_and_overlaps_of_random_fibers(
    start: Start, kinds: tuple[Kind, ...], size: float, precision: str
) -> None:
    rng = np.random.default_rng(1)
    which = np.arange(40) % len(kinds)
    fibers = [bent_fiber(kinds[k], rng, 22.0 * rng.random(3), spread=1.0) for k in which]
    lattice = np.diag(BOX["size"])
    later = lattice.copy()
    later[0, 2] = 1.5
    cell = row_cell(
        start,
        kinds,
        fibers,
        which,
        move=shaken(2, size),
        precision=precision,
        lattice=lattice,
        lattice_now=later,
        box=BOX,
        flow=SHEAR,
    )
    check = checked(cell)
    segments = cell.sim.model.segment_count
    crossed, overlap = np.zeros(segments, int), np.zeros(segments)
    for i, j, before, after in pair_ends(cell):
        crossed[i] += crossings(before, after) > 0
        s, t = closest_points(*after)
        apart = after[2] + t * (after[3] - after[2]) - after[0] - s * (after[1] - after[0])
        radii = cell.radius(i), cell.radius(j)
        depth = (sum(radii) - float(np.linalg.norm(apart))) / min(radii)
        overlap[i] = max(overlap[i], depth)
    assert (check.crossed.numpy() == crossed).all()
    assert crossed.sum() > (2 if size < 1.0 else 20)
    tolerance = 1e-9 if precision == "float64" else 1e-4
    assert np.allclose(check.overlap.numpy(), overlap, rtol=0.0, atol=tolerance)
    assert abs(check.largest.numpy()[0] - overlap.max()) < tolerance
    found = check.found.numpy()
    assert found[0] == crossed.sum()
    assert abs(overlap[found[1]] - overlap.max()) < tolerance
    assert found[2] >= 0 and crossed[found[3]] > 0 and found[4] > found[3]


def two_rods(start: Start, upper: np.ndarray, lower: np.ndarray, move: Any) -> ContactCheck:
    """Check of two rods of which the upper moves by `move`."""
    motion = np.zeros((4, 3))
    motion[:2] = move
    return checked(row_cell(start, RODS, [upper, lower], move=motion, reach=8.0))


def test_a_rod_that_falls_through_another_in_one_step(start: Start) -> None:
    upper = straight_fiber(RODS[0], [1, 0, 0], [0, 0, 2.5])
    lower = straight_fiber(RODS[0], [0.2, 1, 0], [0, 0, 0])
    through = two_rods(start, upper, lower, [0, 0, -5.0])
    assert through.found.numpy().tolist() == [1, 0, -1, 0, 1]
    assert through.largest.numpy()[0] == 0.0
    beside = two_rods(start, upper, lower, [0, 0, -0.5])
    assert beside.found.numpy()[0] == 0


def test_a_rod_that_passes_through_and_back_in_one_step(start: Start) -> None:
    # the volume of the four ends has one sign at both ends of the step
    upper = straight_fiber(RODS[0], [1, 0, 0], [0, 0, 1])
    lower = straight_fiber(RODS[0], [0, 1, 0], [-6.4, 0, 0])
    motion = np.array([[0, 0, -10.0], [0, 0, 10.0], [11.2, 0, 0], [11.2, 0, 0]])
    before = np.concatenate([upper, lower])
    assert crossings(before, before + motion) == 2
    check = checked(row_cell(start, RODS, [upper, lower], move=motion, reach=8.0))
    assert check.found.numpy()[0] == 1


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_rods_that_pass_through_in_a_plane(start: Start, tilt: float) -> None:
    # all in y = 0, where the volume of four points says nothing
    upper = straight_fiber(RODS[0], [1, 0, tilt], [1, 0, 6])
    lower = straight_fiber(RODS[0], [1, 0, 0], [0, 0, 0])
    through = two_rods(start, upper, lower, [0, 0, -12.0])
    assert through.found.numpy()[0] == 1
    assert two_rods(start, upper, lower, [0, 0, -1.0]).found.numpy()[0] == 0


def test_rods_that_pass_by_do_not_cross(start: Start) -> None:
    # the extended line of one is crossed beyond its end
    upper = straight_fiber(RODS[0], [1, 0, 0], [0, 0, 2.5])
    lower = straight_fiber(RODS[0], [0, 1, 0], [9.5, 0, 0])
    assert two_rods(start, upper, lower, [0, 0, -5.0]).found.numpy()[0] == 0


def test_crossing_at_a_joint_is_seen(start: Start) -> None:
    kinds = (Kind(2, 4.0), Kind(1, 6.0))
    chain = straight_fiber(kinds[0], [1, 0, 0], [0, 0, 2.5])
    rod = straight_fiber(kinds[1], [0, 1, 0], [0, 0, 0])
    motion = np.zeros((5, 3))
    motion[:3] = [0, 0, -5.0]
    cell = row_cell(start, kinds, [chain, rod], [0, 1], move=motion)
    assert checked(cell).found.numpy()[0] >= 1


def test_nodes_beyond_walls(start: Start) -> None:
    kind = (Kind(1, 3.0),)
    fibers = [straight_fiber(kind[0], [1, 0, 0], [5, 5, z]) for z in (1.5, 6.0)]
    motion = np.zeros((4, 3))
    motion[1] = [0, 0, -0.75]
    keys = {
        "box": {"size": [10.0, 10.0, 10.0], "boundary": ["periodic", "periodic", "wall"]},
        "contact": {"law": "exponential", "strength": 1.0, "decay": 2.0},
        "reach": 2.5,
    }
    check = checked(row_cell(start, kind, fibers, move=motion, **keys))
    assert abs(check.largest.numpy()[0] - 0.25) < 1e-12
    assert check.found.numpy()[:3].tolist() == [0, 0, -1]
    motion[1] = [0, 0, -2.0]
    check = checked(row_cell(start, kind, fibers, move=motion, **keys))
    assert check.found.numpy().tolist() == [1, 0, -1, 0, -1]
    assert abs(check.largest.numpy()[0] - 1.5) < 1e-12


def test_a_position_that_is_no_number_is_the_largest_overlap(start: Start) -> None:
    fibers = [straight_fiber(RODS[0], [1, 0, 0], [0, 0, z]) for z in (0.0, 3.0)]
    for node in range(4):
        motion = np.zeros((4, 3))
        motion[node, 1] = np.nan
        assert checked(row_cell(start, RODS, fibers, move=motion)).largest.numpy()[0] >= 1e29


@pytest.mark.parametrize(("stretch", "is_torn"), [(1.9, False), (2.1, True)])
def test_a_segment_that_tore_is_the_largest_overlap(
    start: Start, stretch: float, is_torn: bool
) -> None:
    """At twice its length, where that is asked for; else it is only far from the others."""
    fibers = [straight_fiber(RODS[0], (1, 0, 0), (0.0, y, 0.0)) for y in (0.0, 3.0)]
    motion = np.zeros((4, 3))
    motion[1, 0] = (stretch - 1.0) * 16.0
    cell = row_cell(start, RODS, fibers, move=motion)
    assert (checked(cell, tears=True).largest.numpy()[0] >= 1e29) == is_torn
    assert checked(cell).largest.numpy()[0] == 0.0


def test_the_check_does_not_depend_on_the_workers(start: Start) -> None:
    rng = np.random.default_rng(1)
    fibers = [bent_fiber(RODS[0], rng, 20.0 * rng.random(3)) for _ in range(40)]
    cell = row_cell(start, RODS, fibers, [0] * 40, move=shaken(2, 1.0))
    one, two = checked(cell), checked(cell, 2)
    for name in ("overlap", "overlap_partner", "crossed", "crossed_partner", "largest", "found"):
        assert (getattr(one, name).numpy() == getattr(two, name).numpy()).all(), name


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_list_that_holds_misses_nothing(start: Start, precision: str) -> None:
    rng = np.random.default_rng(3)
    fibers = [bent_fiber(RODS[0], rng, 20.0 * rng.random(3)) for _ in range(30)]
    cell = row_cell(start, RODS, fibers, [0] * 30, precision=precision, reach=2.5)
    cell.pairs.set_skin(1.0)
    cell.pairs.build()
    state, p = cell.sim.state, cell.sim.model.precision
    check = ContactCheck(
        cell.sim.model,
        state,
        cell.pairs,
        node_back=cell.node_back,
        lattice_back=cell.lattice_back,
        lattice_now=cell.lattice_now,
    )
    built = state.list_pos.numpy().astype(float)
    origin = np.array([1.0, 2.0, 3.0])
    listed = {(i, j) for i, j, _ in cell.listed()}
    held = []
    for size, shear in ((0.0, 0.0), (0.1, 0.0), (0.1, 0.2), (0.0, 0.5), (0.3, 0.0), (0.0, 1.5)):
        affine = np.eye(3)
        affine[0, 2] = shear
        kick = rng.normal(size=built.shape)
        kick *= size / np.linalg.norm(kick, axis=1)[:, None]
        nodes = origin + (built - origin) @ affine.T + kick
        moved = wp.array(nodes.astype(p.numpy), dtype=p.vec3)
        deformation = wp.array(affine[None], dtype=wp.mat33d)
        executor = Executor(check.list_launches(moved, deformation, origin), "cpu")
        executor.run(1, never)
        executor.close()
        held.append(not check.list_short.numpy()[0])
        # 2 |u| + h max row sum of |sym(F - I)| <= skin
        assert held[-1] == (2.0 * size + 3.5 * 0.5 * shear <= 1.0)
        if held[-1]:
            near = find_pairs(
                nodes, cell.sim.fiber_node_start, 2.5, radius=1.0, rest_length=RODS[0].spacing * 2
            )
            assert {(pair.i, pair.j) for pair in near} <= listed
    assert held == [True, True, True, True, True, False]


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_an_extended_list_lets_rods_slide(start: Start, precision: str) -> None:
    """Sliding up to the extension uses up no skin; beyond it, what is beyond."""
    rng = np.random.default_rng(3)
    fibers = [bent_fiber(RODS[0], rng, 20.0 * rng.random(3)) for _ in range(30)]
    cell = row_cell(start, RODS, fibers, [0] * 30, precision=precision, reach=2.5)
    cell.pairs.set_skin(0.5)
    cell.pairs.set_extension(2.0)
    cell.pairs.build()
    state, p = cell.sim.state, cell.sim.model.precision
    check = ContactCheck(
        cell.sim.model,
        state,
        cell.pairs,
        node_back=cell.node_back,
        lattice_back=cell.lattice_back,
        lattice_now=cell.lattice_now,
    )
    built = state.list_pos.numpy().astype(float)
    listed = {(i, j) for i, j, _ in cell.listed()}
    first = cell.sim.model.host["segment_node"]
    assert len(first) == 30  # rods of one segment
    axis = built[first + 1] - built[first]
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    affine = np.eye(3)
    affine[0, 2] = 0.05
    for slide, held in ((1.9, True), (2.15, True), (2.4, False)):
        nodes = built.copy()
        along = slide * np.sign(rng.random(30) - 0.5)[:, None] * axis
        nodes[first] += along
        nodes[first + 1] += along
        moved = wp.array((nodes @ affine.T).astype(p.numpy), dtype=p.vec3)
        deformation = wp.array(affine[None], dtype=wp.mat33d)
        executor = Executor(check.list_launches(moved, deformation, np.zeros(3)), "cpu")
        executor.run(1, never)
        executor.close()
        slid, across, limit = check.list_use.numpy()[0]
        assert slid == pytest.approx(slide, rel=1e-5)
        assert across < 1e-4
        assert limit == pytest.approx(0.5 * (0.5 - 3.0 * 0.025), rel=1e-5)
        # the share beyond the extension, stretched by at most 1.03
        assert held == (not check.list_short.numpy()[0])
        near = find_pairs(
            nodes, cell.sim.fiber_node_start, 2.5, radius=1.0, rest_length=RODS[0].spacing * 2
        )
        assert not held or {(pair.i, pair.j) for pair in near} <= listed
