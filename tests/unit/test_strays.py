"""A list that holds although a few segments left their listed lines: none of them meets another.

Tolerance: none; pairs that are nearer to the reach than rounding do not occur in these cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.cell import Kind, bent_fiber
from tests.reference.segments import find_pairs
from tests.row_cell import RowCell, Start, never, row_cell
from warpfiber.passes.contact_check import ContactCheck
from warpfiber.passes.executor import Executor
from warpfiber.passes.native_strays import FEWEST, WARY, most_strays

REACH, SKIN, EDGE, COUNT = 2.5, 1.0, 60.0, 320
BOX = {"size": [EDGE] * 3, "boundary": ["periodic"] * 3}


def cell_of(start: Start, precision: str, kind: Kind, lattice: np.ndarray, count: int) -> RowCell:
    """Fibers at random in a sheared box, with a list of this skin."""
    rng = np.random.default_rng(7)
    fibers = [bent_fiber(kind, rng, EDGE * rng.random(3)) for _ in range(count)]
    cell = row_cell(
        start, (kind,), fibers, [0] * count, precision=precision, reach=REACH, lattice=lattice,
        box=BOX,
    )  # fmt: skip
    cell.pairs.set_skin(SKIN)
    cell.pairs.build()
    return cell


def checked(cell: RowCell, nodes: np.ndarray) -> ContactCheck:
    """The check after its look at the list for these positions."""
    model, state = cell.sim.model, cell.sim.state
    check = ContactCheck(
        model,
        state,
        cell.pairs,
        node_back=cell.node_back,
        lattice_back=cell.lattice_back,
        lattice_now=cell.lattice_now,
    )
    moved = wp.array(nodes.astype(model.precision.numpy), dtype=model.precision.vec3)
    still = wp.array(np.eye(3)[None], dtype=wp.mat33d)
    executor = Executor(check.list_launches(moved, still, np.zeros(3)), "cpu")
    executor.run(1, never)
    executor.close()
    return check


def unlisted(cell: RowCell, nodes: np.ndarray, lattice: np.ndarray) -> float:
    """Least distance of an unlisted pair, as far as a stray is looked at; else infinite."""
    listed = {(i, j, *(int(n) for n in image)) for i, j, image in cell.listed()}
    rest = cell.sim.model.group_rows[0]["rest"]
    starts = cell.sim.fiber_node_start
    reach = REACH + WARY * SKIN
    near = find_pairs(nodes, starts, reach, radius=1.0, rest_length=rest, lattice=lattice)
    missed = [pair.distance for pair in near if (pair.i, pair.j, *pair.shift) not in listed]
    return min(missed, default=np.inf)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("kind", [Kind(1, 6.0), Kind(3, 3.0)], ids=["rods", "chains"])
def test_few_strays_end_a_list_only_where_they_meet(
    start: Start, precision: str, kind: Kind
) -> None:
    lattice = np.diag([EDGE] * 3)
    lattice[0, 2] = 0.3 * EDGE
    cell = cell_of(start, precision, kind, lattice, COUNT)
    built = cell.sim.state.list_pos.numpy().astype(float)
    first = np.asarray(cell.sim.fiber_node_start)
    rng = np.random.default_rng(1)
    ends = []
    for _ in range(12):
        nodes = built + 0.1 * rng.uniform(-1.0, 1.0, built.shape)
        for fiber in rng.choice(COUNT, 4, replace=False):
            push = rng.normal(size=3)
            nodes[first[fiber] : first[fiber + 1]] += 1.5 * push / np.linalg.norm(push)
        found = checked(cell, nodes)
        short, share = bool(found.list_short.numpy()[0]), float(found.list_share.numpy()[0])
        missed = unlisted(cell, nodes, lattice)
        assert short == (missed <= REACH)
        if not short:
            assert (share == 2.0) == (missed < np.inf)
        ends.append((short, share == 2.0))
    assert {(False, False), (True, True)} <= set(ends)


def test_what_strays_do_does_not_choose_the_next_list(start: Start) -> None:
    cell = cell_of(start, "float64", Kind(1, 6.0), np.diag([EDGE] * 3), COUNT)
    built = cell.sim.state.list_pos.numpy().astype(float)
    axis = built[1] - built[0]
    axis /= np.linalg.norm(axis)
    nodes = built.copy()
    nodes[:2] += 2.0 * axis
    slid, across, limit = checked(cell, nodes).list_use.numpy()[0]
    assert slid == 0.0
    assert across == limit == pytest.approx(0.5 * SKIN)


@pytest.mark.parametrize("case", ["many", "lost", "small box", "few segments"])
def test_other_strays_end_the_list(start: Start, case: str) -> None:
    count = FEWEST - 1 if case == "few segments" else COUNT
    kind = Kind(1, 14.0) if case == "small box" else Kind(1, 6.0)
    cell = cell_of(start, "float64", kind, np.diag([EDGE] * 3), count)
    built = cell.sim.state.list_pos.numpy().astype(float)
    nodes: Any = built.copy()
    assert not checked(cell, nodes).list_short.numpy()[0]
    strays = most_strays(count) + 1 if case == "many" else 1
    nodes[: 2 * strays] += np.nan if case == "lost" else 0.4
    assert checked(cell, nodes).list_short.numpy()[0]
    if case == "many":
        nodes[:2] = built[:2]
        missed = unlisted(cell, nodes, np.diag([EDGE] * 3))
        assert checked(cell, nodes).list_short.numpy()[0] == (missed <= REACH)
