"""Figures: which are drawn, that each has its table, and what the picture of the cell shows."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from matplotlib.image import imread  # noqa: E402

from warpfiber.output.cell import closed_lines  # noqa: E402
from warpfiber.output.curves import GREEN, ORANGE  # noqa: E402
from warpfiber.output.folder import ResultFolder  # noqa: E402
from warpfiber.output.plots import plot_run  # noqa: E402
from warpfiber.output.scalars import ScalarsWriter  # noqa: E402
from warpfiber.output.trajectory import TrajectoryWriter  # noqa: E402
from warpfiber.scene import SceneError  # noqa: E402


def _run(
    target: Path,
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0),
    count: int = 30,
    columns: tuple[str, ...] = ("a11", "a22", "a33"),
    strained: bool = True,
    **scene: object,
) -> ResultFolder:
    """A run of straight fibers along `axis` in a periodic cube."""
    folder = ResultFolder.create(target, "x", overwrite=True)
    tables = {
        "title": "Fibers",
        "box": {"size": [1e-3] * 3, "boundary": ["periodic"] * 3},
        "flow": {"kind": "simple_shear"},
        "fibers": [{"diameter": 4e-5}],
    } | scene
    folder.write_scene(tables)
    record = TrajectoryWriter(
        folder.trajectory_path,
        fiber_node_start=np.arange(count + 1) * 3,
        fiber_group=np.zeros(count),
        scene_json=json.dumps(tables),
        attrs={},
    )
    scalars = ScalarsWriter(folder.scalars_path, ["step", "time", "strain", *columns])
    center = np.random.default_rng(0).uniform(-5e-3, 5e-3, size=(count, 1, 3))
    nodes = center + np.array([-2e-4, 0, 2e-4])[:, None] * np.array(axis)
    for k in range(5):
        strain = 2.0 * k if strained else 0.0
        record.append(k, 0.1 * k, strain, nodes.reshape(-1, 3), np.diag([1e-3] * 3))
        row = {name: 0.2 + 0.1 * k for name in columns}
        scalars.append({"step": k, "time": 0.1 * k, "strain": strain} | row)
    record.close()
    scalars.close()
    return folder


def _table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_figures_follow_the_columns(tmp_path: Path) -> None:
    columns = ("a11", "a22", "a33", "interactions_per_fiber", "overlap_max", "energy_bending")
    folder = _run(tmp_path / "run", columns=columns)
    written = plot_run(folder)
    assert [path.name for path in written] == [
        "orientation.png",
        "interactions.png",
        "overlap.png",
        "energy.png",
        "cell.png",
    ]
    for path in written:
        assert path.parent == folder.path / "figures"
        assert imread(path).shape[1] == 1024
        assert len(_table(path.with_suffix(".csv"))) > 0
    rows = _table(folder.path / "figures" / "orientation.csv")
    assert list(rows[0]) == ["run", "column", "strain", "value"]
    a22 = [(float(row["strain"]), float(row["value"])) for row in rows if row["column"] == "a22"]
    assert np.allclose(a22, [(2.0 * k, 0.2 + 0.1 * k) for k in range(5)])


def test_column_of_nan_or_zero_energy_is_left_out(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", columns=("a11",))
    writer = ScalarsWriter(folder.scalars_path, ["step", "strain", "overlap_max", "energy_kinetic"])
    for k in range(3):
        writer.append({"step": k, "strain": k, "energy_kinetic": 0.0})
    writer.close()
    assert [path.name for path in plot_run(folder)] == ["cell.png"]


def test_time_replaces_strain_at_rest(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", strained=False)
    plot_run(folder)
    assert list(_table(folder.path / "figures" / "orientation.csv")[0])[2] == "time"


def test_tip_of_few_fibers(tmp_path: Path) -> None:
    one = _run(tmp_path / "one", axis=(0.0, 0.6, 0.8), count=1)
    plot_run(one)
    rows = _table(one.path / "figures" / "tip.csv")
    # Half the centerline above its middle, times the slope.
    assert np.allclose([float(row["value"]) for row in rows], 0.5 * 0.8, atol=1e-6)
    assert [float(row["strain"]) for row in rows] == [0, 2, 4, 6, 8]
    three = _run(tmp_path / "three", count=3)
    names = {row["column"] for row in _table(plot_run(three)[-2].with_suffix(".csv"))}
    assert names == {"tip_0", "tip_1", "tip_2"}
    assert "tip.png" not in [path.name for path in plot_run(_run(tmp_path / "many", count=11))]


def test_several_runs_share_axes(tmp_path: Path) -> None:
    runs = [_run(tmp_path / name).path for name in ("a", "b")]
    written = plot_run(runs, tmp_path / "both")
    assert written[0] == tmp_path / "both" / "orientation.png"
    assert {row["run"] for row in _table(tmp_path / "both" / "orientation.csv")} == {"a", "b"}


def test_a_curve_under_another_is_seen(tmp_path: Path) -> None:
    """Contacts and touching fibers are the same of rods: the lower line is drawn wider."""
    from matplotlib.colors import to_rgb

    columns = ("contacts_per_fiber", "coordination_number")
    folder = _run(tmp_path / "r", columns=columns)
    (picture,) = [path for path in plot_run(folder) if path.stem == "interactions"]
    shown = imread(picture)[:, :850, :3]  # without the words beside the axes
    seen = [int((np.abs(shown - to_rgb(c)).max(axis=2) < 0.02).sum()) for c in (ORANGE, GREEN)]
    assert min(seen) > 500


def test_references_beside_the_scene_are_drawn(tmp_path: Path) -> None:
    (tmp_path / "reference").mkdir()
    (tmp_path / "reference" / "cell_figure_7.csv").write_text(
        "# read by eye\nstrain,a11\n0,0.3\n5,0.7\n"
    )
    (tmp_path / "reference" / "other_scene.csv").write_text("strain,a11\n0,0.1\n5,0.2\n")
    (tmp_path / "reference" / "cell_words.csv").write_text("who,what\na,b\n")
    (tmp_path / "reference" / "cell_ragged.csv").write_text("strain,a11\n1,2\n1\n")
    (tmp_path / "reference" / "cell_empty.csv").write_text("# nothing\n")
    folder = _run(tmp_path / "run", path=str(tmp_path / "cell.toml"))
    plot_run(folder)
    rows = _table(folder.path / "figures" / "orientation.csv")
    points = [row["value"] for row in rows if row["run"] == "reference cell_figure_7"]
    assert [float(value) for value in points] == [0.3, 0.7]
    assert not [row for row in rows if "other_scene" in row["run"]]
    assert {row["run"] for row in rows} == {"run", "reference cell_figure_7"}


@pytest.mark.parametrize("axis, channel", [(0, 0), (1, 1), (2, 2)])
def test_cell_picture_shows_direction_as_color(tmp_path: Path, axis: int, channel: int) -> None:
    direction = tuple(np.eye(3)[axis])
    folder = _run(tmp_path / "run", axis=direction)  # type: ignore[arg-type]
    picture = imread(plot_run(folder)[-1])[180:800, 80:, :3]
    colored = np.ptp(picture, axis=2) > 0.25
    assert colored.mean() > 0.02
    strongest = np.argmax(picture[colored], axis=1)
    assert np.mean(strongest == channel) > 0.97
    rows = _table(folder.path / "figures" / "cell.csv")
    assert len(rows) == 30
    center = np.array([[float(row[name]) for name in "xyz"] for row in rows])
    assert center.min() >= -1e-9 and center.max() <= 1e-3 + 1e-9


def test_single_fiber_without_box(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", count=1, box=None, columns=())
    assert [path.name for path in plot_run(folder)] == ["tip.png", "cell.png"]


def test_missing_folder_is_a_fault(tmp_path: Path) -> None:
    with pytest.raises(SceneError):
        plot_run(tmp_path / "none")


def test_beds_are_drawn_against_fraction_and_way(tmp_path: Path) -> None:
    """Pressure against volume fraction, stress of grips against their way; not without these."""
    columns = ("pressure_high", "volume_fraction", "stress_zz", "grip_strain")
    folder = _run(tmp_path / "run", columns=columns)
    names = [path.name for path in plot_run(folder)]
    assert names == ["pressure.png", "compression.png", "drawn.png", "cell.png"]
    for name, along in (("compression", "volume_fraction"), ("drawn", "grip_strain")):
        rows = _table(folder.path / "figures" / f"{name}.csv")
        assert [float(row[along]) for row in rows] == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.6])
    lacking = _run(tmp_path / "other", columns=("pressure_high", "stress_zz"))
    assert [path.name for path in plot_run(lacking)] == ["pressure.png", "cell.png"]


def test_rings_are_drawn_closed() -> None:
    """Of a ring between two open fibers the first node is drawn again at its end."""
    points = np.arange(30.0).reshape(10, 3)
    start = np.array([0, 2, 6, 10], dtype=np.int32)
    lines, first = closed_lines(points, start, np.array([False, True, False]))
    assert first.tolist() == [0, 2, 7, 11]
    np.testing.assert_array_equal(lines[2:7], points[[2, 3, 4, 5, 2]])
    np.testing.assert_array_equal(lines[7:], points[6:])
