"""Orientation curves of runs and their exact answer; the command that fits models to them.

Tolerances: directions of the record are float32 (6e-8 each); the rods of a run are exact to
rounding; a run without a record is exact to the scatter of its fibers.
"""

from __future__ import annotations

import builtins
import csv
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stress.small_cell import Shell, shell
from warpfiber.output import ResultFolder, ScalarsWriter, exact_orientation
from warpfiber.output.orientation_curve import exact_without_contact, read_curve
from warpfiber.scene import SceneError, scene_from_dict

__all__ = ["shell"]  # a fixture

RODS = """
[box]
size = [1e-3, 1e-3, 1e-3]
[flow]
kind = "simple_shear"
shear_rate = 2
viscosity = 100
[[fibers]]
count = 300
aspect_ratio = 10
diameter = 1e-5
youngs_modulus = 7e10
orientation = [0.36, 0.6, 0.04, 0, 0, 0]
[[fibers]]
count = 200
aspect_ratio = 30
diameter = 1e-5
youngs_modulus = 7e10
orientation = [0.5, 0.3, 0.2, 0, 0.1, 0]
[contact]
law = "none"
[[stage]]
kind = "flow"
end_strain = 12
[record]
scalars = 30
frames = 3
figures = false
[numerics]
method = "rigid_rod"
device = "cpu"
"""


def tensors(rows: dict[str, np.ndarray], suffix: str) -> np.ndarray:
    """Diagonals and a13 of recorded rows, (T, 4)."""
    return np.stack([rows[f"{name}{suffix}"] for name in ("a11", "a22", "a33", "a13")], axis=1)


def test_rods_without_contact_follow_the_exact_curve(shell: Shell) -> None:
    """Two lengths with directions of their own, in both weightings."""
    assert shell.run("out", text=RODS) == 0
    rows, folder = shell.rows("out"), shell.folder / "out"
    for weighting, suffix in (("length", ""), ("number", "_fiber")):
        exact = exact_orientation(folder, rows["strain"], weighting)
        got = np.stack([exact[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 2))], axis=1)
        np.testing.assert_allclose(got, tensors(rows, suffix), atol=1e-6)
        curve = read_curve(ResultFolder.open(folder), weighting)
        np.testing.assert_allclose(curve.tensor[:, 0, 2], rows[f"a13{suffix}"], rtol=1e-12)
    ratio = (300 * 10 * 10 + 200 * 30 * 30) / (300 * 10 + 200 * 30)
    assert curve.aspect_ratio == pytest.approx(ratio)
    assert curve.shape_factor == pytest.approx((ratio**2 - 1) / (ratio**2 + 3))
    np.testing.assert_allclose(curve.gradient, [[0, 0, 1], [0, 0, 0], [0, 0, 0]], atol=1e-15)
    assert abs(rows["a11"] - rows["a11_fiber"]).max() > 0.01


def test_without_a_record_the_first_tensor_starts(shell: Shell) -> None:
    """The distribution is assumed alike for all lengths: one length, five standard errors."""
    one = RODS.replace("count = 200", "count = 1").replace("[0.5, 0.3, 0.2, 0, 0.1, 0]", '"planar"')
    assert shell.run("out", "record.trajectory=false", text=one) == 0
    rows = shell.rows("out")
    exact = exact_orientation(shell.folder / "out", rows["strain"], "number")
    np.testing.assert_allclose(exact[0, 0, 0], rows["a11_fiber"][0], atol=1e-9)
    miss = np.abs(exact[:, 0, 0] - rows["a11_fiber"])
    assert 0.0 < miss.max() < 5 * 0.5 / np.sqrt(300)


def test_exact_points_in_the_figure(shell: Shell) -> None:
    """By themselves for stiff fibers without contact, on request for others."""
    pytest.importorskip("matplotlib")

    def points(*words: str) -> list[list[str]]:
        assert shell("plot", *words) == 0
        with (shell.folder / words[0] / "figures" / "orientation.csv").open() as file:
            return [row for row in csv.reader(file) if row[0] == "reference exact_without_contact"]

    assert shell.run("free", text=RODS) == 0
    found = points("free")
    rows = shell.rows("free")
    last = [float(row[3]) for row in found if row[1] == "a11"][-1]
    assert last == pytest.approx(rows["a11"][-1], abs=1e-6)
    soft = 'contact.law="linear"', "contact.stiffness=1e-3", 'numerics.contact="penalty"'
    assert shell.run("touching", *soft, text=RODS) == 0
    assert points("touching") == []
    assert len(points("touching", "--exact")) == len(found)


@pytest.mark.parametrize(
    ("method", "modulus", "law", "answer"),
    [
        ("rigid_rod", 7e10, "none", True),
        ("rigid_rod", 7e10, "exponential", False),
        ("overdamped", 7e10, "none", True),
        ("overdamped", 1e6, "none", False),
    ],
)
def test_where_the_exact_curve_applies(method: str, modulus: float, law: str, answer: bool) -> None:
    """At 200 Pa and r_f = 30 a modulus of 3.3e9 Pa has S_eff = 1."""
    tables: Any = tomllib.loads(RODS)
    for group in tables["fibers"]:
        group["youngs_modulus"] = modulus
    tables["contact"] = {"law": law}
    tables["numerics"] = {"method": method, "segments": 1}
    assert exact_without_contact(scene_from_dict(tables).as_dict()) is answer


# -- faults --------


def made(path: Path, columns: dict[str, list[float]], **scene: Any) -> ResultFolder:
    """A folder with a scene and a table."""
    tables: Any = tomllib.loads(RODS)
    for name, table in scene.items():
        tables[name] = tables[name] | table
    folder = ResultFolder.create(path, "x")
    folder.write_scene(scene_from_dict(tables).as_dict())
    writer = ScalarsWriter(folder.scalars_path, ["step", *columns])
    for k, row in enumerate(zip(*columns.values(), strict=True)):
        writer.append({"step": k} | dict(zip(columns, row, strict=True)))
    writer.close()
    return folder


TENSOR = {name: [1 / 3 if name[1] == name[2] else 0.0] * 9 for name in
          ("a11", "a22", "a33", "a12", "a13", "a23")}  # fmt: skip


def test_a_run_without_orientation(tmp_path: Path) -> None:
    folder = made(tmp_path / "out", {"strain": [0.0, 1.0]})
    with pytest.raises(SceneError, match="recorded no orientation"):
        read_curve(folder)
    only_length = made(tmp_path / "other", {"strain": list(range(9))} | TENSOR)
    assert len(read_curve(only_length).strain) == 9
    with pytest.raises(SceneError, match="recorded no orientation"):
        read_curve(only_length, "number")


def test_a_run_without_a_linear_flow(tmp_path: Path) -> None:
    tables: Any = tomllib.loads(RODS)
    tables["flow"] = {"kind": "rest", "viscosity": 100}
    tables["stage"] = [{"kind": "flow", "end_time": 1.0}]
    tables["numerics"]["dt"] = 0.1
    folder = ResultFolder.create(tmp_path / "out", "x")
    folder.write_scene(scene_from_dict(tables).as_dict())
    with pytest.raises(SceneError, match="strain of a linear flow"):
        read_curve(folder)


def test_a_strain_that_goes_back(tmp_path: Path) -> None:
    folder = made(tmp_path / "out", {"strain": [0.0, 1, 2, 3, 2, 1, 0, 1, 2]} | TENSOR)
    with pytest.raises(SceneError, match="back and forth"):
        read_curve(folder)


def test_rows_that_were_not_measured_are_passed_over(tmp_path: Path) -> None:
    columns = {"strain": [0.0, 1.0, 1.0, 2.0]} | {n: list(v[:4]) for n, v in TENSOR.items()}
    columns["a11"][1] = float("nan")
    curve = read_curve(made(tmp_path / "out", columns))
    np.testing.assert_array_equal(curve.strain, [0.0, 1.0, 2.0])
    assert np.isfinite(curve.tensor).all()


# -- the command --------


def test_fit_writes_its_files(shell: Shell) -> None:
    pytest.importorskip("fiberoripy")
    pytest.importorskip("matplotlib")
    assert shell.run("out", text=RODS) == 0
    words = ("--closure", "QUADRATIC", "--weighting", "number", "--from", "2", "--to", "10")
    models = ("--model", "folgar_tucker", "--model", "iard")
    assert shell("fit", shell.folder / "out", *words, *models) == 0
    for text in ("weighted by number", "closure QUADRATIC", "shape factor", "r_W = ", "agree"):
        assert text in shell.out
    folder = shell.folder / "out"
    facts = json.loads((folder / "fit_number.json").read_text())
    assert facts["weighting"] == "number" and set(facts["models"]) == {"folgar_tucker", "iard"}
    assert facts["strain"][0] == pytest.approx(2.0, abs=0.5)
    assert facts["strain"][1] == pytest.approx(10.0, abs=0.5)
    model = facts["models"]["iard"]
    assert model["closure"] == "QUADRATIC" and len(model["starts"]) == 4
    low, high = model["constants"]["C_I"]["interval"]
    assert low <= model["constants"]["C_I"]["value"] <= high
    with (folder / "figures" / "fit_number.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == facts["rows"]
    exact = exact_orientation(folder, [float(table[-1]["strain"])], "number")[0, 0, 0]
    assert float(table[-1]["without_contact_a11"]) == pytest.approx(exact)
    assert float(table[-1]["a11"]) == pytest.approx(exact, abs=1e-6)
    assert float(table[0]["iard_a11"]) == pytest.approx(float(table[0]["a11"]))
    assert (folder / "figures" / "fit_number.png").stat().st_size > 10_000
    assert shell.run("out", text=RODS, options=("--overwrite",)) == 0
    assert not (folder / "fit_number.json").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--model", "jeffery"), "folgar_tucker, rsc, iard"),
        (("--closure", "ibof"), "IBOF"),
        (("--closure", "NONE"), "only --model folgar_tucker"),
        (("--weighting", "volume"), "length, number"),
        (("--from", "11.5"), "rows of orientation there"),
        (("--from", "8", "--to", "3"), "0 rows of orientation there"),
    ],
)
def test_fit_faults(shell: Shell, words: tuple[str, ...], text: str) -> None:
    pytest.importorskip("fiberoripy")
    assert shell.run("out", text=RODS) == 0
    before = {path.name for path in (shell.folder / "out").iterdir()}
    assert shell("fit", shell.folder / "out", *words) == 2
    assert text in shell.err
    assert {path.name for path in (shell.folder / "out").iterdir()} == before
    assert shell("fit", "absent", *words) == 2


def test_fit_without_fiberoripy_says_what_to_install(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert shell.run("out", text=RODS) == 0
    real = builtins.__import__

    def absent(name: str, *args: Any, **keys: Any) -> Any:
        if name.split(".")[0] == "fiberoripy":
            raise ModuleNotFoundError("No module named 'fiberoripy'", name="fiberoripy")
        return real(name, *args, **keys)

    monkeypatch.setattr(builtins, "__import__", absent)
    assert shell("fit", shell.folder / "out") == 2
    assert "fiberoripy" in shell.err and "extra 'fit'" in shell.err
