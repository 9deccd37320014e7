"""Nodes of bonded spheres that move as told: held and frozen ones always, others for a stage.

A clamp of a [[load]] holds one node and its orientation: that is its segment's at this end. Nodes
that a stage holds, in grips or before they are poured, keep their orientation too; they do so
whatever a load says.
Symbols: hold of a node as in `passes.bonds`, load = force on a free node, velocity of the others.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warpfiber.methods.loads import node_loads
from warpfiber.model import Model
from warpfiber.passes import held_nodes
from warpfiber.passes.bonds import CLAMPED, FREE, HELD
from warpfiber.scene import Scene

_CARRIED = ("hold", "load")


class NodeHolds:
    """Arrays `hold` and `load` of all nodes; empty where nothing is ever held or loaded."""

    def __init__(self, scene: Scene, model: Model, *, changing: bool) -> None:
        p, device = model.precision, model.device
        hold, load = _imposed(scene, model)
        if changing and not len(hold):
            hold, load = np.zeros(model.node_count, np.int32), np.zeros((model.node_count, 3))
        self.used = len(hold) > 0
        self._own = hold, load.astype(p.numpy)  # of loads and frozen groups
        self.hold = wp.array(hold, dtype=wp.int32, device=device)
        self.load = wp.array(self._own[1], dtype=p.vec3, device=device)

    def take(self, hold: np.ndarray, velocity: np.ndarray) -> None:
        """Hold the nodes that are not FREE in `hold` (N,) at `velocity` (N, 3; run units)."""
        mine, load = self._own[0].copy(), self._own[1].copy()
        taken = hold != FREE
        mine[taken], load[taken] = hold[taken], velocity[taken]
        self.hold.assign(mine)
        self.load.assign(load)

    def release(self) -> None:
        """Hold what loads and frozen groups hold, no more."""
        self.hold.assign(self._own[0])
        self.load.assign(self._own[1])

    def saved(self) -> dict[str, np.ndarray]:
        """The present holds."""
        return (
            {}
            if not self.used
            else {f"node_{name}": getattr(self, name).numpy().copy() for name in _CARRIED}
        )

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for name in _CARRIED if self.used else ():
            getattr(self, name).assign(arrays[f"node_{name}"])


def _imposed(scene: Scene, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """How every node is held, and its force, or its velocity where it is held."""
    imposed, load = node_loads(scene, model)
    hold = np.full(len(imposed), FREE, dtype=np.int32)
    hold[imposed == held_nodes.HELD] = HELD
    hold[imposed == held_nodes.FROZEN] = CLAMPED
    start, group = model.host["fiber_node_start"], model.host["fiber_group"]
    for row in scene.loads:
        if row.hold == "clamp" and not scene.fibers[row.group].frozen:
            fiber = np.flatnonzero(group == row.group)[row.fiber]
            nodes = np.arange(start[fiber], start[fiber + 1])
            clamped = nodes[row.node]
            other = clamped + 1 if clamped < nodes[-1] else clamped - 1
            hold[clamped], hold[other], load[other] = CLAMPED, FREE, 0.0
    return hold, load
