"""Numbers that follow from a scene: stiffness, Reynolds number, Jeffery motion, counts.

Source of the numbers: Sasayama & Inagaki 2018 and the closed forms of a rigid chain of beads;
tolerance: the printed digits, or rounding.
"""

from __future__ import annotations

import tomllib

import pytest

from tests.scene_text import ONE_FIBER, cell, fiber
from warpfiber.scene import derived as dv
from warpfiber.scene import scene_from_dict


def test_effective_stiffness_and_reynolds_number() -> None:
    """0.5 GPa, 100 Pa s, 100 /s, r_f = 50: 3.93e-4 and 0.1; the rigid cells: 1."""
    scene = fiber()
    assert dv.effective_stiffness(scene, scene.fibers[0]) == pytest.approx(3.93e-4, rel=1e-3)
    assert dv.reynolds_number(scene, scene.fibers[0]) == pytest.approx(0.1)
    rigid = cell()
    assert dv.effective_stiffness(rigid, rigid.fibers[0]) == pytest.approx(1.0, rel=1e-3)
    assert dv.crowding(rigid, rigid.fibers[0]) == pytest.approx(1.12, rel=1e-3)


@pytest.mark.parametrize(
    ("ratio", "weights", "r_e", "period"),
    [
        (10, "end_weighted", 7.1063352018, 0.455345876787),
        (100, "end_weighted", 70.7142135642, 4.443993608914),
        (100, "plain", 71.0703876449, 4.466368233484),
    ],
)
def test_jeffery_periods(ratio: float, weights: str, r_e: float, period: float) -> None:
    """Equivalent aspect ratio and period of rigid chains without inertia, to all printed digits."""
    scene = fiber(
        fibers__0__aspect_ratio=ratio, numerics__segments=1, numerics__torque_weights=weights
    )
    group = scene.fibers[0]
    assert dv.equivalent_aspect_ratio(scene, group) == pytest.approx(r_e, rel=1e-11)
    assert dv.jeffery_period(scene, group) == pytest.approx(period, rel=1e-11)


def test_counts_of_nodes_segments_beads() -> None:
    """446 fibers of 3 segments."""
    group = cell().fibers[0]
    assert (dv.node_count(group), dv.segment_count(group)) == (1784, 1338)
    assert dv.bead_count(group) == 8920


def test_derived_numbers_of_a_still_fluid_are_none() -> None:
    """No rate, no such number."""
    tables = tomllib.loads(ONE_FIBER)
    tables["flow"] = {"kind": "rest", "viscosity": 1}
    tables["stage"] = [{"kind": "flow", "end_time": 1}]
    scene = scene_from_dict(tables)
    for number in (dv.effective_stiffness, dv.reynolds_number, dv.jeffery_period):
        assert number(scene, scene.fibers[0]) is None
    assert dv.total_strain(scene) == 0.0
