"""`auto` where contact decides: a trial of rods, and what their contacts would bend."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from warpfiber.trial import after_trial

SCENE = Path(__file__).parents[2] / "scenes" / "sasayama_2018" / "shear_cell.toml"
STIFF = 3.26e10  # Pa, S_eff = 1


def cell(modulus: float, path: Path = SCENE, **keys: Any) -> wf.Scene:
    edge = 2.5e-4
    tables = {
        "box.size": [edge] * 3,
        "box.boundary": ["periodic"] * 3,
        "contact.lubrication": "none",
        "numerics.method": "auto",
        "numerics.tolerance": 1e-3,
        "fibers.0.youngs_modulus": modulus,
    }
    return wf.load_scene(path, tables | keys)


@pytest.mark.parametrize(("stiffer", "tried"), [(1.0, False), (10.0, True), (1000.0, False)])
def test_only_an_open_question_is_tried(stiffer: float, tried: bool) -> None:
    """A bound far below the tolerance needs no trial, one far above it has no chance."""
    scene = cell(stiffer * STIFF)
    assert (scene.rod_trial is not None) == tried
    assert scene.numerics.method == ("rigid_rod" if stiffer == 1000.0 else "overdamped")
    assert after_trial(scene).rod_trial is None


def test_trial_decides_by_the_forces() -> None:
    """The same forces bend fibers of half the modulus twice as far: a tolerance between decides."""
    scene = cell(10.0 * STIFF)
    assert scene.rod_trial is not None
    chosen = after_trial(scene)
    bent = float(str(chosen.method_reason).split("up to ")[1].split(" ")[0])
    assert 0.0 < bent < 0.0038  # the bound on the force of two lone rods, E L^4 as in the cell
    assert chosen.numerics.method == ("rigid_rod" if bent <= 1e-3 else "overdamped")
    loose = cell(10.0 * STIFF, **{"numerics.tolerance": 1.2 * bent})
    strict = cell(10.0 * STIFF, **{"numerics.tolerance": 0.8 * bent})
    assert after_trial(loose).numerics.method == "rigid_rod"
    assert after_trial(strict).numerics.method == "overdamped"


@pytest.mark.parametrize("edge", [2.25e-4, 2.8e-4])
def test_rods_that_fail_are_not_chosen(tmp_path: Path, edge: float) -> None:
    """The box holds short segments for long, rods for less than the trial or not at all."""
    path = tmp_path / "scene.toml"
    text = SCENE.read_text().replace("simple_shear", "planar_extension")
    path.write_text(text.replace("shear_rate", "extension_rate"))
    scene = cell(10.0 * STIFF, path, **{"box.size": [edge] * 3})
    assert scene.rod_trial is not None
    chosen = after_trial(scene)
    assert chosen.numerics.method == "overdamped"
    assert chosen.rod_trial is None
    assert "a trial of rods fails" in str(chosen.method_reason)


def test_bending_of_the_last_contacts() -> None:
    """F L^2/(75 E I) of the forces on the most loaded rod."""
    simulation = wf.Simulation(
        cell(STIFF, **{"numerics.method": "rigid_rod", "numerics.segments": 1})
    )
    simulation.step(2)
    method = simulation.method
    rows, _ = method.contact.solves[0]  # type: ignore[attr-defined]
    count = int(rows.row_count.numpy()[0])
    force = np.zeros(simulation.model.fiber_count)
    np.add.at(force, rows.row_i.numpy()[:count], rows.row_force.numpy()[:count])
    np.add.at(force, rows.row_j.numpy()[:count], rows.row_force.numpy()[:count])
    length = simulation.scene.fibers[0].centerline_length
    inertia = 0.25 * math.pi * (5e-6) ** 4
    bent = force.max() * simulation.model.units.force * length**2 / (75.0 * STIFF * inertia)
    assert method.step_report()["contact_bending"] == pytest.approx(bent, rel=1e-9)
    assert bent > 0.0
    simulation.close()
