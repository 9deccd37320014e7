"""Small cells given fiber by fiber: scene tables, a Simulation of them, the same for the reference.

Units: a = eta = 1 (diameter 2 m, viscosity 1 Pa s); a rate of 1/s makes the run's units SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.reference.bead_chain import Array, Chain
from warpfiber.placement import Placement
from warpfiber.scene import Scene, scene_from_dict
from warpfiber.simulation import Simulation

BOX_IMAGES = 1 << 9  # image numbers are stored with this offset, ten bits per axis


@dataclass(frozen=True)
class Kind:
    """One group of fibers: `segments` of `spacing` diameters each."""

    segments: int
    spacing: float = 1.0
    radius: float = 1.0
    density: float = 0.1
    modulus: float = 100.0

    @property
    def aspect_ratio(self) -> float:
        """r_f."""
        return self.segments * self.spacing + 1.0

    def table(self, count: int, **keys: Any) -> dict[str, Any]:
        """The [[fibers]] table."""
        return {
            "count": count,
            "aspect_ratio": self.aspect_ratio,
            "diameter": 2.0 * self.radius,
            "density": self.density,
            "youngs_modulus": self.modulus,
            **keys,
        }

    def chain(self, closure: str = "consistent", **keys: Any) -> Chain:
        """Constants of one fiber for the reference."""
        return Chain(
            self.segments,
            self.spacing,
            radius=self.radius,
            density=self.density,
            modulus=self.modulus,
            closure=closure,
            **keys,
        )


def cell_scene(
    kinds: Sequence[Kind],
    fiber_kind: Sequence[int],
    *,
    numerics: dict[str, Any] | None = None,
    quantities: Sequence[str] = (),
    groups: dict[str, Any] | None = None,
    **tables: Any,
) -> Scene:
    """Scene with the given groups; `tables` override flow (at rest), contact (none), box, ...

    `groups`: further keys of every [[fibers]].
    """
    counts = np.bincount(np.asarray(fiber_kind), minlength=len(kinds))
    rows = []
    for kind, count in zip(kinds, counts, strict=True):
        keys: dict[str, Any] = dict(groups or {})
        if "box" not in tables:
            keys["position"] = [[0.0, 0.0, 0.0]] * int(count)
        rows.append(kind.table(int(count), **keys))
    scene = {
        "flow": {"kind": "rest", "viscosity": 1.0},
        "fibers": rows,
        "contact": {"law": "none"},
        "stage": [{"kind": "flow", "end_time": 1.0}],
        "numerics": {
            "method": "bead_chain",
            "segments": [kind.segments for kind in kinds],
            "device": "cpu",
            **(numerics or {}),
        },
        **tables,
    }
    if quantities:
        scene["record"] = {"quantities": list(quantities)}
    return scene_from_dict(scene)


def place(fibers: Sequence[Array], fiber_kind: Sequence[int]) -> Placement:
    """Placement of fibers given by their nodes."""
    start = np.cumsum([0] + [len(nodes) for nodes in fibers])
    return Placement(
        np.concatenate(fibers).astype(float),
        start.astype(np.int32),
        np.asarray(fiber_kind, dtype=np.int32),
    )


def start_cell(
    kinds: Sequence[Kind],
    fibers: Sequence[Array],
    fiber_kind: Sequence[int] | None = None,
    *,
    velocity: Array | None = None,
    workers: int = 1,
    **tables: Any,
) -> Simulation:
    """Simulation that starts with exactly these nodes and node velocities (default: the flow's)."""
    which = [0] * len(fibers) if fiber_kind is None else fiber_kind
    scene = cell_scene(kinds, which, **tables)
    sim = Simulation(scene, placement=place(fibers, which), workers=workers)
    if velocity is not None:
        values = np.asarray(velocity) / sim.model.units.velocity
        sim.state.node_velocity.assign(values.astype(sim.model.precision.numpy))
    return sim


def bent_fiber(
    kind: Kind,
    rng: np.random.Generator,
    center: Sequence[float] = (0.0, 0.0, 0.0),
    spread: float = 0.4,
    stretch: float = 0.02,
) -> Array:
    """Random walk of slightly stretched segments, its mean at `center`; (n, 3)."""
    heading = rng.normal(size=3) / spread + rng.normal(size=(kind.segments, 3)).cumsum(0)
    heading /= np.linalg.norm(heading, axis=1)[:, None]
    length = 2.0 * kind.radius * kind.spacing * (1.0 + stretch * rng.normal(size=kind.segments))
    nodes = np.concatenate([np.zeros((1, 3)), (length[:, None] * heading).cumsum(0)])
    return nodes - nodes.mean(axis=0) + np.asarray(center)


def fiber_between(
    kind: Kind, rng: np.random.Generator, low: Sequence[float], high: Sequence[float]
) -> Array:
    """Bent fiber with its mean between `low` and `high`, and all of it between them along z."""
    while True:
        nodes = bent_fiber(kind, rng, np.asarray(low) + np.subtract(high, low) * rng.random(3))
        if nodes[:, 2].min() > low[2] and nodes[:, 2].max() < high[2]:
            return nodes


def straight_fiber(kind: Kind, direction: Sequence[float], center: Sequence[float]) -> Array:
    """Unloaded straight fiber; (n, 3)."""
    axis = np.asarray(direction, float) / np.linalg.norm(direction)
    along = (np.arange(kind.segments + 1) - kind.segments / 2.0) * 2.0 * kind.radius * kind.spacing
    return np.asarray(center, float) + along[:, None] * axis


def isotropic(rng: np.random.Generator, count: int) -> Array:
    """Random directions (count, 3)."""
    axis = rng.normal(size=(count, 3))
    return axis / np.linalg.norm(axis, axis=1)[:, None]


def listed_pairs(sim: Simulation) -> set[tuple[int, int, tuple[int, int, int]]]:
    """(i, j, image of j) of the neighbor list, i <= j; of i = j the image that sorts last."""
    pairs = sim.method.list
    assert pairs is not None
    found = []
    for i, j, code in zip(*pairs.host_pairs(), strict=True):
        bits = [(int(code) >> shift) % (2 * BOX_IMAGES) - BOX_IMAGES for shift in (0, 10, 20)]
        image = (bits[0], bits[1], bits[2])
        if i == j and image < (0, 0, 0):
            image = (-bits[0], -bits[1], -bits[2])
        found.append((int(i), int(j), image))
    assert len(found) == len(set(found)), "a pair is listed twice"
    return set(found)
