"""Result folders: naming, refusing, overwriting, the small files, and the description."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from warpfiber.output.checkpoint import write_checkpoint
from warpfiber.output.folder import RecordError, ResultFolder, describe
from warpfiber.output.scalars import ScalarsWriter
from warpfiber.output.trajectory import TrajectoryWriter
from warpfiber.scene import SceneError


def test_default_names_are_numbered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = [ResultFolder.create(None, "scenes/paper/cell_v1.5.toml").path for _ in range(3)]
    assert [str(name) for name in names] == [
        "results/cell_v1.5",
        "results/cell_v1.5_2",
        "results/cell_v1.5_3",
    ]


def test_existing_folder_is_a_fault_unless_overwritten(tmp_path: Path) -> None:
    target = tmp_path / "run"
    target.mkdir()
    (target / "notes.txt").write_text("mine")
    (target / "scalars.csv").write_text("old")
    (target / "checkpoint_12.h5").write_text("old")
    (target / "figures").mkdir()
    (target / "figures" / "cell.png").write_text("old")
    with pytest.raises(SceneError, match="--out"):
        ResultFolder.create(target, "x")
    assert (target / "scalars.csv").exists()
    folder = ResultFolder.create(target, "x", overwrite=True)
    assert sorted(path.name for path in folder.path.iterdir()) == ["notes.txt"]


def test_file_and_unwritable_parent_are_faults(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name in ("file", "file/below"):
        for overwrite in (False, True):
            with pytest.raises(SceneError, match="--out"):
                ResultFolder.create(tmp_path / name, "x", overwrite)


def test_small_files_round_trip(tmp_path: Path) -> None:
    folder = ResultFolder.create(tmp_path / "deep" / "run", "x")
    scene = {"title": "µ", "box": {"size": (1e-3, 1e-3, 1e-3)}, "path": Path("a.toml")}
    folder.write_scene(scene)
    assert folder.read_scene() == {"title": "µ", "box": {"size": [1e-3] * 3}, "path": "a.toml"}
    folder.write_summary({"mean": np.float64(0.5), "bad": np.nan, "a": np.arange(3), "ok": True})
    assert folder.read_summary() == {"mean": 0.5, "bad": None, "a": [0, 1, 2], "ok": True}
    assert ResultFolder(tmp_path).read_summary() == {}
    folder.log("first")
    folder.log("second")
    lines = (folder.path / "log.txt").read_text().splitlines()
    assert [line.split("] ")[1] for line in lines] == ["first", "second"]
    (folder.path / "summary.json").write_text('{"half": ')
    with pytest.raises(RecordError, match="summary.json"):
        folder.read_summary()


def test_open_accepts_folder_or_record_and_names_what_is_missing(tmp_path: Path) -> None:
    folder = ResultFolder.create(tmp_path / "run", "x")
    folder.write_scene({})
    folder.trajectory_path.write_text("")
    assert ResultFolder.open(folder.path).path == folder.path
    assert ResultFolder.open(folder.trajectory_path).path == folder.path
    for missing in (tmp_path / "none", tmp_path):
        with pytest.raises(SceneError, match="no result folder"):
            ResultFolder.open(missing)


def test_describe_tells_content_and_whether_whole(tmp_path: Path) -> None:
    folder = ResultFolder.create(tmp_path / "run", "x")
    folder.write_scene({"title": "Two fibers", "numerics": {"method": "bead_chain"}})
    record = TrajectoryWriter(
        folder.trajectory_path,
        fiber_node_start=[0, 2, 4],
        fiber_group=[0, 0],
        scene_json=json.dumps({}),
        attrs={},
    )
    table = ScalarsWriter(folder.scalars_path, ["step", "strain"])
    for step in range(3):
        record.append(step, 0.1 * step, 0.5 * step, np.eye(4, 3))
        table.append({"step": step, "strain": 0.5 * step})
    record.close()
    table.close()
    write_checkpoint(folder.path, 2, {"node_pos": np.eye(3)}, {})
    text = describe(folder)
    for words in ("Two fibers", "2 fibers, 4 nodes, 3 frames", "3 rows", "checkpoint_2.h5"):
        assert words in text
    assert "whole       yes" in text
    (folder.path / "checkpoint_2.h5").write_bytes(b"torn")
    text = describe(folder.trajectory_path)
    assert "whole       no" in text and "checkpoint_2.h5: cannot read" in text
