"""The start of the sliding plate: 13,048 fibers of up to 210 diameters in 4.4 x 4.4 x 2 mm.

Tensors to 0.01, overlaps and strains to the bars of the packing; minutes on a busy machine.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.scene_text import GONE
from tests.unit.test_lengths import plate_cell
from warpfiber.placement import place_fibers
from warpfiber.scene import scene_from_dict

pytestmark = pytest.mark.papers


@pytest.mark.parametrize("mode", ["span", "inside"])
def test_start_of_the_sliding_plate(mode: str) -> None:
    """Table 4 of the paper: (0.36, 0.62, 0.02), ten layers, V_f 0.0793, L_N 0.83, L_W 1.53 mm."""
    layer = {
        "thickness": 2e-4,
        "volume_fraction": 0.0793,
        "orientation": [0.36, 0.62, 0.02, 0, 0, 0],
    }
    keys = {"fibers__0__volume_fraction": GONE, "fibers__0__layers": [layer] * 10}
    placed = place_fibers(scene_from_dict(plate_cell(fibers__0__layer_mode=mode, **keys)))
    report = placed.report["tables"][0]
    assert report["count"] == 13048
    assert report["volume_fraction"]["achieved"] == pytest.approx(0.0793, rel=1e-3)
    assert report["number_average_length"]["achieved"] == pytest.approx(0.83e-3, rel=1e-3)
    assert report["weight_average_length"]["achieved"] == pytest.approx(1.53e-3, rel=1e-3)
    way = "by_number" if mode == "inside" else "by_length"
    got = np.array(report["orientation"][way])
    np.testing.assert_allclose(got, [0.36, 0.62, 0.02, 0, 0, 0], atol=0.01)
    overlap = placed.report["overlap"]
    assert overlap["maximum"] < 0.1
    assert report["bending_strain"]["maximum"] < 0.02
