"""The quick scene of the sliding plate over 60 strain units: its curves, layers and files.

Bounds of the whole cell's end (a11 by length 0.65 to 0.85, a33 below 0.03) with the scatter of a
sample of 1000 fibers, 0.03 in a layer; half a minute on a quiet machine.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf
from warpfiber.output.layer_figures import read_layers

pytestmark = pytest.mark.papers
SCENE = Path(__file__).parents[2] / "scenes" / "sliding_plate" / "quick.toml"


def test_quick_sliding_plate(tmp_path: Path) -> None:
    """Faster than the experiment, steady at the end, one structure through the thickness."""
    job = wf.Job.start(wf.load_scene(SCENE), out=tmp_path / "run")
    assert job.run() == 0
    rows = wf.read_scalars(tmp_path / "run" / "scalars.csv")
    assert rows["overlap_max"].max() <= 0.05
    assert 0.65 < rows["a11"][-1] < 0.85 and rows["a33"][-1] < 0.03
    assert rows["a11"][-1] > rows["a11_fiber"][-1] + 0.03  # long fibers turn in
    # without contact the same fibers would have 0.507 by length at 12.5
    at_12 = np.argmin(np.abs(rows["strain"] - 12.5))
    assert rows["a11"][at_12] > 0.507
    assert np.nanmin(rows["relative_viscosity"]) > 1.0
    layers = read_layers(tmp_path / "run" / "layers.csv")
    assert layers is not None
    a11 = layers.values["a11"]
    np.testing.assert_allclose(a11[0], 0.36, atol=0.03)
    inner = a11[-1, 1:-1]
    assert np.ptp(inner) < 0.12
    assert inner.mean() > a11[-1, [0, -1]].mean()  # layers at the walls lag behind
    assert (tmp_path / "run" / "placement.csv").exists()
