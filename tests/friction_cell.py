"""Two crossed rods that are pressed together and dragged apart, and what each then does.

Units a = eta = 1, fluid at rest unless told otherwise. Rod 0 lies along x, rod 1 along y on top of
it; both carry a load N against the other, rod 1 a drag T along x.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.cell import Kind, straight_fiber
from tests.meeting_cell import contact_rows
from tests.reference.bead_chain import Array
from warpfiber.methods.overdamped import Overdamped
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
BEADS = 12
HALF = BEADS - 1.0
DRAG = 6.0 * math.pi * BEADS  # xi of a rod
TURNING = 2.0 * math.pi * BEADS * (BEADS * BEADS + 3.0)  # K_r
ROLLING = 8.0 * math.pi * BEADS  # of a rod about its axis


def crossed(
    start: Start,
    friction: float,
    press: float,
    drag: Array,
    *,
    method: str = "rigid_rod",
    dt: float = 0.01,
    segments: int = 1,
    gap: float = 0.0,
    **tables: Any,
) -> Simulation:
    """The rods; `drag` (3,) the other load on rod 1, shared by its ends."""
    kind = Kind(segments, (BEADS - 1.0) / segments, modulus=1e9)
    lower = straight_fiber(kind, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    upper = straight_fiber(kind, (0.0, 1.0, 0.0), (0.0, 0.0, 2.0 + gap))
    pushed = np.array([0.0, 0.0, press])
    rows = [
        {"fiber": fiber, "node": node, "force": (0.5 * force).tolist()}
        for fiber, force in ((0, pushed), (1, np.asarray(drag, float) - pushed))
        for node in (0, -1)
    ]
    numerics = {"method": method, "dt": dt, "contact_tolerance": 1e-9, **tables.pop("numerics", {})}
    contact = {"law": "exponential", "friction": friction, **tables.pop("contact", {})}
    return start([kind], [lower, upper], numerics=numerics, contact=contact, load=rows, **tables)


def by(sim: Simulation, solver: str) -> Simulation:
    """The same, its rows solved one after the other (`relaxed`) or by passes over all."""
    for _, dual in sim.method.contact.solves:  # type: ignore[attr-defined]
        dual.relaxes = solver == "relaxed"
        if not dual.relaxes and dual.node_push.shape[0] > 0:
            dual.node_push = dual.node_push[:0]
    if solver != "relaxed" and isinstance(sim.method, Overdamped):
        sim.method.axes_stride = 0  # passes over all read the factors of chains
    return sim


def loads(sim: Simulation) -> tuple[Array, Array, Array]:
    """Normal forces (R,) and tangential ones (R, 3) of the last step; their normals."""
    rows = contact_rows(sim)
    count = int(rows.row_count.numpy()[0])
    force, normal = rows.row_force.numpy()[:count], rows.row_normal.numpy()[:count]
    flat = rows.rub.force.numpy()[:count] if rows.rub is not None else np.zeros_like(normal)
    return force.astype(float), flat.astype(float), normal.astype(float)


def middles(sim: Simulation) -> Array:
    """(F, 3) middle of the ends of every fiber."""
    begin, nodes = sim.fiber_node_start, sim.node_pos
    return np.asarray(0.5 * (nodes[begin[:-1]] + nodes[begin[1:] - 1]))
