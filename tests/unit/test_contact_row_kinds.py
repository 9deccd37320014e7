"""Rows of plane walls and of lubricated bead pairs against the NumPy restatements.

Units: a = eta = 1. Tolerances: one product of lengths below 100, so 1e-12 in float64; c to 1e-9
where 1/h magnifies the rounding of a distance up to 2000 times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber
from tests.reference import interactions as ia
from tests.row_cell import RowCell, dropped, host_rows, row_cell, shaken
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
EDGES = np.array([24.0, 20.0, 12.0])
BOX = {"size": [26.0, 22.0, 24.0]}
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}


@pytest.mark.parametrize("near", [-1e20, 1.5])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_walls(start: Start, precision: str, near: float) -> None:
    """Nodes with a small predicted gap; those with a gap below `near` at the start, too."""
    kinds = (Kind(3, 2.0), Kind(1, 3.0, radius=0.5))
    rng = np.random.default_rng(7)
    which = np.arange(40) % 2
    fibers = [bent_fiber(kinds[k], rng, EDGES * rng.random(3)) for k in which]
    cell = row_cell(
        start,
        kinds,
        fibers,
        which,
        move=shaken(8),
        precision=precision,
        box={"size": EDGES.tolist(), "boundary": ["periodic", "wall", "wall"]},
        contact={"law": "exponential", "strength": 1.0, "decay": 2.0},
    )
    got = host_rows(cell.made(near_now=near))
    host, moved = cell.sim.model.host, cell.sim.state.node_pos.numpy()
    back = cell.node_back.numpy()
    expected = []
    for i, node in enumerate(host["segment_node"]):
        fiber = host["segment_fiber"][i]
        a = cell.radius(i)
        ends = (0, 1) if node == host["fiber_node_start"][fiber] else (1,)
        for end in ends:
            for axis, edge in ((1, EDGES[1]), (2, EDGES[2])):
                for side, y in enumerate((moved[node + end][axis], edge - moved[node + end][axis])):
                    now = back[node + end][axis]
                    now = edge - now if side else now
                    if y - a < 0.5 * a or now - a < near * a:
                        normal = np.zeros(3)
                        normal[axis] = 2 * side - 1
                        expected.append((i, end, normal, y - a))
    walls = np.flatnonzero(got["j"] == -1)
    assert len(walls) == len(expected) > 8
    for r, (i, end, normal, gap) in zip(walls, expected, strict=True):
        assert (got["i"][r], got["s"][r]) == (i, end)
        assert (got["normal"][r] == normal).all()
        assert abs(got["base"][r] - gap) < 8 * np.finfo(cell.real).eps * 20.0
    assert int((got["j"] >= 0).sum()) == len(cell.expected(near_now=near))


def resistances(cell: RowCell, kind: str) -> list[tuple[int, int, float, float, float, float]]:
    """(i, j, s, t, n.w, c) of the bead pairs in range, in the order of the list."""
    found = []
    for i, j, image in cell.listed():
        back, now = cell.offsets(image)
        (side_i, motion_i), (side_j, motion_j) = (
            cell.side(i, np.zeros(3), False),
            cell.side(j, back, False),
        )
        motion_j = motion_j + (now - back)
        beads = [
            list(
                zip(
                    *ia.segment_beads(cell.group(k)["spacing"], side.following is None),
                    strict=True,
                )
            )
            for k, side in ((i, side_i), (j, side_j))
        ]
        for s, weight_i in beads[0]:
            for t, weight_j in beads[1]:
                apart = side_j.at(t) - side_i.at(s)
                distance = float(np.linalg.norm(apart))
                c = ia.lubrication_coefficient(distance, cell.radius(i), cell.radius(j), 1.0, kind)
                if c > 0.0:
                    w = (1 - t) * motion_j[0] + t * motion_j[1]
                    w = w - (1 - s) * motion_i[0] - s * motion_i[1]
                    c *= weight_i * weight_j
                    found.append((i, j, float(s), float(t), float(apart @ w) / distance, c))
    return found


@pytest.mark.parametrize("kind", ["paper", "shifted"])
@pytest.mark.parametrize("box", [None, BOX])
def test_lubrication_rows_are_the_bead_pairs(start: Start, kind: str, box: Any) -> None:
    kinds = (Kind(3, 3.4), Kind(1, 6.0, radius=0.6))
    fibers, which = dropped(kinds, 30, 9, 20.0)
    tables = {} if box is None else {"box": box}
    cell = row_cell(start, kinds, fibers, which, move=shaken(3), flow=SHEAR, **tables)
    got = host_rows(cell.made(lubrication=kind))
    wet = np.flatnonzero(got["compliance"] > 0.0)
    expected = resistances(cell, kind)
    assert len(wet) == len(expected) > 50
    for r, (i, j, s, t, approach, c) in zip(wet, expected, strict=True):
        assert (got["i"][r], got["j"][r]) == (i, j)
        assert abs(got["s"][r] - s) < 1e-12 and abs(got["t"][r] - t) < 1e-12
        assert abs(got["base"][r] - approach) < 1e-12
        assert abs(got["compliance"][r] * c / 0.1 - 1.0) < 1e-9
    dry = np.flatnonzero((got["compliance"] == 0.0) & (got["j"] >= 0))
    assert [(got["i"][r], got["j"][r]) for r in dry] == [row[:2] for row in cell.expected()]
