"""Three load-unload cycles of 100 S fibers: what Xu, Ma & Guo 2023 say of Figs. 7 and 9.

Run with `tools/test -m papers`. One random start; absolute pressures are told in the scene's README
and not asserted.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "xu_2023" / "s_fibers_quick.toml"
pytestmark = pytest.mark.papers

Rows = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def branches(tmp_path_factory: pytest.TempPathFactory) -> list[Rows]:
    """Rows of settling, and of loading and unloading in turn (some minutes)."""
    out = tmp_path_factory.mktemp("xu") / "out"
    keys = {"record.figures": False, "record.trajectory": False}
    assert wf.Job.start(wf.load_scene(SCENE, keys), out=out).run() == 0
    table = np.genfromtxt(out / "scalars.csv", delimiter=",", names=True)
    log = (out / "log.txt").read_text().splitlines()
    ends = [float(line.split("time ")[1].split()[0]) for line in log if "ended" in line]
    marks = np.searchsorted(table["time"], [-1.0, *(end + 1e-6 for end in ends)])
    return [{n: table[n][a:b] for n in table.dtype.names} for a, b in pairwise(marks)]


def at(rows: Rows, name: str, fraction: float) -> float:
    """A column of one branch where the volume fraction is this."""
    order = np.argsort(rows["volume_fraction"])
    return float(np.interp(fraction, rows["volume_fraction"][order], rows[name][order]))


def fraction_at(rows: Rows, pressure: float) -> float:
    """Volume fraction at which loading first reaches a pressure (Pa)."""
    return float(rows["volume_fraction"][np.argmax(rows["pressure_high"] >= pressure)])


def test_the_lower_wall_bears_the_weight(branches: list[Rows]) -> None:
    """100 fibers of A L_c + caps on 60 x 60 mm, to 2 %."""
    radius, length = 1.2e-3, 0.06283
    volume = np.pi * radius**2 * (length + 4.0 / 3.0 * radius)
    weight = 100.0 * volume * 1340.0 * 9.81 / 0.06**2
    settled = branches[0]["pressure_low"][-20:].mean()
    assert settled == pytest.approx(weight, rel=0.02)


def test_cycles(branches: list[Rows]) -> None:
    """Cycle 2 lies at higher fractions, cycle 3 nearer to it than cycle 2 to the first."""
    first, second, third = (fraction_at(rows, 1e3) for rows in branches[1::2])
    assert second > first
    assert abs(third - second) < second - first


def test_unloading_lies_below_loading(branches: list[Rows]) -> None:
    """At equal fractions: lower pressure, and no more touching fibers."""
    load, unload = branches[1], branches[2]
    for fraction in (0.30, 0.35):
        assert at(unload, "pressure_high", fraction) < at(load, "pressure_high", fraction)
        assert at(unload, "coordination_number", fraction) < at(
            load, "coordination_number", fraction
        )
