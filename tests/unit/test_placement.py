"""Placement: no overlap (checked by another formula), orientation moments, faults, determinism.

Tolerances: distances to rounding; moments of raw draws to five standard errors, of matched samples
to what relaxation turns.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from warpfiber.placement import Placement, overlap_of, place_fibers
from warpfiber.placement.capsules import Capsules, near_pairs
from warpfiber.placement.insertion import Crowd
from warpfiber.placement.orientations import (
    orientation_tensor,
    values_from_tensor,
)
from warpfiber.placement.space import Cell
from warpfiber.scene import Scene, SceneError, scene_from_dict

DIAMETER = 1e-5
PERIODIC = ("periodic", "periodic", "periodic")
ALONG = {"orientation": "aligned", "direction": [1, 1, 0]}
SHEAR_CELL = ("periodic", "periodic", "wall")


def made_scene(
    *groups: dict[str, Any],
    edge: float | tuple[float, float, float] | None = 5e-4,
    boundary: tuple[str, str, str] = PERIODIC,
    law: str = "exponential",
    segments: int | list[int] | None = 3,
    seed: int = 1,
) -> Scene:
    """A scene with these fiber groups; edge (m), None = no box."""
    common = {"diameter": DIAMETER, "density": 4e9, "youngs_modulus": 1e9}
    tables: dict[str, Any] = {
        "seed": seed,
        "flow": {"kind": "simple_shear", "shear_rate": 100.0, "viscosity": 100.0},
        "fibers": [{**common, **group} for group in groups],
        "contact": {"law": law},
        "stage": [{"kind": "flow", "end_strain": 1.0}],
        "numerics": {"method": "bead_chain"},
    }
    if segments is not None:
        tables["numerics"]["segments"] = segments
    if edge is not None:
        size = [edge] * 3 if isinstance(edge, float) else list(edge)
        tables["box"] = {"size": size, "boundary": list(boundary)}
    return scene_from_dict(tables)


def cube_edge(count: int, aspect_ratio: float, volume_fraction: float) -> float:
    """Edge of the cube (m) that `count` fibers fill to this volume fraction."""
    volume = count * 0.25 * np.pi * DIAMETER**3 * aspect_ratio
    return float((volume / volume_fraction) ** (1.0 / 3.0))


def ends(placed: Placement) -> tuple[np.ndarray, np.ndarray]:
    """First and last node of every fiber (m), checking that the nodes lie evenly between them."""
    start = placed.fiber_node_start
    first, last = placed.node_pos[start[:-1]], placed.node_pos[start[1:] - 1]
    for f in range(len(start) - 1):
        nodes = placed.node_pos[start[f] : start[f + 1]]
        even = first[f] + np.linspace(0.0, 1.0, len(nodes))[:, None] * (last[f] - first[f])
        np.testing.assert_allclose(nodes, even, atol=1e-12)
    return first, last


def point_distance(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of points x from segments a b."""
    t = np.sum((x - a) * (b - a), axis=-1) / np.sum((b - a) ** 2, axis=-1)
    return np.linalg.norm(x - a - np.clip(t, 0.0, 1.0)[..., None] * (b - a), axis=-1)


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance of segments a b and c d: four end distances, or the lines' own."""
    best = np.minimum(point_distance(a, c, d), point_distance(b, c, d))
    best = np.minimum(best, np.minimum(point_distance(c, a, b), point_distance(d, a, b)))
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    det = uu * vv - uv**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (uv * (v * w).sum(-1) - vv * (u * w).sum(-1)) / det
        t = (uu * (v * w).sum(-1) - uv * (u * w).sum(-1)) / det
    inside = (det > 1e-12 * uu * vv) & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    s, t = np.where(inside, s, 0.0), np.where(inside, t, 0.0)
    line = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    return np.where(inside, line, best)


def assert_apart(scene: Scene, placed: Placement, images: int = 1) -> None:
    """No two fibers closer than the bar, all images within `images` boxes, own ones included."""
    a, b = ends(placed)
    radius = np.array([scene.fibers[g].radius for g in placed.fiber_group])
    i, j = np.triu_indices(len(a))
    periodic = (
        [kind == "periodic" for kind in scene.box.boundary] if scene.box else [False, False, False]
    )
    size = np.array(scene.box.size if scene.box else (0.0, 0.0, 0.0))
    ranges = [range(-images, images + 1) if is_periodic else range(1) for is_periodic in periodic]
    # Straight fibers far apart by their bounding spheres need no exact distance.
    middle, reach = 0.5 * (a + b), 0.5 * np.linalg.norm(b - a, axis=1) + 2 * radius
    for shift in product(*ranges):
        offset = np.array(shift) * size
        near = np.linalg.norm(middle[i] - middle[j] - offset, axis=1) < reach[i] + reach[j]
        near &= (i != j) | np.any(np.array(shift) != 0)
        m, n = i[near], j[near]
        distance = segment_distance(a[m], b[m], a[n] + offset, b[n] + offset)
        assert np.all(distance >= (radius[m] + radius[n]) * (1.0 + 1e-3))
    if scene.box is not None:
        for k, kind in enumerate(scene.box.boundary):
            if kind == "wall":
                low = np.minimum(np.minimum(a, b), size - np.maximum(a, b))[:, k]
                assert np.all(low >= radius * (1.0 + 1e-3))


def tensor_of(placed: Placement, group: int = 0) -> np.ndarray:
    a, b = ends(placed)
    p = ((b - a) / np.linalg.norm(b - a, axis=1)[:, None])[placed.fiber_group == group]
    return np.asarray(orientation_tensor(p))


# ------------------------------------------------------------------------------------- packing


def test_shear_cell_of_446_fibers() -> None:
    scene = made_scene({"aspect_ratio": 20, "volume_fraction": 0.056}, boundary=SHEAR_CELL)
    placed = place_fibers(scene)
    assert len(placed.fiber_group) == 446
    assert placed.node_pos.shape == (446 * 4, 3)
    assert placed.node_pos.dtype == np.float64
    assert placed.fiber_node_start.dtype == placed.fiber_group.dtype == np.int32
    assert_apart(scene, placed)
    np.testing.assert_allclose(tensor_of(placed), np.eye(3) / 3.0, atol=1e-9)
    middle = 0.5 * sum(ends(placed))
    # Centers are uniform: five standard errors of their mean.
    assert np.all(np.abs(middle.mean(axis=0) - 2.5e-4) < 5 * 5e-4 / np.sqrt(12 * 446))


@pytest.mark.parametrize("boundary", [PERIODIC, SHEAR_CELL, ("wall", "wall", "wall")])
def test_crowded_cell_is_relaxed(boundary: tuple[str, str, str]) -> None:
    edge = cube_edge(300, 30, 0.12)
    fraction = 0.12 if boundary == PERIODIC else 0.10
    scene = made_scene(
        {"aspect_ratio": 30, "volume_fraction": fraction}, edge=edge, boundary=boundary
    )
    placed = place_fibers(scene)
    assert_apart(scene, placed)
    np.testing.assert_allclose(tensor_of(placed), np.eye(3) / 3.0, atol=0.02)


def test_random_insertion_stalls_at_crowding_5() -> None:
    scene = made_scene({"aspect_ratio": 50, "volume_fraction": 0.1}, edge=cube_edge(300, 50, 0.1))
    placed = place_fibers(scene)
    assert placed.report["inserted_overlapping"] > 0
    assert placed.report["relaxations"] > 0
    assert_apart(scene, placed, images=2)
    np.testing.assert_allclose(tensor_of(placed), np.eye(3) / 3.0, atol=0.01)


def test_fibers_longer_than_the_box() -> None:
    scene = made_scene({"aspect_ratio": 60, "count": 12}, edge=4e-4)
    placed = place_fibers(scene)
    assert_apart(scene, placed, images=3)


def test_groups_of_different_fibers() -> None:
    scene = made_scene(
        {"aspect_ratio": 5, "count": 300, "diameter": 2e-5},
        {"aspect_ratio": 30, "count": 200, "orientation": "planar"},
        edge=4e-4,
        boundary=("periodic", "open", "wall"),
        segments=[2, 4],
    )
    placed = place_fibers(scene)
    assert list(placed.fiber_group) == [0] * 300 + [1] * 200
    assert list(np.diff(placed.fiber_node_start)) == [3] * 300 + [5] * 200
    assert_apart(scene, placed)
    assert abs(tensor_of(placed, 1)[2, 2]) < 1e-20


def test_dense_aligned_fibers_stay_aligned() -> None:
    scene = made_scene(
        {
            "aspect_ratio": 20,
            "volume_fraction": 0.45,
            "orientation": "aligned",
            "direction": [1, 1, 0],
        },
        edge=cube_edge(150, 20, 0.45),
    )
    placed = place_fibers(scene)
    assert placed.report["relaxations"] > 0
    assert_apart(scene, placed)
    a, b = ends(placed)
    np.testing.assert_allclose(np.cross(b - a, [1, 1, 0]), 0.0, atol=1e-14)


def test_same_seed_same_fibers() -> None:
    group = {"aspect_ratio": 30, "volume_fraction": 0.13}
    edge = cube_edge(100, 30, 0.13)
    first = place_fibers(made_scene(group, edge=edge))
    again = place_fibers(made_scene(group, edge=edge))
    other = place_fibers(made_scene(group, edge=edge, seed=2))
    assert first.report["relaxations"] > 0
    np.testing.assert_array_equal(first.node_pos, again.node_pos)
    assert not np.any(np.all(first.node_pos == other.node_pos, axis=1))


@pytest.mark.parametrize("key", ["volume_fraction", "count"])
def test_impossible_packing_names_the_number_reached(key: str) -> None:
    edge = cube_edge(60, 20, 0.6)
    scene = made_scene({"aspect_ratio": 20, key: 0.6 if key != "count" else 60}, edge=edge)
    with pytest.raises(SceneError) as caught:
        place_fibers(scene)
    (fault,) = caught.value.faults
    assert fault.key == f"fibers.0.{key}"
    assert " of 60 fibers" in fault.remedy
    assert (" was reached" in fault.remedy) == (key == "volume_fraction")


def test_law_none_accepts_overlap() -> None:
    edge = cube_edge(60, 20, 0.6)
    scene = made_scene({"aspect_ratio": 20, "volume_fraction": 0.6}, edge=edge, law="none")
    placed = place_fibers(scene)
    assert len(placed.fiber_group) == 60
    np.testing.assert_allclose(tensor_of(placed), np.eye(3) / 3.0, atol=1e-9)


# ------------------------------------------------------------------- walls, centers, directions


def test_narrow_gap_turns_fibers_into_the_plane() -> None:
    scene = made_scene(
        {"aspect_ratio": 50, "volume_fraction": 0.02},
        edge=(1e-3, 1e-3, 2e-4),
        boundary=SHEAR_CELL,
    )
    placed = place_fibers(scene)
    assert_apart(scene, placed)
    report = placed.report["groups"][0]
    assert report["directions_redrawn"] > 0
    np.testing.assert_allclose(
        report["orientation_achieved"], values_from_tensor(tensor_of(placed))
    )
    assert report["orientation_achieved"][2] < 0.1 < report["orientation_asked"][2]


def test_no_direction_fits_between_the_walls() -> None:
    group = {"aspect_ratio": 50, "count": 3, "orientation": [0, 0, 1, 0, 0, 0]}
    scene = made_scene(group, edge=(1e-3, 1e-3, 2e-4), boundary=SHEAR_CELL)
    with pytest.raises(SceneError, match="fibers.0.orientation"):
        place_fibers(scene)


def test_given_centers_are_kept() -> None:
    centers = [[1e-4, 1e-4, 1e-4], [3e-4, 1e-4, 1.2e-4], [2e-4, 2e-4, 2e-4]]
    scene = made_scene(
        {"aspect_ratio": 10, "count": 3, "position": centers},
        {"aspect_ratio": 20, "volume_fraction": 0.05},
        boundary=SHEAR_CELL,
    )
    placed = place_fibers(scene)
    a, b = ends(placed)
    np.testing.assert_allclose(0.5 * (a + b)[:3], centers, atol=1e-15)
    assert_apart(scene, placed)


def test_given_centers_hold_while_others_relax() -> None:
    edge = cube_edge(100, 30, 0.13)
    scene = made_scene(
        {"aspect_ratio": 30, "count": 1, "position": [0.5 * edge] * 3, **ALONG},
        {"aspect_ratio": 30, "count": 99},
        edge=edge,
    )
    placed = place_fibers(scene)
    assert placed.report["relaxations"] > 0
    a, b = ends(placed)
    reach = 0.5 * 29 * DIAMETER * np.sqrt(0.5) * np.array([1, 1, 0])
    np.testing.assert_allclose([a[0], b[0]], [0.5 * edge - reach, 0.5 * edge + reach])
    assert_apart(scene, placed)


def test_given_centers_in_each_others_way() -> None:
    centers = [[1e-4, 1e-4, 1e-4], [1e-4, 1e-4, 1.05e-4]]
    scene = made_scene({"aspect_ratio": 10, "count": 2, "position": centers})
    with pytest.raises(SceneError, match="fibers.0.position") as caught:
        place_fibers(scene)
    assert "fiber 1" in str(caught.value)


def test_given_center_too_near_a_wall() -> None:
    group = {"aspect_ratio": 10, "count": 1, "position": [1e-4, 1e-4, 1e-6]}
    with pytest.raises(SceneError, match="fibers.0.position"):
        place_fibers(made_scene(group, boundary=SHEAR_CELL))


def test_unbounded_fiber_is_centered() -> None:
    group = {"aspect_ratio": 50, "count": 1, "orientation": "aligned"}
    placed = place_fibers(made_scene(group, edge=None, segments=49))
    expected = np.zeros((50, 3))
    expected[:, 0] = (np.arange(50) - 24.5) * DIAMETER
    np.testing.assert_allclose(placed.node_pos, expected, atol=1e-18)


def test_unbounded_ensemble_on_one_point() -> None:
    group = {"aspect_ratio": 10, "count": 3000, "position": [[1e-3, 0, 0]]}
    placed = place_fibers(made_scene(group, edge=None, law="none"))
    a, b = ends(placed)
    np.testing.assert_allclose(0.5 * (a + b), np.tile([1e-3, 0, 0], (3000, 1)), atol=1e-15)
    np.testing.assert_allclose(tensor_of(placed), np.eye(3) / 3.0, atol=1e-9)


def test_unbounded_fibers_far_apart() -> None:
    centers = [[0, 0, 0], [1.0, 0, 0], [1.0, 3e-5, 0]]
    group = {"aspect_ratio": 10, "count": 3, "position": centers, "orientation": "aligned"}
    scene = made_scene(group, edge=None)
    placed = place_fibers(scene)
    assert_apart(scene, placed)
    assert placed.report["overlap"]["pairs"] == 0


def test_given_tensor_is_reached() -> None:
    values = [0.36, 0.59, 0.05, 0.05, 0.02, -0.01]
    scene = made_scene({"aspect_ratio": 20, "volume_fraction": 0.05, "orientation": values})
    np.testing.assert_allclose(
        values_from_tensor(tensor_of(place_fibers(scene))), values, atol=1e-9
    )


# ------------------------------------------------------------------- neighbor pairs, free lines


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
    old, new = random_capsules(40, size, rng), random_capsules(500, size, rng)
    old.radius[:20] = 0.7
    crowd = Crowd(Cell(size, mask, np.zeros(3, bool)), new)
    crowd.add(old.taken(np.arange(25)))
    crowd.add(old.taken(np.arange(25, 40)))
    expected = []
    i, j = (x.ravel() for x in np.indices((len(new), len(old))))
    tips = [c.center + s * c.half[:, None] * c.direction for c in (new, old) for s in (-1, 1)]
    for shift in product(*[range(-3, 4) if x else range(1) for x in periodic]):
        offset = np.array(shift) * size
        with np.errstate(invalid="ignore", divide="ignore"):
            d = segment_distance(tips[0][i], tips[1][i], tips[2][j] + offset, tips[3][j] + offset)
        missing = (new.radius[i] + old.radius[j]) * (1.0 + 1.001e-3) - d
        expected += [(int(i[k]), float(missing[k])) for k in np.flatnonzero(missing > 0.0)]
    row, missing = crowd.overlaps(new)
    found = sorted(zip(row.tolist(), missing.tolist(), strict=True))
    np.testing.assert_allclose(found, sorted(expected), atol=1e-12)
    blocked = np.setdiff1d(np.arange(500), crowd.voxels.passed(new.center, new.direction, new.half))
    assert len(blocked) > 100
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
    for _ in range(1000):
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
