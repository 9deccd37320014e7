"""Walls of fibers along x: nothing enters them, fibers rest on and between them; beside planes.

Tolerances: gaps to the tolerance asked of contact, in motion to the overlap at which a step is
taken again (0.05 radii); planes to the depth between two fibers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, place, straight_fiber
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

HEIGHT = 20.0


def cell_tables(method: str, diameter: float | None, walls: str = "z", **tables: Any) -> Any:
    """Fibers of radius 1 between arrays of `diameter`, or between planes."""
    boundary = ["periodic", "wall" if walls == "y" else "periodic", "wall"]
    found: dict[str, Any] = {
        "box": {"size": [60.0, 60.0 if walls == "z" else HEIGHT, HEIGHT], "boundary": boundary},
        "flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0},
        "stage": [{"kind": "flow", "end_strain": 20.0}],
        "record": {"quantities": ["orientation", "overlap"]},
        "numerics": {
            "method": method,
            "segments": 1 if method == "rigid_rod" else 3,
            "strain_step": 0.05,
            "device": "cpu",
        },
    }
    if diameter is not None:
        names = ("z-", "z+") if walls == "z" else ("y-", "y+")
        found["wall"] = [
            {"name": name, "kind": "fiber_array", "diameter": diameter} for name in names
        ]
    return found | tables


def least_distance(sim: Simulation, axis: int, spacing: float, radius: float) -> float:
    """Nearest way from any segment to any middle line of the fibers of both arrays.

    Every segment, cut into 400 points, against every fiber: to 1e-3 of a segment's square length.
    """
    along = 3 - axis
    assert sim.scene.box is not None
    edge, gap = sim.scene.box.size[along], sim.scene.box.size[axis]
    count = round(edge / spacing)
    nodes = sim.node_pos
    first = sim.model.host["segment_node"]
    t = np.linspace(0.0, 1.0, 400)[:, None]
    least = np.inf
    for i in first:
        points = nodes[i] + t * (nodes[i + 1] - nodes[i])
        for height in (-radius, gap + radius):
            across = points[:, along, None] - (np.arange(-count, 2 * count) + 0.5) * spacing
            way = np.hypot(across, points[:, axis, None] - height)
            least = min(least, float(way.min()))
    return least


@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
@pytest.mark.parametrize(("walls", "diameter"), [("z", 2.0), ("z", 3.5), ("y", 2.0)])
def test_sheared_fibers_never_enter_an_array(method: str, walls: str, diameter: float) -> None:
    """A crowded cell, fibers pressed onto both arrays: overlap below 0.05 radii at all times."""
    fibers = {
        "count": 60 if walls == "z" else 25,
        "aspect_ratio": 15,
        "diameter": 2.0,
        "youngs_modulus": 1e5,
        "orientation": [0.5, 0.35, 0.15, 0, 0, 0],
    }
    sim = Simulation(scene_from_dict(cell_tables(method, diameter, walls, fibers=[fibers])))
    axis = 2 if walls == "z" else 1
    edge = sim.scene.box.size[3 - axis] if sim.scene.box else 0.0
    spacing = edge / (edge // diameter)
    nearest = []
    for _ in range(10):
        sim.step(10)
        nearest.append(least_distance(sim, axis, spacing, 0.5 * diameter))
    assert min(nearest) > 1.0 + 0.5 * diameter - 0.05
    assert min(nearest) < 1.0 + 0.5 * diameter + 1e-3
    assert sim.node_pos[:, axis].min() < 1.0 or sim.node_pos[:, axis].max() > 19.0


def settled(direction: tuple[float, float, float], y: float, method: str) -> np.ndarray:
    """Nodes of a fiber that sank onto fibers of its own thickness, spacing 2, at rest."""
    kind = Kind(1 if method == "rigid_rod" else 3, 12.0 if method == "rigid_rod" else 4.0)
    tables = cell_tables(
        method,
        2.0,
        flow={"kind": "rest", "viscosity": 1.0},
        fibers=[kind.table(1, density=1.0)],
        gravity={"acceleration": [0.0, 0.0, -2.0]},
        stage=[{"kind": "flow", "end_time": 100.0}],
    )
    tables["numerics"] |= {"dt": 0.2, "contact_tolerance": 1e-6}
    del tables["numerics"]["strain_step"]
    nodes = straight_fiber(kind, direction, (30.0, y, 1.5))
    sim = Simulation(scene_from_dict(tables), placement=place([nodes], [0]))
    sim.step(500)
    return sim.node_pos


@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
def test_a_fiber_along_the_array_comes_to_rest_between_two(method: str) -> None:
    """Put down beside a crest (y = 31) it slides to y = 32: height sqrt(2^2 - 1) - 1."""
    nodes = settled((1.0, 0.0, 0.0), 31.3, method)
    np.testing.assert_allclose(nodes[:, 1], 32.0, atol=1e-3)
    np.testing.assert_allclose(nodes[:, 2], np.sqrt(3.0) - 1.0, atol=1e-4)


@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
def test_a_fiber_across_the_array_rests_on_crests(method: str) -> None:
    """As on a plane, whatever its ends stand over."""
    nodes = settled((0.0, 1.0, 0.0), 30.4, method)
    np.testing.assert_allclose(nodes[:, 2], 1.0, atol=1e-4)


@pytest.mark.parametrize("diameter", [2.0, 0.8, 0.2])
def test_a_rod_that_tumbles_over_an_array_moves_as_over_a_plane(diameter: float) -> None:
    """Over a crest the same; between two all lies lower by at most the depth there, h.

    h = 1 + R - sqrt((1 + R)^2 - w^2/4) for fibers of radius R, w apart. What lies lower by h is
    behind by h times the strain along x: 1 + 8 times h in all.
    """
    kind, radius = Kind(1, 14.0), 0.5 * diameter
    spacing = 60.0 / round(60.0 / diameter)
    middle = (round(30.0 / spacing) + 0.5) * spacing
    ends = []
    for place_y, wall in ((middle, None), (middle, diameter), (middle + spacing / 2, diameter)):
        tables = cell_tables("rigid_rod", wall, fibers=[kind.table(1)])
        tables["flow"]["origin"] = [30.0, 30.0, 7.6]
        tables["numerics"] |= {"strain_step": 0.01, "contact_tolerance": 1e-6}
        nodes = straight_fiber(kind, (-0.85, 0.0, 0.5), (30.0, place_y, 7.8))
        sim = Simulation(scene_from_dict(tables), placement=place([nodes], [0]))
        lowest = []
        for _ in range(8):
            sim.step(100)
            lowest.append(sim.node_pos[:, 2].min())
        assert min(lowest) < 1.0 + 1e-4
        ends.append(sim.node_pos - [0.0, place_y, 0.0])
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-4)
    depth = 1.0 + radius - np.sqrt((1.0 + radius) ** 2 - 0.25 * spacing**2)
    lower = np.abs(ends[2] - ends[0]).max()
    assert 0.1 * depth < lower < 9.0 * depth
    # the forces of both sides are equal to the tolerance of contact
    np.testing.assert_allclose(ends[2][:, 1], 0.0, atol=1e-6)


def test_lubricated_fibers_between_arrays() -> None:
    """Rows of beads and of arrays in one cell: fibers stay out of both arrays."""
    fibers = {"count": 20, "aspect_ratio": 10, "diameter": 2.0, "youngs_modulus": 1e5}
    tables = cell_tables("rigid_rod", 2.0, fibers=[fibers], contact={"lubrication": "paper"})
    sim = Simulation(scene_from_dict(tables))
    for _ in range(5):
        sim.step(10)
        assert least_distance(sim, 2, 2.0, 1.0) > 2.0 - 0.05
    assert sim.strain > 0.5
