"""Fibers of bonded spheres for tests: a Simulation of given rods, and its accelerations in SI."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.reference.bonded_spheres import Array, Rod
from warpfiber.placement import Placement
from warpfiber.scene import Scene, scene_from_dict
from warpfiber.simulation import Simulation


def rod_scene(rods: Sequence[Rod], *, quantities: Sequence[str] = (), **tables: Any) -> Scene:
    """Scene with one group per rod; `tables` override box (open), contact, stage, numerics, ..."""
    numerics = {
        "method": "bonded_spheres",
        "segments": [len(rod.first) for rod in rods],
        "bond_shear": rods[0].shear,
        "device": "cpu",
        **tables.pop("numerics", {}),
    }
    box = {"size": [1.0] * 3, "boundary": ["open"] * 3, "volume_rule": rods[0].caps}
    scene = {
        "box": box | tables.pop("box", {}),
        "fibers": [
            {
                "count": 1,
                "centerline_length": rod.length * len(rod.first),
                "diameter": 2.0 * rod.radius,
                "density": rod.density,
                "youngs_modulus": rod.modulus,
                "poisson_ratio": rod.poisson,
                "bond_damping": rod.damping,
                "position": [0.01, 0.01, 0.01],
                "orientation": "aligned",
                **({"shape": {"kind": "ring"}} if rod.closed else {}),
            }
            for rod in rods
        ],
        "contact": {"law": "none"},
        "stage": [{"kind": "settle", "end_time": 1.0}],
        "numerics": numerics,
        "record": {"quantities": list(quantities)},
        **tables,
    }
    return scene_from_dict(scene)


def start_rods(
    rods: Sequence[Rod],
    *,
    x: Array | None = None,
    v: Array | None = None,
    q: Array | None = None,
    w: Array | None = None,
    workers: int = 1,
    dt: float | None = None,
    **tables: Any,
) -> Simulation:
    """Simulation of the rods; x, v, q, w (all nodes, SI) replace rest in the stress-free shape."""
    scene = rod_scene(rods, **tables)
    first = np.cumsum([0] + [len(rod.rest) for rod in rods]).astype(np.int32)
    rest = np.concatenate([rod.rest for rod in rods])
    placement = Placement(rest, first, np.arange(len(rods), dtype=np.int32))
    sim = Simulation(scene, placement=placement, workers=workers, dt=dt)
    units, kind = sim.model.units, sim.model.precision.numpy
    if x is not None:
        sim.state.node_pos.assign((x / units.length).astype(kind))
    if v is not None:
        sim.state.node_velocity.assign((v / units.velocity).astype(kind))
    if q is not None:
        sim.method.node_turn.assign(q.astype(kind))  # type: ignore[attr-defined]
    if w is not None:
        sim.method.node_spin.assign((w * units.time).astype(kind))  # type: ignore[attr-defined]
    return sim


def rates(sim: Simulation) -> tuple[Array, Array]:
    """Accelerations (m/s^2) and angular accelerations (1/s^2) of all nodes."""
    sim.prepare()
    units, method = sim.model.units, sim.method
    linear = method.node_rate.numpy().astype(float)  # type: ignore[attr-defined]
    angular = method.node_spin_rate.numpy().astype(float)  # type: ignore[attr-defined]
    return linear * units.velocity / units.time, angular / units.time**2
