"""Fibers given node by node: what is read, what is refused, and that others keep off them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warpfiber.placement import overlap_of, place_fibers, scene_cell
from warpfiber.scene import Scene, SceneError, scene_from_dict

DIAMETER = 1e-5


def file_scene(
    *groups: dict[str, Any],
    edge: float | None = 5e-4,
    walls: bool = False,
    segments: int | list[int] | None = None,
) -> Scene:
    """A scene with these fiber groups; edge (m) of a cube, None = no box."""
    common = {"diameter": DIAMETER, "density": 4e9, "youngs_modulus": 1e9}
    tables: dict[str, Any] = {
        "flow": {"kind": "simple_shear", "shear_rate": 100.0, "viscosity": 100.0},
        "fibers": [{**common, **group} for group in groups],
        "stage": [{"kind": "flow", "end_strain": 1.0}],
        "numerics": {"method": "bead_chain"},
    }
    if segments is not None:
        tables["numerics"]["segments"] = segments
    if edge is not None:
        boundary = ["periodic", "periodic", "wall" if walls else "periodic"]
        tables["box"] = {"size": [edge] * 3, "boundary": boundary}
    return scene_from_dict(tables)


def write_npz(folder: Path, node_pos: Any) -> Path:
    path = folder / "fibers.npz"
    np.savez(path, node_pos=node_pos)
    return path


def arc(count: int = 4) -> np.ndarray:
    """Bent fibers (count, 6, 3) m, 4e-5 m above each other, segments 2e-5 m long."""
    angle = 0.3 * np.arange(5)
    step = 2e-5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    chain = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
    rows = [chain + np.array([1e-4, 1e-4, 5e-5 + 4e-5 * k]) for k in range(count)]
    return np.array(rows)


def test_node_file_npz(tmp_path: Path) -> None:
    scene = file_scene({"node_file": str(write_npz(tmp_path, arc()))})
    placed = place_fibers(scene)
    np.testing.assert_array_equal(placed.node_pos, arc().reshape(-1, 3))
    np.testing.assert_array_equal(placed.fiber_node_start, [0, 6, 12, 18, 24])


def test_random_fibers_keep_off_a_node_file(tmp_path: Path) -> None:
    group = {"node_file": str(write_npz(tmp_path, arc()))}
    scene = file_scene(
        group, {"aspect_ratio": 20, "volume_fraction": 0.16}, edge=2.5e-4, segments=[5, 3]
    )
    placed = place_fibers(scene)
    np.testing.assert_array_equal(placed.node_pos[:24], arc().reshape(-1, 3))
    assert placed.report["overlap"]["pairs"] == 0
    radius = np.full(len(placed.fiber_group), 0.5 * DIAMETER * (1 + 0.999e-3))
    grown = overlap_of(placed.node_pos, placed.fiber_node_start, radius, scene_cell(scene))
    assert grown["pairs"] == 0


def test_node_file_csv(tmp_path: Path) -> None:
    path = tmp_path / "fibers.csv"
    rows = [f"{f},{x!r},{y!r},{z!r}" for f, c in enumerate(arc().tolist()) for x, y, z in c]
    path.write_text("fiber,x,y,z\n" + "\n".join(rows) + "\n")
    placed = place_fibers(file_scene({"node_file": str(path)}))
    np.testing.assert_array_equal(placed.node_pos, arc().reshape(-1, 3))


def with_nan() -> np.ndarray:
    rows = arc()
    rows[2, 3, 1] = np.nan
    return rows


def uneven() -> np.ndarray:
    rows = arc()
    rows[1, 5, 2] += 2e-5
    return rows


def crossing() -> np.ndarray:
    rows = arc()
    rows[1] = rows[0] + np.array([0.0, 0.0, 2e-6])
    return rows


@pytest.mark.parametrize(
    ("node_pos", "text"),
    [
        (with_nan(), "node 3 of fiber 2"),
        (arc()[0], r"shape \(6, 3\)"),
        (arc()[:, :1], "at least 2"),
        (arc()[:0], "no fibers"),
        (uneven(), "equally"),
        (0.1 * arc(), "shorter than the diameter"),
        (crossing(), "overlap by up to"),
        (np.array([["a"] * 3] * 4)[None], "numbers"),
        (arc() - np.array([0, 0, 4.8e-5]), "into a wall"),
    ],
)
def test_faulty_npz(tmp_path: Path, node_pos: np.ndarray, text: str) -> None:
    group = {"node_file": str(write_npz(tmp_path, node_pos))}
    with pytest.raises(SceneError, match=text) as caught:
        place_fibers(file_scene(group, walls=True))
    assert [fault.key for fault in caught.value.faults] == ["fibers.0.node_file"]


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.npz", b"not an archive", "cannot be read"),
        ("a.npz", b"", "cannot be read"),
        ("a.csv", b"", "must be fiber,x,y,z"),
        ("a.csv", b"fiber,x,y\n0,1,2\n", "must be fiber,x,y,z"),
        ("a.csv", b"fiber,x,y,z\n0,1,2\n", "3 columns"),
        ("a.csv", b"fiber,x,y,z\n0,1,2,here\n", "line 2"),
        ("a.csv", b"fiber,x,y,z\n0,0,0,0\n1,0,0,1\n0,1,0,0\n", "not together"),
        ("a.csv", b"fiber,x,y,z\n0,0,0,0\n0,1,0,0\n1,0,0,1\n1,1,0,1\n1,2,0,1\n", "3 nodes"),
        ("a.csv", b"fiber,x,y,z\n", "no fibers"),
    ],
)
def test_faulty_files(tmp_path: Path, name: str, content: bytes, text: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=text) as caught:
        place_fibers(file_scene({"node_file": str(tmp_path / name)}, edge=None))
    assert [fault.key for fault in caught.value.faults] == ["fibers.0.node_file"]


def test_node_file_against_segments(tmp_path: Path) -> None:
    group = {"node_file": str(write_npz(tmp_path, arc()))}
    with pytest.raises(SceneError, match="5 segments"):
        place_fibers(file_scene(group, segments=3))


def test_all_faulty_groups_are_named(tmp_path: Path) -> None:
    group = {"node_file": str(write_npz(tmp_path, with_nan()))}
    with pytest.raises(SceneError) as caught:
        place_fibers(file_scene(group, group))
    assert [fault.key for fault in caught.value.faults] == [
        "fibers.0.node_file",
        "fibers.1.node_file",
    ]
