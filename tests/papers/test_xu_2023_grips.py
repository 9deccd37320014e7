"""Tension and shear of 100 straight fibers: what Xu, Ma & Guo 2023 say of Figs. 13, 14 and 16.

Run with `tools/test -m papers`. One random start; absolute stresses are told in the scene's README
and not asserted.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "xu_2023"
pytestmark = pytest.mark.papers

Rows = np.ndarray


@pytest.fixture(scope="module")
def bed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The settled bed that all tests start from (half a minute)."""
    out = tmp_path_factory.mktemp("xu") / "bed"
    keys = {"record.figures": False, "record.trajectory": False}
    assert wf.Job.start(wf.load_scene(SCENES / "bed_quick.toml", keys), out=out).run() == 0
    return out


def drawn(bed: Path, name: str, out: str, **changes: float) -> tuple[Rows, dict[str, float]]:
    """Rows and yield of one test of the bed."""
    keys: dict[str, object] = {
        "start.from": str(bed),
        "record.figures": False,
        "record.trajectory": False,
    }
    keys |= {f"stage.0.{key}": value for key, value in changes.items()}
    folder = bed.parent / out
    assert wf.Job.start(wf.load_scene(SCENES / name, keys), out=folder).run() == 0
    table = np.genfromtxt(folder / "scalars.csv", delimiter=",", names=True)
    result = json.loads((folder / "summary.json").read_text())["stages"][0]
    return table, result


def test_tension_rises_and_falls(bed: Path) -> None:
    """A peak, then a fall until the bed is torn; a longer sample bears less (Figs. 13, 14)."""
    rows, result = drawn(bed, "tension_quick.toml", "short")
    peak, strain = result["yield_stress_zz"], result["yield_strain"]
    after = np.interp(2.0 * strain, rows["grip_strain"], rows["stress_zz"])
    assert 0.05 < strain < 1.0
    assert after < peak
    assert rows["stress_zz"][-1] < 0.2 * peak
    _, longer = drawn(bed, "tension_quick.toml", "long", freeze_below=0.006, freeze_above=0.03)
    assert longer["yield_stress_zz"] < 0.5 * peak


def test_shear_becomes_steady(bed: Path) -> None:
    """Stress and contacts rise, then fluctuate around a constant level (Fig. 16)."""
    rows, result = drawn(bed, "shear_quick.toml", "shear")
    level, scatter = result["yield_stress_xz"], result["standard_deviation"]
    strain = rows["grip_strain"]
    late = [rows["stress_xz"][(strain > a) & (strain <= a + 0.375)].mean() for a in (0.75, 1.125)]
    assert scatter < 0.3 * level
    assert abs(late[1] - late[0]) < 2.0 * scatter
    assert rows["stress_xz"][strain < 0.1].mean() < 0.5 * level
