"""Placement: no overlap (checked by another formula), orientation moments, faults, determinism.

Tolerances: distances to rounding; moments of raw draws to five standard errors, of matched samples
to what relaxation turns.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from tests.placed import DIAMETER, PERIODIC, cube_edge, ends, made_scene, segment_distance
from warpfiber.placement import Placement, place_fibers
from warpfiber.placement.orientations import (
    orientation_tensor,
    values_from_tensor,
)
from warpfiber.scene import Scene, SceneError

ALONG = {"orientation": "aligned", "direction": [1, 1, 0]}
SHEAR_CELL = ("periodic", "periodic", "wall")


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
