"""Fibers in an upright cylinder: its contact, swinging and rolling inside, placement, faults."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import rates, start_rods
from warpfiber.placement import place_fibers
from warpfiber.scene import SceneError, scene_from_dict
from warpfiber.simulation import Simulation

RADIUS, STEP, ROUND = 1.2e-3, 2.4e-3, 0.02
AXIS = np.array([0.03, 0.025, 0.05])
BOX = {"size": [0.06, 0.05, 0.1]}
CYLINDER = {
    "name": "side",
    "kind": "cylinder",
    "axis": [0, 0, 1],
    "center": AXIS.tolist(),
    "radius": ROUND,
    "height": 0.08,
}


def upright(angle: float, depth: float) -> ref.Rod:
    """A fiber along the axis that presses the wall, at an angle from x."""
    away = ROUND - RADIUS + depth
    foot = AXIS + [away * math.cos(angle), away * math.sin(angle), -2.0 * STEP]
    return ref.Rod(foot + np.outer(np.arange(5) * STEP, [0, 0, 1]), RADIUS, caps="capsule")


def inside(rod: ref.Rod, v: np.ndarray | None = None, **keys: Any) -> Simulation:
    """A fiber in the container."""
    contact = {"law": "none", **keys.pop("contact", {})}
    return start_rods([rod], v=v, box=BOX, wall=[CYLINDER], contact=contact, **keys)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("angle", [0.0, 2.2, -1.0])
def test_push(angle: float, precision: str) -> None:
    """4/3 E* sqrt(R*) d^1.5 towards the axis, 1 / R* = 1 / a - 1 / R; k eps of the overlap."""
    depth = 1e-4
    rod = upright(angle, depth)
    linear, angular = rates(inside(rod, numerics={"precision": precision}))
    push = 4.0 / 3.0 * 7.5e5 / 0.75 * depth**1.5 / math.sqrt(1.0 / RADIUS - 1.0 / ROUND)
    way = -np.array([math.cos(angle), math.sin(angle), 0.0])
    found = linear * rod.mass[:, None]
    tolerance = 1e-9 if precision == "float64" else 1e-3
    assert np.abs(found - push * way).max() < tolerance * push
    assert np.abs(angular).max() == 0.0
    sim = inside(upright(angle, -1e-6), numerics={"precision": precision})
    assert np.abs(rates(sim)[0]).max() == 0.0


@pytest.mark.parametrize(("friction", "part"), [(0.0, 1.0), (2.0, 5.0 / 7.0)])
def test_swing(friction: float, part: float) -> None:
    """Weight across the axis: omega^2 = g / (R - a) sliding, 5/7 of it rolling (J = 2/5 m a^2).

    The overlap shortens the lever and lengthens the pendulum, 1e-3 each; amplitude 0.05 rad.
    """
    gravity = 9.81
    sim = inside(
        upright(0.05, 2e-6),
        gravity={"acceleration": [gravity, 0.0, 0.0]},
        contact={"damping": 0.3, "wall_friction": friction},
        quantities=["energy"],
    )
    sim.run(time=0.01)
    row = sim.measure()
    omega = math.sqrt(part * gravity / (ROUND - RADIUS))
    found, times = [], np.linspace(0.01, 0.01 + 2.0 * math.pi / omega, 41)
    for time in times:
        sim.run(time=time)
        found.append((sim.node_pos[:, 1].mean() - AXIS[1]) / (ROUND - RADIUS))
    wave = np.stack([np.cos(omega * times), np.sin(omega * times)], axis=1)
    fitted = wave @ np.linalg.lstsq(wave, np.asarray(found), rcond=None)[0]
    assert np.abs(fitted - found).max() < 0.03 * np.ptp(found)
    after = sim.measure()
    terms = [sum(v for k, v in r.items() if k.startswith(("energy", "diss"))) for r in (row, after)]
    scale = abs(row["energy_gravity"])
    assert terms[1] == pytest.approx(terms[0], abs=1e-4 * scale)


def scene(**changes: Any) -> dict[str, Any]:
    """Rings in a container with a bottom."""
    tables: dict[str, Any] = {
        "box": {"size": [0.06, 0.05, 0.1], "boundary": ["open", "open", "wall"]},
        "wall": [dict(CYLINDER)],
        "fibers": [
            {
                "count": 12,
                "centerline_length": 0.03,
                "diameter": 2.4e-3,
                "density": 1340.0,
                "youngs_modulus": 7.5e5,
                "shape": {"kind": "s", "curvature": 40.0},
            }
        ],
        "stage": [{"kind": "settle", "end_time": 0.2}],
        "numerics": {"method": "bonded_spheres", "segments": 12, "device": "cpu"},
    }
    for key, value in changes.items():
        part = tables[key][0] if isinstance(tables[key], list) else tables[key]
        part.update(value)
    return tables


@pytest.mark.parametrize("kind", ["s", "straight"])
def test_placement(kind: str) -> None:
    """All nodes lie inside, free of the side, bottom and top."""
    shape = {"kind": kind} | ({"curvature": 40.0} if kind == "s" else {})
    placed = place_fibers(scene_from_dict(scene(fibers={"shape": shape})))
    away = placed.node_pos - AXIS
    assert len(away) == 12 * 13
    assert np.hypot(away[:, 0], away[:, 1]).max() <= ROUND - RADIUS
    assert np.abs(away[:, 2]).max() <= 0.04 - RADIUS


def test_a_bed_stays_inside() -> None:
    """Thrown about with strong gravity towards the side."""
    tables = scene(fibers={"initial_velocity": [2.0, 1.0, -1.0]})
    tables["gravity"] = {"acceleration": [0.0, 20.0, -9.81]}
    tables["contact"] = {"friction": 0.5, "wall_friction": 0.5, "damping": 0.113}
    sim = Simulation(scene_from_dict(tables))
    sim.run(time=0.1)
    away = sim.node_pos - AXIS
    assert np.hypot(away[:, 0], away[:, 1]).max() < ROUND - 0.5 * RADIUS
    assert np.hypot(away[:, 0], away[:, 1]).max() > ROUND - RADIUS


FAULTS = {
    "tilted": ({"wall": {"axis": [0, 1, 1]}}, "wall.0.axis", "upright"),
    "out of the box": ({"wall": {"radius": 0.03}}, "wall.0.radius", "reaches out of the box"),
    "too high": ({"wall": {"height": 0.2}}, "wall.0.height", "reaches out of the box"),
    "moving": ({"wall": {"velocity": [0, 0, 1.0]}}, "wall.0.velocity", "stand still"),
    "thick": (
        {"wall": {"radius": 1e-3}},
        "fibers.0.diameter",
        "does not fit into the container",
    ),
    "wide ring": (
        {"fibers": {"shape": {"kind": "ring"}, "centerline_length": 0.14}},
        "fibers.0.centerline_length",
        "does not fit into the container",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults(name: str) -> None:
    """Told before anything is placed: key and remedy."""
    changes, key, remedy = FAULTS[name]
    tables = scene(**changes)
    tables["contact"] = {"law": "none"}
    with pytest.raises(SceneError) as caught:
        scene_from_dict(tables)
    assert key in str(caught.value) and remedy in str(caught.value)


def test_two_containers_and_other_methods() -> None:
    tables = scene()
    tables["wall"].append({**CYLINDER, "name": "other"})
    with pytest.raises(SceneError, match="a container already"):
        scene_from_dict(tables)


def test_more_than_it_holds() -> None:
    """Fibers that find no place are told."""
    with pytest.raises(SceneError, match="found a free place"):
        place_fibers(scene_from_dict(scene(fibers={"count": 400})))
