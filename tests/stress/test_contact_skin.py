"""A skin that lasts no step of fibers in contact is told, not worked around in shorter steps."""

from __future__ import annotations

from pathlib import Path

import pytest

import warpfiber as wf

SCENE = Path(__file__).parents[2] / "scenes" / "sasayama_2018" / "shear_cell.toml"


def test_a_given_skin_that_lasts_no_step() -> None:
    keys = {
        "box.size": [2.5e-4] * 3,
        "numerics.method": "rigid_rod",
        "numerics.segments": 1,
        "numerics.skin": 1e-9,
        "contact.lubrication": "none",
    }
    simulation = wf.Simulation(wf.load_scene(SCENE, keys))
    with pytest.raises(wf.SceneError, match="numerics.skin"):
        simulation.run(until=1.0)
    simulation.close()
