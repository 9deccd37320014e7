"""Figures through the thickness: which strains they show, what is smoothed, what a section cuts."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from warpfiber.output.cut_picture import section  # noqa: E402
from warpfiber.output.folder import ResultFolder  # noqa: E402
from warpfiber.output.layer_figures import read_layers, smooth  # noqa: E402
from warpfiber.output.plots import plot_run  # noqa: E402
from warpfiber.output.scalars import ScalarsWriter  # noqa: E402
from warpfiber.output.trajectory import TrajectoryWriter  # noqa: E402

COLUMNS = ("a11", "a22", "a33", "a11_fiber", "a22_fiber", "a33_fiber", "volume_fraction")


def layered_run(tmp_path: Path, frames: int = 9) -> ResultFolder:
    """Four layers of a 1 mm box; a value is frame + layer/10, in a22 ten times that."""
    folder = ResultFolder.create(tmp_path / "run", "x")
    layer = {"thickness": 2.5e-4, "volume_fraction": 0.08, "orientation": "isotropic"}
    tables = {
        "path": str(tmp_path / "cell.toml"),
        "box": {"size": [1e-3] * 3, "boundary": ["periodic", "periodic", "wall"]},
        "flow": {"kind": "simple_shear"},
        "fibers": [
            {"diameter": 4e-5, "table": 0, "layers": [layer] * 4},
            {"diameter": 4e-5, "table": 0},
        ],
    }
    folder.write_scene(tables)
    names = ["step", "time", "strain", "layer", "z_low", "z_high", *COLUMNS]
    writer = ScalarsWriter(folder.layers_path, names)
    for k in range(frames):
        for n in range(4):
            row: dict[str, float] = {"step": k, "time": k, "strain": 2.0 * k, "layer": n}
            row |= {"z_low": 2.5e-4 * n, "z_high": 2.5e-4 * (n + 1)}
            value = k + 0.1 * n
            row |= {name: 10 * value if name.startswith("a22") else value for name in COLUMNS}
            writer.append(row)
    writer.close()
    record = TrajectoryWriter(
        folder.trajectory_path,
        fiber_node_start=[0, 2, 4],
        fiber_group=[0, 0],
        scene_json=json.dumps(tables),
        attrs={},
    )
    across = np.array([[0.5, 0.1, 0.5], [0.5, 0.9, 0.5], [0.1, 0.1, 0.1], [0.9, 0.1, 0.1]]) * 1e-3
    for k in range(2):
        record.append(k, k, 2.0 * k, across, np.diag([1e-3] * 3))
    record.close()
    return folder


def table(folder: ResultFolder, name: str) -> list[dict[str, str]]:
    """Rows beside a figure."""
    with (folder.path / "figures" / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_five_strains_from_start_to_end(tmp_path: Path) -> None:
    """Without a reference; both weightings and the volume fraction beside the one asked for."""
    folder = layered_run(tmp_path)
    names = [path.name for path in plot_run(folder)]
    layered = ["layers.png", "layers_number.png", "layers_smoothed.png", "layers_fraction.png"]
    assert names == ["tip.png", *layered, "cell.png", "cut.png"]
    rows = table(folder, "layers")
    assert sorted({float(row["strain"]) for row in rows}) == [0, 4, 8, 12, 16]
    a22 = [float(r["value"]) for r in rows if r["column"] == "a22" and float(r["strain"]) == 8]
    np.testing.assert_allclose(a22, [40, 41, 42, 43])
    assert {row["column"] for row in table(folder, "layers_number")} == {
        "a11_fiber",
        "a22_fiber",
        "a33_fiber",
    }
    asked = [row for row in table(folder, "layers_fraction") if row["run"] == "asked"]
    assert [float(row["value"]) for row in asked] == [0.08] * 4


def test_reference_decides_on_the_strains(tmp_path: Path) -> None:
    """Points at 12.5 are drawn over the frame nearest to it; curves over strain leave them out."""
    (tmp_path / "reference").mkdir()
    (tmp_path / "reference" / "cell_layers.csv").write_text(
        "strain,z,a11\n0,1e-4,0.3\n12.5,1e-4,0.5\n12.5,5e-4,0.6\n"
    )
    folder = layered_run(tmp_path)
    plot_run(folder)
    rows = table(folder, "layers")
    assert sorted({float(row["strain"]) for row in rows if row["run"] == "run"}) == [0, 12]
    marks = [float(row["value"]) for row in rows if row["run"] == "reference cell_layers"]
    assert marks == [0.3, 0.5, 0.6]
    assert not (folder.path / "figures" / "orientation.csv").exists()


def test_smoothing_is_the_mean_of_neighbors() -> None:
    """Three layers inside, two at the walls, and those that hold nothing left out."""
    values = np.array([[1.0, 2.0, 6.0, np.nan, 4.0]])
    np.testing.assert_allclose(smooth(values), [[1.5, 3.0, 4.0, 5.0, 4.0]])


def test_unfinished_frame_is_left_out(tmp_path: Path) -> None:
    """A run that was killed while it wrote its layers."""
    folder = layered_run(tmp_path, frames=3)
    lines = folder.layers_path.read_text().splitlines(keepends=True)
    folder.layers_path.write_text("".join(lines[:-2]))
    layers = read_layers(folder.layers_path)
    assert layers is not None
    np.testing.assert_array_equal(layers.moment, [0, 2])
    np.testing.assert_allclose(layers.middle[1], np.array([1, 3, 5, 7]) * 1.25e-4)


def test_section_of_tilted_cylinders() -> None:
    """Areas pi a^2/|p_y| of the ellipses, to the rounding of their rims to pixels (2 %).

    A fiber beside the plane by more than its radius is not cut, one in the plane shows 2 a L.
    """
    radius = 0.02
    begin = np.array([[0.3, 0.0, 0.3], [0.6, 0.1, 0.4], [0.1, 0.53, 0.8], [0.1, 0.5, 0.9]])
    step = np.array([[0.0, 1.0, 0.0], [0.0, 0.8, 0.4], [0.8, 0.0, 0.0], [0.8, 0.0, 0.0]])
    picture, shown = section(begin, begin + step, np.full(4, radius), 0.5, (1.0, 1.0))
    assert shown == [0, 1, 3]
    area = 1.0 / picture[..., 0].size
    inside = np.any(picture != 1.0, axis=2)
    upright = inside[: picture.shape[0] // 2].sum() * area
    assert upright == pytest.approx(np.pi * radius**2, rel=0.02)
    slope = 0.8 / np.hypot(0.8, 0.4)
    band = slice(int(0.5 * len(picture)), int(0.75 * len(picture)))
    assert inside[band].sum() * area == pytest.approx(np.pi * radius**2 / slope, rel=0.02)
    level = inside[int(0.85 * len(picture)) :].sum() * area
    assert level == pytest.approx(2 * radius * 0.8 + np.pi * radius**2, rel=0.02)
    middle = picture[int(0.9 * len(picture)), int(0.5 * picture.shape[1])]
    assert np.argmax(middle) == 0


def test_section_follows_the_trajectory(tmp_path: Path) -> None:
    """Of two fibers only the one across the plane y = 0.5 mm is in the table, at both strains."""
    folder = layered_run(tmp_path)
    plot_run(folder)
    rows = table(folder, "cut")
    assert [(float(row["strain"]), row["fiber"]) for row in rows] == [(0.0, "0"), (2.0, "0")]
    assert [float(rows[0][f"p_{axis}"]) for axis in "xyz"] == pytest.approx([0, 1, 0], abs=1e-6)
