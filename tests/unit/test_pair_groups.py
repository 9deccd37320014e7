"""What two groups of fibers share, against the restatement, for radii that differ."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.reference.capsule_contact import cylinder_rounding, rounding
from tests.unit.test_hertz_table import factors
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.pair_groups import make_pair_group_table

RADII, SOFT, SHEAR = (1.0, 2.5), (0.3, 0.2), (0.7, 0.4)


def table() -> np.ndarray:
    """(2, 2) of two groups."""
    rows: list[Any] = []
    for radius, soft, shear in zip(RADII, SOFT, SHEAR, strict=True):
        row = bond_group_struct("float64")()
        row.radius, row.compliance, row.shear_compliance = radius, soft, shear
        rows.append(row)
    groups = wp.array(rows, dtype=bond_group_struct("float64"), device="cpu")
    return make_pair_group_table("float64", groups, "cpu").numpy()


@pytest.mark.parametrize(("i", "j"), [(0, 0), (0, 1), (1, 0)])
def test_pair_groups(i: int, j: int) -> None:
    """Ends on sides, two ends, cylinders at angles, tangential springs; the table is to 1e-13."""
    row = table()[i, j]
    modulus = 1.0 / (SOFT[i] + SOFT[j])
    ki, kj = 1.0 / RADII[i], 1.0 / RADII[j]
    assert row["reach"] == RADII[i] + RADII[j]
    ends = [modulus * rounding(k, ki + kj) for k in (ki, kj, ki + kj)]
    found = [row[name] for name in ("round_i", "round_j", "round_both")]
    assert found == pytest.approx(ends, rel=1e-12)
    sines = np.array([0.05, 0.3, 0.8, 1.0])
    sides = [modulus * cylinder_rounding(RADII[i], RADII[j], sine) * sine for sine in sines]
    found = row["stiffness"] * factors("float64", row["crossed"] * sines**2)[:, 0]
    assert found == pytest.approx(sides, rel=1e-12)
    part = 4.0 * (SOFT[i] + SOFT[j]) / (SHEAR[i] + SHEAR[j])
    assert [row["shear_part"], row["root_shear"]] == pytest.approx([part, math.sqrt(part)])
