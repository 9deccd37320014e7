"""Many fibers of bonded spheres, in contact with each other and with walls, twisted and moving."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.reference.bonded_spheres import exponential
from warpfiber.placement import Placement
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

STEP, RADIUS, HEIGHT = 2.4e-3, 1.2e-3, 0.02
SEGMENTS, COUNTS = (8, 12), (19, 21)  # of two groups; no multiples of 8 fibers


def crowd(
    precision: str = "float64", turn: float = 0.1, workers: int = 1, **tables: Any
) -> Simulation:
    """Bent fibers thrown into a box that is periodic along x; `turn`: rad between nodes."""
    rng = np.random.default_rng(11)
    fibers = []
    for segments, count in zip(SEGMENTS, COUNTS, strict=True):
        for _ in range(count):
            heading = rng.normal(size=3) + 0.3 * rng.normal(size=(segments, 3)).cumsum(0)
            heading[:, 2] *= 0.1
            heading *= STEP / np.linalg.norm(heading, axis=1)[:, None]
            nodes = np.concatenate([np.zeros((1, 3)), heading.cumsum(0)])
            nodes[:, 2] -= nodes[:, 2].mean()
            fibers.append(nodes + rng.random(3) * [0.06, 0.03, HEIGHT])
    group = np.repeat([0, 1], COUNTS)
    first = np.cumsum([0, *map(len, fibers)]).astype(np.int32)
    nodes = np.concatenate(fibers)
    low = RADIUS - 1e-4  # some nodes lie in the walls
    nodes[:, 1:] = np.clip(nodes[:, 1:], low, np.array([0.04, HEIGHT]) - low)
    group_keys = {"diameter": 2.0 * RADIUS, "density": 1340, "youngs_modulus": 7.5e5}
    rows = [
        {
            "count": count,
            "centerline_length": STEP * segments,
            "bond_damping": damping,
            "shape": {"kind": "s", "curvature": 10.0},
            **group_keys,
        }
        for segments, count, damping in zip(SEGMENTS, COUNTS, (0.0335, 0.1), strict=True)
    ]
    scene = scene_from_dict(
        {
            "box": {"size": [0.06, 0.04, HEIGHT], "boundary": ["periodic", "wall", "wall"]},
            "fibers": rows,
            "gravity": {},
            "contact": {"friction": 0.5, "wall_friction": 0.3, "damping": 0.113},
            "stage": [{"kind": "settle", "damping": 8.0, "end_time": 1.0}],
            "numerics": {
                "method": "bonded_spheres",
                "segments": list(SEGMENTS),
                "precision": precision,
                "device": "cpu",
            },
            **tables,
        }
    )
    placement = Placement(nodes, first, group.astype(np.int32))
    sim = Simulation(scene, placement=placement, workers=workers)
    units, kind, shape = sim.model.units, sim.model.precision.numpy, nodes.shape
    moved = nodes + 1e-5 * rng.normal(size=shape)
    sim.state.node_pos.assign((moved / units.length).astype(kind))
    velocity = 0.1 * rng.normal(size=shape) / units.velocity
    sim.state.node_velocity.assign(velocity.astype(kind))
    turns = exponential(turn * rng.normal(size=shape))
    sim.method.node_turn.assign(turns.astype(kind))  # type: ignore[attr-defined]
    spin = 20.0 * rng.normal(size=shape) * units.time
    sim.method.node_spin.assign(spin.astype(kind))  # type: ignore[attr-defined]
    return sim
