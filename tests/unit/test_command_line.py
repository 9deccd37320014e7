"""The command line from outside: exit codes, messages, what is written and what is not."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stress.small_cell import CELL, Shell, shell
from warpfiber.output import TrajectoryReader, checkpoint_paths, read_checkpoint

__all__ = ["shell"]  # a fixture

SHEAR_CELL = Path(__file__).parents[2] / "scenes" / "sasayama_2018" / "shear_cell.toml"

RECORD = 'record.quantities=["orientation", "contacts"]'


# -- check --------


def test_check_prints_the_derived_numbers(shell: Shell) -> None:
    assert shell("check", SHEAR_CELL, "--set", "numerics.method=bead_chain") == 0
    expected = {
        "fibers.0 count": "446",
        "effective stiffness S_eff": "1",  # the scene asks for it
        "Reynolds number of a bead": "0.1",
        "equivalent aspect ratio r_e": "14.16",  # 0.7081 * 20
        "Jeffery period": "0.8941 s",  # 2 pi (r_e + 1 / r_e) / shear rate
    }
    for name, value in expected.items():
        assert re.search(rf"^{re.escape(name)}.*\s\s{re.escape(value)}$", shell.out, re.M), name
    limit = re.search(r"^dt limit, stretching .*\s(\S+) s$", shell.out, re.M)
    chosen = re.search(r"^dt +(\S+) s = 0.5 of the limit set by stretching$", shell.out, re.M)
    assert limit and chosen
    assert float(chosen[1]) == pytest.approx(0.5 * float(limit[1]), rel=1e-3)


def test_check_writes_nothing(shell: Shell) -> None:
    path = shell.scene()
    assert shell("check", path) == 0
    assert shell.listing() == {"cell.toml"}


def test_check_refuses_what_run_refuses(shell: Shell) -> None:
    assert shell("check", shell.scene(), "--set", "numerics.dt=1") == 2
    assert "numerics.dt" in shell.err


# -- faults before the first step: exit code 2, nothing written --------


def test_all_faults_of_a_file_come_together(shell: Shell) -> None:
    wrong = CELL.replace("aspect_ratio = 10", "aspct_ratio = 10")
    wrong = wrong.replace("density = 4e9", "density = -4e9")
    wrong = wrong.replace("viscosity = 100", 'viscosity = "100 Pa s"')
    wrong = wrong.replace("segments = 2", "segments = true")
    assert shell.run("out", text=wrong) == 2
    for key in ("aspct_ratio", "density", "viscosity", "segments"):
        assert key in shell.err
    assert "did you mean 'aspect_ratio'" in shell.err
    assert shell.listing() == {"cell.toml"}


# 20 short fibers as dense as no random packing is
JAM = ["box.size=[4e-5, 4e-5, 4e-5]", "fibers.0.aspect_ratio=3", "fibers.0.volume_fraction=0.8"]
FAULTS = {
    "unknown device": (["numerics.device=gpu"], "numerics.device"),
    "absent device": (["numerics.device=cuda:77"], "numerics.device"),
    "box too small": (["box.size=[4e-5, 2e-4, 2e-4]"], "box.size"),
    "dt above the limit": (["numerics.dt=1e-3"], "contact"),
    "no such key": (["flow.shear_rat=1"], "shear_rate"),
    "not a number": (["flow.shear_rate=nan"], "flow.shear_rate"),
    "hopeless packing": (["fibers.0.volume_fraction=0.95"], "volume_fraction"),
    "packing that jams": (JAM, "volume_fraction"),
    "missing node file": (['fibers.0.node_file="no.npz"'], "no.npz"),
    "wrong frames": (["record.frames=0"], "record.frames"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named_and_nothing_is_written(shell: Shell, name: str) -> None:
    settings, words = FAULTS[name]
    assert shell.run("out", *settings) == 2
    assert words in shell.err
    assert shell.err.startswith("warpfiber: ")
    assert "Traceback" not in shell.err
    assert shell.listing() == {"cell.toml"}


def test_device_option_is_checked_too(shell: Shell) -> None:
    assert shell.run("out", options=("--device", "cuda:77")) == 2
    assert "cpu" in shell.err  # what there is instead
    assert shell.listing() == {"cell.toml"}


def test_nan_in_a_node_file_names_fiber_and_node(shell: Shell) -> None:
    nodes = np.zeros((2, 3, 3))
    nodes[..., 0] = np.linspace(0.0, 9e-5, 3)
    nodes[1, :, 2] = 5e-5
    nodes += 5e-5
    nodes[1, 2, 0] = np.nan
    np.savez(shell.folder / "fibers.npz", node_pos=nodes)
    text = CELL.replace("aspect_ratio = 10", 'node_file = "fibers.npz"').replace("count = 10", "")
    text = text.replace("segments = 2", "")
    assert shell.run("out", text=text) == 2
    assert "node 2 of fiber 1" in shell.err
    assert "out" not in shell.listing()


def test_an_existing_folder_is_refused_unless_told(shell: Shell) -> None:
    assert shell.run("out", RECORD) == 0
    before = (shell.folder / "out" / "scalars.csv").read_bytes()
    assert shell.run("out", "seed=2") == 2
    assert "--overwrite" in shell.err
    assert (shell.folder / "out" / "scalars.csv").read_bytes() == before
    assert shell.run("out", "seed=2", options=("--overwrite",)) == 0
    assert (shell.folder / "out" / "scalars.csv").read_bytes() != before


@pytest.mark.parametrize("parent", ["cell.toml", "/proc/nowhere"])
def test_unwritable_parent(shell: Shell, parent: str) -> None:
    assert shell("run", shell.scene(), "--out", f"{parent}/out", "--quiet") == 2
    assert "--out" in shell.err


def test_missing_inputs(shell: Shell) -> None:
    assert shell("run", "absent.toml") == 2
    assert "absent.toml" in shell.err
    for command in ("info", "plot", "resume"):
        assert shell(command, "absent") == 2, command
        assert "absent" in shell.err
    assert shell("export", "usd", "absent") == 2
    assert shell("export", "usd", "absent", "--out", "bed.obj") == 2
    assert "the name must end in .usdc, .usda or .usd" in shell.err
    assert shell.listing() == set()


@pytest.mark.parametrize(
    "words", [[], ["fly"], ["run"], ["run", "x.toml", "--workers", "0"], ["export", "obj", "x"]]
)
def test_usage(shell: Shell, words: list[str]) -> None:
    assert shell(*words) == 2
    assert "usage" in shell.err


# -- run --------


def test_a_finished_run(shell: Shell) -> None:
    assert shell.run("out", RECORD, "fibers.0.count=7", "title=a small one") == 0
    summary = shell.summary("out")
    assert summary["outcome"] == "finished"
    keys = """final counts steps dt dt_limit dt_limit_term wall_seconds setup_seconds
        stepping_seconds recording_seconds ns_per_segment_step ns_per_segment_step_by_pass device
        workers precision placement hash versions"""
    assert set(keys.split()) <= set(summary)
    assert summary["counts"]["fibers"] == 7
    assert summary["dt"] < summary["dt_limit"]
    scene = (shell.folder / "out" / "scene.json").read_text()
    assert "a small one" in scene
    rows = shell.rows("out")
    assert len(rows["step"]) == 21  # the start and 20
    assert rows["strain"][-1] == pytest.approx(0.1, rel=summary["dt"] * 100 / 0.1)
    assert rows["step"][-1] == summary["steps"]
    assert np.all(np.diff(rows["step"]) > 0)
    assert rows["a11"] + rows["a22"] + rows["a33"] == pytest.approx(1.0)
    with TrajectoryReader(shell.folder / "out" / "run.vtkhdf") as reader:
        assert reader.frame_count == 6
        assert np.isfinite(reader.node_pos(5)).all()
        assert reader.scene["fibers"][0]["count"] == 7
    assert shell("info", shell.folder / "out") == 0
    assert re.search(r"whole +yes", shell.out)
    assert shell("info", shell.folder / "out" / "run.vtkhdf") == 0


def test_default_folders_are_numbered(shell: Shell) -> None:
    path = shell.scene()
    words = ("--quiet", "--set", "stage.0.end_strain=0.01")
    assert shell("run", path, *words) == 0
    assert shell("run", path, *words) == 0
    assert {p.name for p in (shell.folder / "results").iterdir()} == {"cell", "cell_2"}


TENSOR = ["a11", "a22", "a33", "a12", "a13", "a23"]
COLUMNS: dict[str, list[str]] = {
    "orientation": [*TENSOR, *(f"{name}_fiber" for name in TENSOR)],
    "contacts": ["contacts_per_fiber", "coordination_number"],
    "interactions": ["interactions_per_fiber"],
    "overlap": ["overlap_max", "overlap_mean"],
    "axial_strain": ["axial_strain_max"],
    "rotation": ["angle"],
    "energy": [
        f"energy_{kind}" for kind in ("kinetic", "stretching", "bending", "wall", "repulsion")
    ],
}


@pytest.mark.parametrize("quantity", ["", *COLUMNS])
def test_only_what_was_asked_for_is_recorded(shell: Shell, quantity: str) -> None:
    listed = f'["{quantity}"]' if quantity else "[]"
    assert shell.run("out", f"record.quantities={listed}", "stage.0.end_strain=0.005") == 0
    assert set(shell.header("out")) == {"step", "time", "strain", *COLUMNS.get(quantity, [])}


def test_no_trajectory_unless_asked_for(shell: Shell) -> None:
    assert shell.run("out", "record.trajectory=false", "record.usd=true") == 0
    assert not (shell.folder / "out" / "run.vtkhdf").exists()
    assert not (shell.folder / "out" / "usd").exists()


def test_steps_longer_than_a_row_write_no_row_twice(shell: Shell) -> None:
    # 12 steps and room for 1000 rows and 100 frames
    settings = ("stage.0.end_strain=0.01", "record.scalars=1000", "record.frames=100")
    assert shell.run("out", *settings) == 0
    steps = shell.rows("out")["step"]
    assert np.array_equal(steps, np.arange(shell.summary("out")["steps"] + 1))
    with TrajectoryReader(shell.folder / "out" / "run.vtkhdf") as reader:
        assert np.array_equal(reader.step, steps)


def test_progress_and_closing_lines_go_away_with_quiet(shell: Shell) -> None:
    assert shell.run("out", "stage.0.end_strain=0.005") == 0
    assert shell.out == "" and shell.err == ""
    path = shell.scene()
    assert shell("run", path, "--out", "loud", "--set", "stage.0.end_strain=0.005") == 0
    assert "limit" in shell.out and "scalars.csv" in shell.out


# -- pictures --------


def test_plot_and_export(shell: Shell) -> None:
    from pxr import Usd, UsdGeom

    assert shell.run("out", RECORD) == 0
    assert shell("plot", shell.folder / "out") == 0
    pictures = [Path(line) for line in shell.out.splitlines()]
    assert pictures and all(path.stat().st_size > 0 for path in pictures)
    assert shell("export", "usd", shell.folder / "out", "--wrap", "none", "--frames", "0:6:2") == 0
    stage = Usd.Stage.Open(shell.out.strip())
    curves = [p for p in stage.Traverse() if p.IsA(UsdGeom.BasisCurves)]
    counts = [
        list(UsdGeom.BasisCurves(p).GetCurveVertexCountsAttr().Get(0))
        for p in curves
        if "Fibers" in str(p.GetPath())
    ]
    assert counts == [[3] * 10]
    assert stage.GetEndTimeCode() - stage.GetStartTimeCode() == 2


# -- exit code 4 --------


def test_info_on_damage(shell: Shell) -> None:
    assert shell.run("out") == 0
    folder = shell.folder / "out"
    (folder / "summary.json").unlink()
    assert shell("info", folder) == 0
    assert "did not finish" in shell.out and re.search(r"whole +yes", shell.out)
    checkpoint = checkpoint_paths(folder)[0]
    data = bytearray(checkpoint.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    checkpoint.write_bytes(data)
    with (folder / "scalars.csv").open("a") as file:
        file.write("99,0.1")
    assert shell("info", folder) == 0
    assert re.search(r"whole +no", shell.out)
    assert checkpoint.name in shell.out and "unfinished row" in shell.out


def test_a_full_disk_is_exit_code_4(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    from warpfiber.output.scalars import ScalarsWriter

    rows: list[str] = []

    def write(writer: Any, line: str) -> None:
        rows.append(line)
        if len(rows) > 5:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(ScalarsWriter, "_write", write)
    assert shell.run("out") == 4
    assert "No space left" in shell.err and "scalars.csv" in shell.err


def test_a_full_disk_for_the_summary_is_exit_code_4(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    from warpfiber.output import ResultFolder

    def write(folder: Any, summary: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ResultFolder, "write_summary", write)
    assert shell.run("out") == 4
    assert "No space left" in shell.err
    assert read_checkpoint(checkpoint_paths(shell.folder / "out")[0])
