"""Where fibers in contact come to rest, and the forces that keep them there.

Source: statics: what a contact carries; beam theory; drag of rigid rods. Units: a = eta = 1.
Tolerance: contacts are solved to a thousandth of a radius or better, so that forces and places at
    rest are theirs to that; approach to rest is exponential and has ended.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, place, straight_fiber
from tests.meeting_cell import HARD, last_rows, rejected
from tests.reference.bead_chain import Array
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
REST = {"kind": "rest", "viscosity": 1.0}
BETWEEN_WALLS = {"size": [60.0, 60.0, 40.0], "boundary": ["open", "open", "wall"]}
DOWN = {"acceleration": [0.0, 0.0, -1.0], "fluid_density": 0.0}


def weight_of(kind: Kind) -> float:
    """Of the beads of a fiber, in N."""
    return 4.0 / 3.0 * math.pi * kind.radius**3 * kind.density * kind.aspect_ratio


def forces(sim: Simulation) -> Array:
    """Row forces of the last step, N."""
    found: Array = last_rows(sim)["force"] * sim.model.units.force
    return found


@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
def test_a_rod_rests_on_a_wall(start: Start, method: str) -> None:
    """Both ends within the tolerance of the wall, which carries the weight."""
    kind = Kind(1, 4.0, density=2.0)
    sim = start(
        [kind],
        [straight_fiber(kind, (1.0, 0.0, 0.3), (30.0, 30.0, 4.0))],
        flow=REST,
        box=BETWEEN_WALLS,
        contact=HARD,
        gravity=DOWN,
        numerics={"method": method, "dt": 1.0, "contact_tolerance": 1e-6},
    )
    sim.step(300)
    assert np.abs(sim.node_pos[:, 2] - 1.0).max() < 1e-5
    force = forces(sim)
    assert force.sum() == pytest.approx(weight_of(kind), rel=1e-4)
    assert force == pytest.approx(0.5 * weight_of(kind), rel=1e-3)
    assert rejected(sim) == 0


@pytest.mark.parametrize("weights", ["end_weighted", "plain"])
def test_what_an_end_of_a_rod_gives_way(start: Start, weights: str) -> None:
    """One end on a wall: force = overlap / (dt (1/xi + s^2 |q|^2/K_r)), w beads bear torque."""
    kind = Kind(1, 1.5, density=2.0)  # few beads, whose torque matters
    tilt = np.array([0.8, 0.0, 0.6])
    half = kind.spacing
    center = np.array([30.0, 30.0, 1.0 + 0.6 * half - 0.01])
    sim = start(
        [kind],
        [straight_fiber(kind, tilt, center)],
        flow=REST,
        box=BETWEEN_WALLS,
        contact=HARD,
        numerics={
            "method": "rigid_rod",
            "dt": 0.1,
            "torque_weights": weights,
            "contact_tolerance": 1e-12,
        },
    )
    sim.step()
    n = kind.aspect_ratio
    bearing = n if weights == "end_weighted" else n - 1.0
    turning = 2.0 * math.pi * (n * (n * n - 1.0) + 4.0 * bearing)
    mobility = 1.0 / (6.0 * math.pi * n) + half**2 * 0.8**2 / turning
    assert forces(sim).max() == pytest.approx(0.01 / (0.1 * mobility), rel=1e-9)


@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
def test_a_stack_carries_its_weight(start: Start, method: str) -> None:
    """Layers of two crossed rods each: every pair of layers passes on all that is above."""
    kind = Kind(1, 6.0, density=2.0)
    nodes = []
    for layer in range(4):
        along = ((1, 0, 0), (0, 1, 0))[layer % 2]
        aside = ((0, 4, 0), (4, 0, 0))[layer % 2]
        for side in (-1, 1):
            middle = np.array([30.0, 30.0, 1.05 + 2.03 * layer]) + side * np.array(aside)
            nodes.append(straight_fiber(kind, along, middle))
    sim = start(
        [kind],
        nodes,
        flow=REST,
        box=BETWEEN_WALLS,
        contact=HARD,
        gravity=DOWN,
        numerics={"method": method, "dt": 0.5, "contact_tolerance": 1e-6},
    )
    sim.step(300)
    rows, force = last_rows(sim), forces(sim)
    weight = weight_of(kind)
    layer_of = sim.model.host["segment_fiber"] // 2
    for below in range(-1, 3):
        crosses = [
            (below < 0 if j < 0 else {layer_of[i], layer_of[j]} == {below, below + 1})
            for i, j in zip(rows["i"], rows["j"], strict=True)
        ]
        carried = force[np.array(crosses)].sum()
        assert carried == pytest.approx((6 - 2 * below) * weight, rel=1e-3), below
    heights = sim.node_pos[:, 2].reshape(4, -1)
    assert heights == pytest.approx(np.tile(1.0 + 2.0 * np.arange(4.0), (4, 1)).T, abs=1e-4)


def test_two_rods_pressed_together_by_a_flow(start: Start) -> None:
    """Crossed rods in a planar extension stay apart, pressed by what the flow would bring them.

    Compression along z moves both centers by -z: w = 2a |d| at the contact; the force that holds
    them is w xi/2.
    """
    kind = Kind(1, 9.0)
    rods = [
        straight_fiber(kind, (1, 0, 0), (0.0, 0.0, -1.0)),
        straight_fiber(kind, (0, 1, 0), (0.0, 0.0, 1.0)),
    ]
    flow = {
        "kind": "gradient",
        "viscosity": 1.0,
        "gradient": [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
    }
    sim = start([kind], rods, flow=flow, contact=HARD, numerics={"method": "rigid_rod", "dt": 0.01})
    sim.step(100)
    apart = np.linalg.norm(sim.node_pos.reshape(2, 2, 3).mean(axis=1) @ [0, 0, 1.0])
    assert apart == pytest.approx(math.sqrt(2.0), abs=2e-3)
    expected = 2.0 * 6.0 * math.pi * 10.0 / 2.0
    # first order in dt: the push answers the approach of a whole step
    assert forces(sim).sum() == pytest.approx(expected, rel=0.02)


def sag(segments: int, modulus: float = 2e5) -> float:
    """Of a heavy fiber on two frozen ones, over that of beam theory."""
    span = 24.0
    kinds = (Kind(segments, 20.0 / segments, modulus=modulus, density=1.0), Kind(1, 6.0))
    beam = straight_fiber(kinds[0], (1, 0, 0), (0.0, 0.0, 2.0))
    props = [straight_fiber(kinds[1], (0, 1, 0), (x, 0.0, 0.0)) for x in (-span / 2, span / 2)]
    groups = [
        kind.table(count, position=[[0.0, 0.0, 0.0]] * count)
        for kind, count in zip(kinds, (1, 2), strict=True)
    ]
    groups[1]["frozen"] = True
    numerics = {"method": "overdamped", "segments": [segments, 1], "device": "cpu"}
    scene = scene_from_dict(
        {
            "flow": REST,
            "fibers": groups,
            "contact": HARD,
            "gravity": DOWN,
            "stage": [{"kind": "flow", "end_time": 1.0}],
            "numerics": numerics | {"dt": 1.0, "contact_tolerance": 1e-6},
        }
    )
    sim = Simulation(scene, placement=place([beam, *props], [0, 1, 1]))
    sim.step(100)
    nodes = sim.node_pos[: segments + 1]
    sim.close()
    weight = weight_of(kinds[0])
    assert forces(sim).sum() == pytest.approx(weight, rel=1e-4)
    assert np.abs(sim.node_pos[segments + 1 :] - np.concatenate(props)).max() < 1e-12
    at = np.interp([-span / 2, 0.0, span / 2], nodes[:, 0], nodes[:, 2])
    over = 0.5 * (40.0 - span)
    # load q per length and P at the ends (half a bead), props at the distance b, c beyond each:
    # q b^2 (5 b^2 - 24 c^2)/(384 E I) - P c b^2/(8 E I)
    load, end = weight / 21.0 / 2.0, weight / 21.0 / 2.0
    line = load * span**2 * (5.0 * span**2 - 24.0 * over**2) / 384.0
    expected = (line - end * over * span**2 / 8.0) / (modulus * math.pi / 4.0)
    return float(0.5 * (at[0] + at[2]) - at[1]) / expected


def test_a_heavy_fiber_sags_between_two_props() -> None:
    """As beam theory says, the chain being of second order in its segments."""
    errors = [abs(sag(segments) - 1.0) for segments in (10, 20)]
    assert errors[1] < 0.02
    assert errors[1] < 0.35 * errors[0]
