"""Walls of the box with a friction and a sliding motion of their own; faults of such walls."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import start_rods
from tests.scene_text import changed, faults_of
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

RADIUS, STEP = 1.2e-3, 2.4e-3
WALLS = {"size": [1.0, 1.0, 0.1], "boundary": ["open", "wall", "wall"]}
BELT = {"name": "z-", "velocity": [0.1, 0.0, 0.0]}


def lying(*walls: dict[str, Any], friction: float = 0.0, **tables: Any) -> Simulation:
    """A fiber at rest along x on the lower wall of WALLS, pressed by its weight."""
    rest = np.array([0.5, 0.5, RADIUS - 1.5e-6]) + np.outer(np.arange(7) * STEP, [1.0, 0.0, 0.0])
    return start_rods(
        [ref.Rod(rest, RADIUS, caps="capsule")],
        wall=list(walls),
        contact={"law": "none", "damping": 0.5, "wall_friction": friction},
        **{"box": WALLS, "gravity": {}, **tables},
    )


def speed(sim: Simulation) -> np.ndarray:
    """Of the middle of the fiber, m/s."""
    mass = np.ones(7)
    mass[[0, -1]] = 0.5 + 2.0 * RADIUS / (3.0 * STEP)  # half a segment and half a sphere
    found: np.ndarray = mass @ sim.node_velocity / mass.sum()
    return found


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_belt(precision: str) -> None:
    """It drags with mu g until the fiber goes with it; weight alone presses, to 1 %."""
    sim = lying(BELT, friction=0.3, numerics={"precision": precision})
    ends = 0.1 / (0.3 * 9.81)
    sim.run(time=0.5 * ends)
    first = speed(sim)[0]
    sim.run(time=0.9 * ends)
    assert (speed(sim)[0] - first) / (0.4 * ends) == pytest.approx(0.3 * 9.81, rel=0.01)
    sim.run(time=4.0 * ends)
    assert speed(sim)[0] == pytest.approx(0.1, rel=1e-3)


def test_belt_is_the_same_seen_from_itself() -> None:
    """A fiber thrown backwards on a wall at rest moves alike but for the belt's velocity."""
    still = lying({"name": "z-", "friction": 0.3})
    velocity = np.tile([-0.1, 0.0, 0.0], (7, 1)) / still.model.units.velocity
    still.state.node_velocity.assign(velocity)
    moving = lying(BELT, friction=0.3)
    for time in (0.01, 0.03, 0.06):
        still.run(time=time)
        moving.run(time=time)
        seen = moving.node_velocity - [0.1, 0.0, 0.0]
        assert np.abs(seen - still.node_velocity).max() < 1e-10
    assert np.abs(still.node_velocity).max() < 0.05


def test_friction_by_wall() -> None:
    """A wall's own friction holds for it alone, whatever that of all walls is."""
    tilt = math.atan(0.4)
    down = [9.81 * math.sin(tilt), 0.0, -9.81 * math.cos(tilt)]
    cases = [
        (0.0, {"name": "z-", "friction": 0.5}, True),
        (0.5, {"name": "z-", "friction": 0.3}, False),
        (0.5, {"name": "z+", "friction": 0.0}, True),
        (0.0, {"name": "y-", "friction": 0.5}, False),
    ]
    for friction, wall, sticks in cases:
        sim = lying(wall, friction=friction, gravity={"acceleration": down})
        sim.run(time=0.1)
        mu = 0.0 if wall["name"] == "y-" else 0.3
        slid = (math.sin(tilt) - mu * math.cos(tilt)) * 9.81 * 0.1
        assert speed(sim)[0] == pytest.approx(0.0 if sticks else slid, abs=2e-3)


def test_friction_of_a_container() -> None:
    """A fiber along the axis sinks at g - mu push / m on a side that has a friction of its own."""
    cylinder = {
        "name": "side",
        "kind": "cylinder",
        "axis": [0, 0, 1],
        "center": [0.5, 0.5, 0.5],
        "radius": 0.02,
        "height": 1.0,
        "friction": 0.4,
    }
    rest = np.array([0.5 + 0.02 - RADIUS + 1.5e-6, 0.5, 0.5])
    rest = rest + np.outer(np.arange(7) * STEP, [0.0, 0.0, 1.0])
    sim = start_rods(
        [ref.Rod(rest, RADIUS, caps="capsule")],
        wall=[cylinder],
        contact={"law": "none", "damping": 0.5},
        gravity={"acceleration": [9.81, 0.0, -9.81]},
    )
    sim.run(time=0.05)
    first = speed(sim)[2]
    sim.run(time=0.1)
    assert (speed(sim)[2] - first) / 0.05 == pytest.approx(-0.6 * 9.81, rel=0.01)


def chute(tilt: float, **keys: Any) -> dict[str, Any]:
    """A plane through the middle that falls along x."""
    normal = [math.sin(tilt), 0.0, math.cos(tilt)]
    return {"name": "chute", "normal": normal, "position": [0.5, 0.5, 0.05], **keys}


def on_chute(tilt: float, friction: float) -> Simulation:
    """A fiber that lies along the fall of a plane in an open box."""
    along = np.array([math.cos(tilt), 0.0, -math.sin(tilt)])
    normal = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    rest = np.array([0.5, 0.5, 0.05]) + (RADIUS - 1.5e-6) * normal
    rest = rest + np.outer(np.arange(7) * STEP, along)
    return start_rods(
        [ref.Rod(rest, RADIUS, caps="capsule")],
        wall=[chute(tilt, friction=friction)],
        contact={"law": "none", "damping": 0.5},
        gravity={},
    )


@pytest.mark.parametrize(("friction", "slides"), [(0.9, False), (0.3, True)])
def test_chute(friction: float, slides: bool) -> None:
    """A fiber along a plane askew sticks above tan of its tilt and slides below."""
    tilt = 0.6
    sim = on_chute(tilt, friction)
    sim.run(time=0.05)
    first = np.linalg.norm(speed(sim))
    sim.run(time=0.1)
    rate = (np.linalg.norm(speed(sim)) - first) / 0.05
    expected = 9.81 * (math.sin(tilt) - friction * math.cos(tilt)) if slides else 0.0
    assert rate == pytest.approx(expected, abs=0.01 * 9.81)


def test_level_plane_is_a_wall() -> None:
    """A plane of its own in the place of a wall of the box does the same; rounding."""
    wall = lying({"name": "z-", "friction": 0.3, "velocity": [0.1, 0.0, 0.0]})
    level = {"name": "floor", "normal": [0, 0, 1], "position": [0.2, 0.1, 0.0], "friction": 0.3}
    plane = lying(level | {"velocity": [0.1, 0.0, 0.0]}, box=WALLS | {"boundary": ["open"] * 3})
    for time in (0.01, 0.03):
        for sim in (wall, plane):
            sim.run(time=time)
        assert np.abs(wall.node_velocity - plane.node_velocity).max() < 1e-12
    assert np.abs(plane.node_velocity).max() > 0.01


def test_bed_between_planes() -> None:
    """Fibers are placed inside a trough of two planes and stay there."""
    walls = [
        {"name": "left", "normal": [0.6, 0.0, 0.8], "position": [0.0, 0.0, 0.03]},
        {"name": "right", "normal": [-0.6, 0.0, 0.8], "position": [0.06, 0.0, 0.03]},
    ]
    tables: dict[str, Any] = {
        "box": {"size": [0.06, 0.04, 0.12], "boundary": ["open", "periodic", "open"]},
        "fibers": [
            {
                "count": 20,
                "centerline_length": 0.024,
                "diameter": 2.0 * RADIUS,
                "density": 1340.0,
                "youngs_modulus": 7.5e5,
            }
        ],
        "wall": walls,
        "gravity": {},
        "contact": {"friction": 0.3, "wall_friction": 0.3, "damping": 0.113},
        "stage": [{"kind": "settle", "damping": 8.0, "end_time": 0.3}],
        "numerics": {"method": "bonded_spheres", "segments": 8, "device": "cpu"},
    }
    sim = Simulation(scene_from_dict(tables))

    def inside(nodes: np.ndarray) -> float:
        """Least distance of a node from the planes, m."""
        return min(((nodes - w["position"]) @ w["normal"]).min() for w in walls)

    assert inside(sim.node_pos) >= RADIUS
    sim.run()
    assert 0.5 * RADIUS < inside(sim.node_pos) < RADIUS
    assert sim.node_pos[:, 2].min() > 0.0


FAULTS: list[tuple[dict[str, Any], str, str]] = [
    ({"name": "x-"}, "wall.0.name", "walls are z- z+"),
    ({"name": "cylinder", "normal": [0, 0, 1], "position": [0, 0, 0]}, "wall.0.name", "a kind"),
    ({"name": "lid", "normal": [0, 0, 1]}, "wall.0.position", "no wall of the box"),
    ({"name": "lid", "position": [0, 0, 1]}, "wall.0.normal", "no wall of the box"),
    (
        {"name": "lid", "normal": [0.6, 0, 0.8], "position": [0, 0, 0]},
        "wall.0.normal",
        "across the periodic axis x",
    ),
    (
        {"name": "lid", "normal": [0, 0, 1], "position": [0, 0, 0], "velocity": [0, 0, 1]},
        "wall.0.velocity",
        "in its plane alone",
    ),
    ({"name": "z-", "normal": [0, 0, 1]}, "wall.0.normal", "box.size"),
    ({"name": "z-", "position": [0, 0, 1]}, "wall.0.position", "box.size"),
    ({"name": "z-", "velocity": "flow"}, "wall.0.velocity", "nothing flows"),
    ({"name": "z-", "velocity": [1, 0, 1]}, "wall.0.velocity", "in its plane alone"),
]


def bed(*walls: dict[str, Any]) -> dict[str, Any]:
    """Tables of fibers between two walls."""
    tables = changed({"numerics.method": "bonded_spheres"})
    del tables["flow"]
    tables["stage"] = [{"kind": "settle", "end_time": 0.1}]
    tables["contact"] = {"wall_friction": 0.3}
    tables["record"] = {}
    return tables | {"wall": list(walls)}


@pytest.mark.parametrize(("wall", "key", "remedy"), FAULTS)
def test_faults(wall: dict[str, Any], key: str, remedy: str) -> None:
    """Key and remedy, one fault each."""
    assert scene_from_dict(bed({"name": "z+", "friction": 0.2})).walls[0].friction == 0.2
    (fault,) = faults_of(bed(wall))
    assert fault.key == key and remedy in str(fault)


def test_names_and_methods() -> None:
    (fault,) = faults_of(bed({"name": "z-"}, {"name": "z-"}))
    assert "has this name already" in str(fault)
    (fault,) = faults_of(changed({}) | {"wall": [{"name": "z-", "friction": 0.1}]})
    assert fault.key == "wall.0.kind" and "bead_chain" in str(fault)
