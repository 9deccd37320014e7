"""Shapes of fibers: Feret diameters, equal segments, refusals, and fibers placed without overlap.

Source of the numbers: closed forms of arcs and bent lines; Table 2 of the paper on fiber shape
(L_c 62.83 mm, d 2.4 mm). Tolerances: rounding.
"""

from __future__ import annotations

import dataclasses
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.placed import segment_distance
from tests.scene_text import changed, faults_of
from warpfiber.checking import check_lines
from warpfiber.placement import place_fibers
from warpfiber.placement.shapes import feret_diameter, rest_nodes
from warpfiber.scene import Scene, SceneError, Shape, scene_from_dict

LENGTH, DIAMETER = 62.83e-3, 2.4e-3


def nodes_of(segments: int = 24, length: float = LENGTH, **shape: Any) -> np.ndarray:
    return rest_nodes(Shape(**shape), length, segments, DIAMETER)


def edges(nodes: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(np.diff(nodes, axis=0), axis=1))


@pytest.mark.parametrize(
    ("curvature", "ratio"),
    [
        (2, 0.99984),
        (5, 0.99897),
        (10, 0.99589),
        (20, 0.98363),
        (44, 0.92227),
        (72, 0.80005),
        (100, 0.63664),
    ],
)
def test_s_fibers_of_the_paper(curvature: float, ratio: float) -> None:
    """D_F = (4 / kappa) sin(kappa L_c / 4) with nodes on the arcs, chords (2/k) sin(k l / 2)."""
    nodes = nodes_of(26, kind="s", curvature=curvature)
    exact = 4.0 / curvature * np.sin(curvature * LENGTH / 4.0)
    assert feret_diameter(nodes) == pytest.approx(exact, rel=1e-12)
    assert exact / LENGTH == pytest.approx(ratio, abs=6e-6)
    chord = 2.0 / curvature * np.sin(curvature * LENGTH / 26 / 2.0)
    np.testing.assert_allclose(edges(nodes), chord, rtol=1e-12)
    # Half a turn of the whole about the normal of its plane leaves an S as it is.
    np.testing.assert_allclose(nodes[::-1] * [-1, -1, 1], nodes, atol=1e-12)


def bent(corner1: float, corner2: float, dihedral: float) -> dict[str, Any]:
    keys = {"corner1": corner1, "corner2": corner2, "dihedral": dihedral}
    return {"kind": "bent", "middle": LENGTH / 2, "tip": LENGTH / 4} | keys


@pytest.mark.parametrize(
    ("shape", "ratio"),
    [
        ({"kind": "straight"}, 1.0),
        ({"kind": "u", "angle": 0.0}, np.sqrt(5.0) / 4),
        ({"kind": "u", "angle": 90.0}, np.sqrt(6.0) / 4),
        ({"kind": "u", "angle": 180.0}, np.sqrt(0.5)),
        ({"kind": "z"}, np.sqrt(0.5)),
        (bent(90, 90, 0), 0.5590),
        (bent(90, 90, 90), 0.6124),
        (bent(135, 135, 0), 0.8536),
        (bent(45, 45, 180), 0.500),
        (bent(135, 135, 180), 0.924),
    ],
)
def test_bent_fibers_of_the_paper(shape: dict[str, Any], ratio: float) -> None:
    # thin: at a sharp corner of 45 degrees fibers of 2.4 mm overlap themselves
    nodes = rest_nodes(Shape(**shape), LENGTH, 24, 1e-3)
    assert nodes.shape == (25, 3)
    assert feret_diameter(nodes) / LENGTH == pytest.approx(ratio, abs=6e-4 if ratio > 0.9 else 6e-5)
    np.testing.assert_allclose(edges(nodes), LENGTH / 24, rtol=1e-12)


def test_ring_of_the_paper() -> None:
    """Outer diameter 23 mm: centerline radius 10.3 mm, length 64.72 mm; closed, of equal chords."""
    nodes = nodes_of(26, length=64.7168e-3, kind="ring")
    assert nodes.shape == (26, 3)
    np.testing.assert_allclose(np.linalg.norm(nodes, axis=1), 10.3e-3, rtol=1e-5)
    closed = np.concatenate([nodes, nodes[:1]])
    np.testing.assert_allclose(edges(closed), 2 * 10.3e-3 * np.sin(np.pi / 26), rtol=1e-5)


def test_segments_shorter_than_the_diameter() -> None:
    """As many as have half a diameter each in bonded spheres, a whole one elsewhere."""

    def texts(segments: int, **keys: Any) -> list[str]:
        tables = changed({"numerics.segments": segments} | keys)
        tables["fibers"][0] |= {"diameter": DIAMETER, "centerline_length": 64.7168e-3}
        tables["fibers"][0].pop("aspect_ratio", None)
        return [str(fault) for fault in faults_of(tables) if "segments" in fault.key]

    ring = {"numerics.method": "bonded_spheres", "fibers.0.shape": {"kind": "ring"}}
    assert texts(27, **ring) == texts(53, **ring) == []
    (text,) = texts(54, **ring)
    assert "at most 53 = half a diameter each" in text
    assert texts(26) == []
    (text,) = texts(27)
    assert "at most 26 = one per bead" in text
    assert nodes_of(27, length=64.7168e-3, kind="ring").shape == (27, 3)


@pytest.mark.parametrize(
    "shape", [{"kind": "s", "curvature": 72.0}, {"kind": "u", "angle": 90.0}, bent(60, 120, 30)]
)
def test_from_end_to_end_along_x(shape: dict[str, Any]) -> None:
    nodes = nodes_of(**shape)
    np.testing.assert_allclose(nodes.mean(axis=0), 0.0, atol=1e-15)
    across = nodes[-1] - nodes[0]
    np.testing.assert_allclose(across[1:], 0.0, atol=1e-15)
    assert across[0] > 0.0


@pytest.mark.parametrize(
    ("segments", "shape", "text"),
    [
        (26, {"kind": "z"}, "6.5 segments from the ends"),
        (24, {"kind": "s", "curvature": 300.0}, "overlap"),
        (24, bent(45, 45, 180), "overlap"),
        (24, bent(90, 90, 0) | {"tip": 0.01}, "middle \\+ 2 tip"),
        (56, {"kind": "straight"}, "shorter than half the diameter"),
        (8, {"kind": "points", "file": "missing.csv"}, "cannot be read"),
    ],
)
def test_refused(segments: int, shape: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        nodes_of(segments, **shape)


def test_points(tmp_path: Path) -> None:
    """A file of one fiber, turned to its axis; another length or number of nodes is refused."""
    helix = nodes_of(8, **bent(100, 110, 70))
    turned = helix[:, [2, 0, 1]] + 0.5
    file = tmp_path / "fiber.npz"
    np.savez(file, node_pos=turned[None])
    got = nodes_of(8, kind="points", file=str(file))
    np.testing.assert_allclose(edges(got), edges(helix), rtol=1e-12)
    assert feret_diameter(got) == pytest.approx(feret_diameter(helix), rel=1e-12)
    with pytest.raises(ValueError, match="numerics asks for 9"):
        nodes_of(9, kind="points", file=str(file))
    with pytest.raises(ValueError, match="make them agree"):
        nodes_of(8, length=0.07, kind="points", file=str(file))


# ----------------------------------------------------------------------------------------- placing


def bed(count: int, segments: int, shape: Shape, **group: Any) -> Scene:
    """Fibers of the paper in a periodic box of 60 mm with a floor; shaped after loading."""
    keys: dict[str, object] = {
        "box.size": [0.06, 0.06, 0.15],
        "fibers.0.aspect_ratio": LENGTH / DIAMETER + 1.0,
        "fibers.0.diameter": DIAMETER,
        "fibers.0.count": count,
        "numerics.segments": segments,
    }
    scene = scene_from_dict(changed(keys | {f"fibers.0.{k}": v for k, v in group.items()}))
    fibers = dataclasses.replace(scene.fibers[0], shape=shape)
    return dataclasses.replace(scene, fibers=(fibers,))


@pytest.mark.parametrize(
    ("shape", "segments"),
    [
        (Shape(kind="s", curvature=100.0), 26),
        (Shape(kind="z"), 24),
        (Shape(kind="ring"), 26),
    ],
)
def test_bed_of_shaped_fibers(shape: Shape, segments: int) -> None:
    """All fibers keep their shape, fit between the walls and stay apart, images included."""
    scene = bed(50, segments, shape)
    placed = place_fibers(scene)
    nodes = segments + (shape.kind != "ring")
    x = placed.node_pos.reshape(50, nodes, 3)
    rest = rest_nodes(shape, LENGTH, segments, DIAMETER)
    own = np.linalg.norm(rest[:, None] - rest[None], axis=-1)
    got = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    np.testing.assert_allclose(got, np.broadcast_to(own, got.shape), atol=1e-12)
    assert x[..., 2].min() >= DIAMETER / 2 and x[..., 2].max() <= 0.15 - DIAMETER / 2
    if shape.kind == "ring":
        x = np.concatenate([x, x[:, :1]], axis=1)
    a, b = x[:, :-1].reshape(-1, 3), x[:, 1:].reshape(-1, 3)
    fiber = np.repeat(np.arange(50), segments)
    i, j = np.triu_indices(len(a))
    for shift in product((-2, -1, 0, 1, 2), (-2, -1, 0, 1, 2), (0,)):
        offset = np.array(shift) * [0.06, 0.06, 0.0]
        near = np.linalg.norm(a[i] - a[j] - offset, axis=1) < 3 * LENGTH / segments + DIAMETER
        near &= (fiber[i] != fiber[j]) | bool(np.any(offset != 0.0))
        m, n = i[near], j[near]
        distance = segment_distance(a[m], b[m], a[n] + offset, b[n] + offset)
        assert not len(distance) or distance.min() >= DIAMETER
    assert placed.report["groups"][0]["count"] == 50


def test_given_places_and_faults() -> None:
    shape = Shape(kind="s", curvature=100.0)
    centers = [[0.03, 0.03, 0.05], [0.03, 0.03, 0.10]]
    placed = place_fibers(bed(2, 26, shape, position=centers))
    middle = placed.node_pos.reshape(2, 27, 3).mean(axis=1)
    np.testing.assert_allclose(middle, centers, atol=1e-12)
    with pytest.raises(SceneError, match="fiber 1 overlaps") as caught:
        place_fibers(bed(2, 26, shape, position=[centers[0], centers[0]]))
    assert caught.value.faults[0].key == "fibers.0.position"
    with pytest.raises(SceneError, match="found a free place") as caught:
        place_fibers(bed(900, 26, shape))
    assert caught.value.faults[0].key == "fibers.0.count"
    with pytest.raises(SceneError, match="not on nodes; change segments to 24 or 28"):
        place_fibers(bed(1, 26, Shape(kind="z")))
    with pytest.raises(SceneError, match="change segments to 4"):
        place_fibers(bed(1, 2, Shape(kind="u", angle=90.0)))


def test_own_image_draws_another_direction() -> None:
    """S fibers nearly as long as the box meet their own image along x: those turn away, all fit."""
    shape = Shape(kind="s", curvature=20.0)
    along_x = [0.9, 0.08, 0.02, 0.0, 0.0, 0.0]
    placed = place_fibers(bed(8, 26, shape, orientation=along_x))
    nodes = placed.node_pos.reshape(8, 27, 3)
    across = nodes[:, -1] - nodes[:, 0]
    touch = np.linalg.norm(across - [0.06, 0.0, 0.0], axis=1)
    assert np.all(touch > DIAMETER)


def test_check_tells_the_feret_diameter() -> None:
    lines = check_lines(bed(5, 26, Shape(kind="s", curvature=100.0)))
    told = [line for line in lines if line.startswith("maximum Feret diameter")]
    assert len(told) == 1 and told[0].endswith(" 0.6366")


def test_one_fiber_without_a_box() -> None:
    scene = bed(1, 26, Shape(kind="s", curvature=100.0), position=[0.03, 0.03, 0.05])
    scene = dataclasses.replace(scene, box=None)
    assert place_fibers(scene).node_pos.shape == (27, 3)


@pytest.mark.parametrize("method", ["bead_chain", "overdamped", "rigid_rod"])
def test_methods_of_straight_fibers(method: str) -> None:
    tables = changed({"numerics.method": method, "fibers.0.shape": {"kind": "ring"}})
    tables["contact"] = {}
    faults = [fault for fault in faults_of(tables) if fault.key == "fibers.0.shape.kind"]
    assert faults and 'use kind = "straight", or node_file' in faults[0].remedy
