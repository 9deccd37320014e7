"""Long rods between plates: one that stands across them swings around, many hold up a cell.

Source: a rod held at p_z = s by frictionless planes has the velocity of its orbit but for p_z: with
    (p_x, p_y) = sqrt(1 - s^2) (cos phi, sin phi)
        tan(phi/2) = tan(phi_0/2) exp(-(1 + lambda_J)/2 s/sqrt(1 - s^2) strain)
    until p_x = 0, from where on it lies down. Ends in the grooves of an array cannot swing.
Tolerances: first order in dt, p asserted; ends to the overlap at which a step is taken again.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, place, straight_fiber
from tests.meeting_cell import rejected
from warpfiber.scene import load_scene, scene_from_dict
from warpfiber.simulation import Simulation

ROD = Kind(1, 19.0)
UP = 0.6
HEIGHT = 38.0 * UP + 2.0
START = math.radians(150.0)


def standing(dt: float, wall: float | None = None, tilt: float = START, **numerics: Any) -> Any:
    """A rod whose ends touch both plates, turned by `tilt` from the flow; its direction later."""
    tables: dict[str, Any] = {
        "box": {"size": [60.0, 60.0, HEIGHT], "boundary": ["periodic", "periodic", "wall"]},
        "flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0},
        "fibers": [ROD.table(1)],
        "contact": {"law": "exponential"},
        "stage": [{"kind": "flow", "end_strain": 40.0}],
        "numerics": {
            "method": "rigid_rod",
            "dt": dt,
            "device": "cpu",
            "contact_tolerance": 1e-6,
            **numerics,
        },
    }
    if wall is not None:
        tables["wall"] = [
            {"name": name, "kind": "fiber_array", "diameter": wall} for name in ("z-", "z+")
        ]
    flat = math.sqrt(1.0 - UP * UP)
    axis = (flat * math.cos(tilt), flat * math.sin(tilt), UP)
    nodes = straight_fiber(ROD, axis, (30.0, 30.0, 0.5 * HEIGHT))
    return Simulation(scene_from_dict(tables), placement=place([nodes], [0]))


def direction(sim: Simulation) -> np.ndarray:
    span = sim.node_pos[1] - sim.node_pos[0]
    return np.asarray(span / np.linalg.norm(span))


def test_standing_rod_swings_around_on_planes() -> None:
    """Its azimuth after a strain of 1, off by O(dt); then it lies down along the flow."""
    shape = (20.0**2 - 1.0) / (20.0**2 + 3.0)
    rate = 0.5 * (1.0 + shape) * UP / math.sqrt(1.0 - UP * UP)
    asked = 2.0 * math.atan(math.tan(0.5 * START) * math.exp(-rate))
    errors = []
    for dt in (0.05, 0.025, 0.0125):
        sim = standing(dt)
        sim.step(round(1.0 / dt))
        p = direction(sim)
        assert 19.0 * abs(p[2] - UP) < 0.03 and p[0] < 0.0
        assert rejected(sim) == 0
        errors.append(abs(math.atan2(p[1], p[0]) - asked))
    for coarse, fine in zip(errors, errors[1:], strict=False):
        assert 1.6 < coarse / fine < 2.4
    assert errors[-1] < 0.02
    sim.run(until=12.0)
    p = direction(sim)
    assert p[0] * np.sign(p[2]) > 0.9


def test_ends_in_the_grooves_of_an_array_hold_a_rod() -> None:
    """Set down in grooves that lie right below and above, it stands as it was after strains of 20.

    A spacing of 2: the way of both ends across is a whole number of grooves.
    """
    flat = math.sqrt(1.0 - UP * UP)
    tilt = math.pi - math.asin(8.0 / (38.0 * flat))
    sim = standing(0.05, 2.0, tilt)
    before = direction(sim)
    sim.run(until=20.0)
    after = direction(sim)
    assert np.abs(after - before).max() < 0.1
    assert after[0] < -0.7


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_few_wedged_rods_hold_up_a_cell() -> None:
    """Of 977 rods between arrays some 5: steps are halved again and again, the cell is stiffer.

    With those mirrored not one step in fifty is.
    """
    tried, viscosity = {}, {}
    for wedged in ("keep", "mirror"):
        keys = {"fibers.0.wedged": wedged, "numerics.linearizations": 1}
        sim = Simulation(load_scene("scenes/sliding_plate/quick.toml", keys), workers=1)
        found = []
        while sim.strain < 8.0:
            sim.step(4)
            found.append(sim.measure()["relative_viscosity"])
        tried[wedged], viscosity[wedged] = rejected(sim), max(found)
        sim.close()
    assert tried["mirror"] <= 3 and tried["keep"] > 50
    assert viscosity["keep"] > 1.2 * viscosity["mirror"]
