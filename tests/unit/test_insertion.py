"""Neighbor pairs and free centers: against all pairs, and evenly spread.

Tolerances: distances to rounding; means and chi-square to five standard deviations.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from tests.placed import cube_edge, ends, made_scene, segment_distance
from warpfiber.placement import overlap_of, place_fibers
from warpfiber.placement.capsules import Capsules, near_pairs
from warpfiber.placement.insertion import Crowd
from warpfiber.placement.packing import SORTED_FROM, space_order
from warpfiber.placement.space import Cell


def test_near_pairs_against_all_pairs() -> None:
    rng = np.random.default_rng(3)
    n, size = 60, np.array([30.0, 20.0, 25.0])
    p = rng.normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1)[:, None]
    p[:10] = [0.0, 1.0, 0.0]
    half = rng.uniform(0.0, 14.0, n)
    capsules = Capsules(rng.uniform(-20, 20, (n, 3)), p, half, np.ones(n), np.arange(n))
    for periodic in ([True] * 3, [True, False, True], [False] * 3):
        pairs = near_pairs(capsules, 0.5, size, np.array(periodic))
        found = set()
        for i, j, shift in zip(pairs.i, pairs.j, pairs.shift, strict=True):
            found.add((int(i), int(j), *(int(x) for x in shift)))
        assert len(found) == len(pairs.i)
        a, b = capsules.center - half[:, None] * p, capsules.center + half[:, None] * p
        expected = set()
        i, j = np.triu_indices(n)
        for shift in product(*[range(-4, 5) if x else range(1) for x in periodic]):
            offset = np.array(shift) * size
            with np.errstate(invalid="ignore", divide="ignore"):
                d = segment_distance(a[i], b[i], a[j] + offset, b[j] + offset)
            for k in np.flatnonzero(d < 2.5):
                if i[k] < j[k] or (i[k] == j[k] and shift > (0, 0, 0)):
                    expected.add((int(i[k]), int(j[k]), *shift))
        assert found == expected


def test_overlap_of_known_pairs() -> None:
    a = 1.0
    rows = [[0, 0, 0], [10, 0, 0], [5, -5, 1.5], [5, 5, 1.5], [0, 0, 50], [10, 0, 50]]
    cell = Cell(None, np.zeros(3, bool), np.zeros(3, bool))
    overlap = overlap_of(np.array(rows, float), np.array([0, 2, 4, 6]), np.full(3, a), cell)
    assert overlap == pytest.approx({"pairs": 1, "maximum": 0.5, "mean": 0.5})


def random_capsules(n: int, size: np.ndarray, rng: np.random.Generator) -> Capsules:
    """Rods of half lengths up to 9 with centers in the box."""
    p = rng.normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1)[:, None]
    return Capsules(rng.random((n, 3)) * size, p, rng.uniform(0, 9, n), np.ones(n), np.arange(n))


@pytest.mark.parametrize("periodic", [(True, True, True), (True, False, False)])
def test_candidates_against_all_pairs(periodic: tuple[bool, bool, bool]) -> None:
    """Overlaps of candidates are those of the formula, and voxels reject nothing else."""
    rng = np.random.default_rng(5)
    size, mask = np.array([30.0, 20.0, 25.0]), np.array(periodic)
    old, new = random_capsules(40, size, rng), random_capsules(200, size, rng)
    old.radius[:20] = 0.7
    crowd = Crowd(Cell(size, mask, np.zeros(3, bool)), new)
    crowd.add(old.taken(np.arange(25)))
    crowd.add(old.taken(np.arange(25, 40)))
    expected = []
    i, j = (x.ravel() for x in np.indices((len(new), len(old))))
    tips = [c.center + s * c.half[:, None] * c.direction for c in (new, old) for s in (-1, 1)]
    for shift in product(*[range(-2, 3) if x else range(1) for x in periodic]):
        offset = np.array(shift) * size
        with np.errstate(invalid="ignore", divide="ignore"):
            d = segment_distance(tips[0][i], tips[1][i], tips[2][j] + offset, tips[3][j] + offset)
        missing = (new.radius[i] + old.radius[j]) * (1.0 + 1.001e-3) - d
        expected += [(int(i[k]), float(missing[k])) for k in np.flatnonzero(missing > 0.0)]
    row, missing = crowd.overlaps(new)
    found = sorted(zip(row.tolist(), missing.tolist(), strict=True))
    np.testing.assert_allclose(found, sorted(expected), atol=1e-12)
    blocked = np.setdiff1d(np.arange(200), crowd.voxels.passed(new.center, new.direction, new.half))
    assert len(blocked) > 40
    assert set(blocked) <= set(row)
    part = crowd.voxels.blocked_parts(new.center, new.direction, new.half)
    assert set(np.flatnonzero(part)) <= set(row)


def test_free_centers_are_even() -> None:
    """The centers found are free and spread over the free part of the box."""
    size = np.full(3, 40.0)
    one = np.zeros(1, dtype=np.int64)
    held = Capsules(np.array([[20.0, 20.0, 5.0]]), np.eye(3)[:1], np.full(1, 9.0), np.ones(1), one)
    loose = held.taken(one)
    loose.direction[:] = [0.6, 0.8, 0.0]
    crowd = Crowd(Cell(size, np.ones(3, bool), np.zeros(3, bool)), loose)
    rng = np.random.default_rng(1)
    z = []
    for _ in range(400):
        crowd.clear()
        crowd.add(held)
        assert len(crowd.insert(one, np.zeros(1, dtype=np.int64), rng)) == 1
        z.append(loose.center[0, 2])
    # z is across both fibers: above their layer it is uniform.
    above = np.array([x for x in z if 10.0 < x < 40.0])
    assert np.mean(above) == pytest.approx(25.0, abs=5 * 30 / np.sqrt(12 * len(above)))


def test_centers_fill_all_blocks_alike() -> None:
    """Hard particles are never more uneven than free points: chi-square to five deviations."""
    group = {"aspect_ratio": 20, "volume_fraction": 0.1}
    edge = cube_edge(2000, 20, 0.1)
    middle = 0.5 * sum(ends(place_fibers(made_scene(group, edge=edge))))
    assert len(middle) == 2000
    block = np.floor(4 * middle / edge).astype(int)
    count = np.bincount(block @ [16, 4, 1], minlength=64)
    assert np.sum((count - 2000 / 64) ** 2) / (2000 / 64) < 63 + 5 * np.sqrt(2 * 63)


def test_space_order_keeps_neighbors_together() -> None:
    """64 cells of 4 x 4 x 4: every one, and every block of 8 of them, is a run of the order."""
    rng = np.random.default_rng(3)
    center = rng.random((5000, 3)) * 4.0
    center[0], center[1] = 0.0, 4.0 - 1e-12  # cells go from the lowest point to the highest
    order = space_order(center, 1.0)
    assert (np.sort(order) == np.arange(len(center))).all()
    for width, cells in ((1.0, 64), (2.0, 8)):
        cell = np.floor(center[order] / width).astype(int) @ [1, 10, 100]
        assert np.count_nonzero(np.diff(cell)) == cells - 1


def test_space_order_halves_the_longest_edge() -> None:
    """Two workers, each with half of the numbers, meet where the box is cut and nowhere else."""
    center = np.random.default_rng(4).random((4000, 3)) * (1.0, 3.0, 0.0)
    along = center[space_order(center, 0.25), 1]
    below = along < 0.5 * (along.min() + along.max())
    assert np.count_nonzero(np.diff(below)) == 1
    assert abs(np.count_nonzero(below) - 2000) < 5 * np.sqrt(1000)  # five deviations of a half


def test_large_groups_are_sorted() -> None:
    """Neighbors in number are neighbors in space, and every direction stays with its fiber."""
    group = {"count": SORTED_FROM, "aspect_ratio": 3, "orientation": "isotropic"}
    edge = cube_edge(SORTED_FROM, 3.0, 0.02)
    placed = place_fibers(made_scene(group, edge=edge, segments=1))
    a, b = ends(placed)
    middle = 0.5 * (a + b)
    near = np.median(np.linalg.norm(np.diff(middle, axis=0), axis=1))
    assert near < 0.1 * edge  # 0.66 of the edge in random order
    assert placed.report["overlap"]["pairs"] == 0
