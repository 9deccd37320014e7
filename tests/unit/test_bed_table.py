"""The table of beds over seeds: branches, values at a fraction, yields, means and deviations."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

TOOL = Path(__file__).parents[2] / "tools" / "bed_table.py"


def _tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bed_table", TOOL)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


bed_table = _tool()


def written(
    folder: Path,
    columns: dict[str, np.ndarray],
    ends: list[float],
    stages: list,
    kinds: tuple[str, ...] = ("settle", "compress", "unload"),
    **scene: object,
) -> Path:
    """A run folder with these rows, ends of stages, results and scene."""
    folder.mkdir()
    table = np.stack(list(columns.values()), axis=1)
    header = ",".join(columns)
    np.savetxt(folder / "scalars.csv", table, delimiter=",", header=header, comments="")
    lines = [f"[  1.00 s] stage 'a' ended at time {end:g} s" for end in ends]
    (folder / "log.txt").write_text("\n".join(["begun", *lines]))
    (folder / "summary.json").write_text(json.dumps({"outcome": "finished", "stages": stages}))
    asked = {"title": folder.name, "stage": [{"kind": kind} for kind in kinds], **scene}
    (folder / "scene.json").write_text(json.dumps(asked))
    return folder


def cycles(folder: Path, scale: float, **scene: object) -> Path:
    """Settling for 1 s, then two loadings by scale phi^6, each with an unloading at half of it."""
    time = np.arange(1, 501) * 0.01
    part = np.minimum(((time - 1e-9) // 1.0).astype(int), 4)
    inside = time - part
    loads, unloads = (part == 1) | (part == 3), (part == 2) | (part == 4)
    phi = np.where(loads, 0.2 + 0.22 * inside, np.where(unloads, 0.42 - 0.22 * inside, 0.2))
    shift = np.where(part >= 3, 0.9, 1.0)
    pressure = scale * shift * phi**6 * np.where(unloads, 0.5, 1.0) * (part > 0)
    columns = {
        "step": np.arange(500.0),
        "time": time,
        "pressure_low": np.where(part == 0, 100.0, pressure + 100.0),
        "pressure_high": pressure,
        "volume_fraction": phi,
        "coordination_number": 40.0 * phi,
        "contact_force_mean": 0.1 * phi,
        "contact_force_pair_mean": 0.2 * phi,
        "inclination_mean": 30.0 - 2.0 * part,
        "inclination_00_10": 0.1 * part,
        "inclination_10_20": np.full(500, 0.15),
    }
    return written(folder, columns, [1.0, 2.0, 3.0, 4.0, 5.0], [], **scene)


STRAIGHT: dict[str, object] = {"kind": "straight"}


def drawn(
    folder: Path,
    columns: dict[str, np.ndarray],
    stages: list,
    shape: dict[str, object],
    height: float = 0.02,
) -> Path:
    """A run that pulled or sheared fibers of length 0.06, diameter 0.002 m over a free height."""
    fiber = {"shape": shape, "centerline_length": 0.06, "diameter": 0.002, "segments": 24}
    stage = {"kind": "shear", "freeze_below": 0.03, "freeze_above": 0.03 + height}
    return written(folder, columns, [2.0], stages, fibers=[fiber], stage=[stage])


def cells(told: str, name: str) -> list[list[float]]:
    """Mean (and deviation) of every column of one row of a printed table."""
    line = next(line for line in told.splitlines() if line.startswith(f"| {name} |"))
    return [[float(part) for part in cell.split(" ± ")] for cell in line[2:-2].split(" | ")[1:]]


def test_pressed(tmp_path: Path) -> None:
    """First loading, shift of the second, unloading, inclination before and after."""
    found = bed_table.figures(cycles(tmp_path / "run", 1e6))
    assert found["P low at rest, Pa"] == pytest.approx(100.0)
    assert found["P 0.35, kPa"] == pytest.approx(1e3 * 0.35**6, rel=2e-3)
    assert found["P low 0.35, kPa"] == pytest.approx(1e3 * 0.35**6 + 0.1, rel=2e-3)
    assert found["P 0.35 unloading, kPa"] == pytest.approx(0.5e3 * 0.35**6, rel=2e-3)
    assert found["Z 0.40"] == pytest.approx(16.0, rel=2e-3)
    assert found["F 0.30, mN"] == pytest.approx(30.0, rel=2e-3)
    assert found["F pair 0.30, mN"] == pytest.approx(60.0, rel=2e-3)
    assert found["exponent, last decade of P"] == pytest.approx(6.0, rel=1e-3)
    first = 1e-3 ** (1.0 / 6.0)
    row = 2.3e-3  # the way of one row in phi
    assert found["phi at 1 kPa, cycle 1"] == pytest.approx(first, abs=row)
    assert found["phi at 0.2 kPa, cycle 1"] == pytest.approx(first * 0.2 ** (1.0 / 6.0), abs=row)
    shift = first * (0.9 ** (-1.0 / 6.0) - 1.0)
    assert found["shift of cycle 2 from 1 at 1 kPa"] == pytest.approx(shift, abs=row)
    assert found["P 0.40, cycle 2, kPa"] == pytest.approx(0.9e3 * 0.4**6, rel=2e-3)
    assert found["Z at 1 kPa"] == pytest.approx(40.0 * first, abs=40.0 * row)
    back = first * 2.0 ** (1.0 / 6.0)
    assert found["Z at 1 kPa, unloading"] == pytest.approx(40.0 * back, abs=40.0 * row)
    assert found["inclination at rest"] == 30.0 and found["mode at rest"] == 15.0
    assert found["inclination after cycle 1"] == 26.0 and found["mode after cycle 1"] == 5.0


def test_pulled_and_sheared(tmp_path: Path) -> None:
    strain = np.linspace(0.0, 2.0, 201)[1:]
    columns = {
        "time": strain,
        "grip_strain": strain,
        "stress_zz": 1e4 * np.exp(-strain),
        "coordination_number": np.where(strain > 1.0, 12.0, 6.0),
    }
    pull = {"stage": "pull", "yield_stress_zz": 2e4, "yield_strain": 0.5}
    found = bed_table.figures(drawn(tmp_path / "pull", columns, [pull], STRAIGHT))
    assert found["yield tension, kPa"] == 20.0 and found["its strain"] == 0.5
    assert found["stress at twice that strain over peak"] == pytest.approx(0.5 * np.exp(-1.0))
    shear = {"stage": "shear", "yield_stress_xz": 3e4, "standard_deviation": 2e3}
    found = bed_table.figures(drawn(tmp_path / "shear", columns, [shear], {"kind": "z"}))
    assert found["yield shear, kPa"] == 30.0 and found["Z, second half"] == 12.0
    assert found["L_s / d"] == pytest.approx(10.0) and "kappa, 1/m" not in found
    assert found["D_F / L_c"] == pytest.approx(0.5**0.5)


def test_trends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rank correlations of the yield stress: with kappa, with D_F, with equal values between."""
    strain = np.linspace(0.0, 2.0, 21)[1:]
    columns = {"time": strain, "grip_strain": strain, "coordination_number": 0.0 * strain}
    asked: list[tuple[dict[str, object], float]] = [
        (STRAIGHT, 30.0),
        (STRAIGHT, 40.0),
        ({"kind": "s", "curvature": 44.0}, 35.0),
        ({"kind": "s", "curvature": 100.0}, 20.0),
        ({"kind": "z"}, 10.0),
    ]
    folders = []
    for k, (shape, stress) in enumerate(asked):
        shear = {"yield_stress_xz": 1e3 * stress, "standard_deviation": 1.0}
        folders.append(str(drawn(tmp_path / str(k), columns, [shear], shape)))
    longer = drawn(tmp_path / "longer", columns, [shear], STRAIGHT, height=0.03)
    png = tmp_path / "yields.png"
    bed_table.main([*folders, str(longer), "--picture", str(png)])
    assert png.read_bytes()[:4] == b"\x89PNG"
    shown = bed_table.points([bed_table.figures(Path(folder)) for folder in [*folders, longer]])
    assert list(shown) == [10.0, 15.0] and [len(rows) for rows in shown.values()] == [4, 1]
    assert shown[10.0][-1] == (1.0, 35.0, pytest.approx(50.0**0.5))
    told = capsys.readouterr().out
    # ranks of kappa 0.5, 0.5, 2, 3 and of the stress 1, 3, 2, 0
    assert "kappa, 1/m at L_s / d = 10: Spearman -0.63 over 4 runs; from 35 at 0 to 20 kPa" in told
    # ranks of D_F 3.5, 3.5, 2, 0, 1 and of the stress 2, 4, 3, 1, 0
    assert "D_F / L_c at L_s / d = 10: Spearman 0.72 over 5 runs; from 20 at 0.665 to 35" in told
    assert "against L_s / d" not in told


def test_over_seeds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Mean and deviation of one run; a quantity that a run lacks does not count."""
    folders = [str(cycles(tmp_path / str(k), scale)) for k, scale in enumerate((1e6, 2e6, 3e6))]
    table = bed_table.summed([bed_table.figures(Path(folder)) for folder in folders])
    mean, spread, count = table["P 0.40, kPa"]
    unit = 1e3 * 0.4**6
    assert (mean, spread, count) == pytest.approx((2.0 * unit, unit, 3), rel=2e-3)
    assert table["exponent, last decade of P"][1] < 1e-9
    assert bed_table.summed([{"a": 1.0}, {"a": np.nan, "b": 2.0}])["a"][::2] == (1.0, 1)
    bed_table.main([*folders, str(tmp_path / "none")])
    told = capsys.readouterr().out
    assert cells(told, "P 0.40, kPa") == [pytest.approx([2.0 * unit, unit], rel=2e-2)]
    assert "\npressed\n" in told and "| quantity | (3) |" in told
    with pytest.raises(SystemExit):
        bed_table.main([])


def test_without_settling(tmp_path: Path) -> None:
    """The first stage is the first loading where the scene has no settling."""
    bed = cycles(tmp_path / "run", 1e6)
    (bed / "scene.json").write_text(json.dumps({"stage": [{"kind": "compress"}]}))
    assert "P low at rest, Pa" not in bed_table.figures(bed)


def test_columns_of_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A column per scene, named by what differs; seeds and places of starts make none."""

    def asked(curvature: float) -> dict[str, object]:
        shape = {"kind": "s", "curvature": curvature, "angle": None}
        return {"fibers": [{"shape": shape, "count": 300}]}

    runs = [
        cycles(tmp_path / "a", 1e6, seed=1, start={"from": "x"}, **asked(44.0)),
        cycles(tmp_path / "b", 2e6, seed=2, start={"from": "y"}, **asked(44.0)),
        cycles(tmp_path / "c", 3e6, seed=1, start={"from": "z"}, **asked(100.0)),
    ]
    unfinished = cycles(tmp_path / "d", 9e6, **asked(100.0))
    (unfinished / "summary.json").write_text(json.dumps({"outcome": "diverged"}))
    bed_table.main([str(run) for run in [*runs, unfinished]])
    told = capsys.readouterr()
    assert "| quantity | s 44 (2) | s 100 (1) |" in told.out
    unit = 1e3 * 0.4**6
    first, second = cells(told.out, "P 0.40, kPa")
    assert first == pytest.approx([1.5 * unit, unit * 0.5**0.5], rel=2e-2)
    assert second == pytest.approx([3.0 * unit], rel=2e-2)
    assert "d: has not run to its end" in told.err
    assert "P 0.25" in told.out and "P 0.20" not in told.out


def test_heads() -> None:
    scenes = [
        {"fibers": [{"shape": {"kind": "straight"}, "segments": 26}], "numerics": {"segments": 26}},
        {"fibers": [{"shape": {"kind": "z"}, "segments": 28}], "numerics": {"segments": 28}},
    ]
    asked = [bed_table.settings(scene) for scene in scenes]
    assert bed_table.columns(asked) == ["straight, segments 26", "z, segments 28"]
    stage = {"stage": [{"end_strain": 2.0, "end_time": 0.2}]}
    assert bed_table.settings(stage) == {"stage.0.end_strain": "2"}
