"""Forces on nodes and prescribed motions, from the [[load]] tables and frozen groups of a scene.

`hold` says of every node whether it is free, held or of a frozen fiber (passes/held_nodes.py);
`load` is the force on a free node and the velocity of the others. A clamp holds both nodes of the
segment that begins at its node, of the last node the segment that ends there.
"""

from __future__ import annotations

import numpy as np

from warpfiber.model import Model
from warpfiber.passes.held_nodes import FREE, FROZEN, HELD
from warpfiber.scene import Fault, Scene, SceneError


def node_loads(scene: Scene, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """(N,) hold and (N, 3) force or velocity in run units; empty if nothing is imposed.

    Raises SceneError if a fiber or node of a load does not exist.
    """
    frozen = [group.frozen for group in scene.fibers]
    if not scene.loads and not any(frozen):
        return np.zeros(0, dtype=np.uint8), np.zeros((0, 3))
    start, group_of = model.host["fiber_node_start"], model.host["fiber_group"]
    node_group = np.repeat(group_of, np.diff(start))
    hold = np.where(np.asarray(frozen)[node_group], FROZEN, FREE).astype(np.uint8)
    load = np.zeros((model.node_count, 3))
    faults: list[Fault] = []
    for number, row in enumerate(scene.loads):
        velocity = np.asarray(row.velocity or (0.0, 0.0, 0.0)) / model.units.velocity
        if frozen[row.group]:
            load[node_group == row.group] = velocity
            continue
        fibers = np.flatnonzero(group_of == row.group)
        nodes = int(np.diff(start)[fibers[0]])
        for key, index, count in (("fiber", row.fiber, len(fibers)), ("node", row.node, nodes)):
            if not -count <= index < count:
                remedy = f"the group has {count} per {'group' if key == 'fiber' else 'fiber'}"
                faults.append(Fault(scene.path, f"load.{number}.{key}", index, remedy))
        if faults:
            continue
        first = int(start[fibers[row.fiber]])
        node = row.node % nodes
        if row.hold == "free":
            load[first + node] = np.asarray(row.force) / model.units.force
            continue
        begin = first + (min(node, nodes - 2) if row.hold == "clamp" else node)
        end = begin + (2 if row.hold == "clamp" else 1)
        hold[begin:end] = HELD
        load[begin:end] = velocity
    if faults:
        raise SceneError(faults)
    return hold, load
