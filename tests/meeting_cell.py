"""Dense sheared cells of fibers that meet, and one of their steps by the restatements.

Units: a = eta = rate = 1, so that the run's units are SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tests.cell import Kind, cell_scene
from tests.reference.bead_chain import Array
from tests.reference.rigid_rod import Rods, make_rods
from warpfiber.passes.contact_rows import ContactRows
from warpfiber.simulation import Simulation

SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
EDGES = (26.0, 24.0, 25.0)
BOX = {"size": list(EDGES)}
LAYER = {"size": list(EDGES), "boundary": ["periodic", "periodic", "wall"]}
HARD = {"law": "exponential"}  # the law is not used where contacts are unilateral
RODS = (Kind(1, 9.0),)
CHAINS = (Kind(3, 3.0, modulus=3e3),)
METHODS = {"rigid_rod": RODS, "overdamped": CHAINS}


def meeting_scene(
    method: str,
    count: int = 40,
    *,
    kinds: Sequence[Kind] | None = None,
    which: Sequence[int] | None = None,
    **tables: Any,
) -> Any:
    """Scene of `count` fibers at random in a sheared cell; numerics and tables as given."""
    kinds = METHODS[method] if kinds is None else kinds
    numerics = {"method": method, "dt": 0.05, **tables.pop("numerics", {})}
    numerics = {key: value for key, value in numerics.items() if value is not None}
    tables = {"box": BOX, "flow": SHEAR, "contact": HARD, **tables}
    return cell_scene(kinds, [0] * count if which is None else which, numerics=numerics, **tables)


@dataclass
class Meeting:
    """Makes cells and closes them."""

    running: list[Simulation]

    def __call__(self, method: str, count: int = 40, **tables: Any) -> Simulation:
        workers = tables.pop("workers", 1)
        placement = tables.pop("placement", None)
        scene = meeting_scene(method, count, **tables)
        sim = Simulation(scene, workers=workers, placement=placement)
        self.running.append(sim)
        return sim


def contact_rows(sim: Simulation, solve: int = 0) -> ContactRows:
    """The rows of the last step."""
    rows: ContactRows = sim.method.contact.solves[solve][0]  # type: ignore[attr-defined]
    return rows


def last_rows(sim: Simulation, solve: int = 0) -> dict[str, Array]:
    """Row arrays of the last step, cut to the rows that there are."""
    rows = contact_rows(sim, solve)
    count = int(rows.row_count.numpy()[0])
    names = "i j s t normal base compliance force".split()
    return {name: getattr(rows, f"row_{name}").numpy()[:count].copy() for name in names}


def rejected(sim: Simulation) -> int:
    """Steps that were taken back so far."""
    return int(sim.method.step_report()["rejected_steps"])


class Snapshot(NamedTuple):
    """Nodes inside the box, the images they stand in, lattice at that time."""

    nodes: Array
    image: Array
    lattice: Array


def snapshot(sim: Simulation) -> Snapshot:
    """The state now, run units."""
    state = sim.state
    image = np.repeat(state.fiber_image.numpy().astype(float), np.diff(sim.fiber_node_start), 0)
    return Snapshot(state.node_pos.numpy().astype(float), image, state.lattice.numpy()[0].copy())


def followed(sim: Simulation, before: Snapshot) -> Array:
    """The nodes now, in the images that they had before."""
    now = snapshot(sim)
    moved: Array = now.nodes + (now.image - before.image) @ now.lattice.T
    return moved


def rods_at(nodes: Array, beads: object) -> Rods:
    """Rods of two nodes each, for the reference."""
    ends = nodes.reshape(-1, 2, 3)
    return make_rods(ends.mean(axis=1), ends[:, 1] - ends[:, 0], beads)


def rod_nodes(center: Array, axis: Array, half: Array) -> Array:
    """Nodes (2F, 3)."""
    lever = half[:, None] * axis
    nodes: Array = np.stack([center - lever, center + lever], axis=1).reshape(-1, 3)
    return nodes
