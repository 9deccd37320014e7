"""Places all fibers of a scene: straight ones from statistics, others from a file, without overlap.

Order: node files, then given centers, then random centers, longest fibers first. Random fibers are
inserted at free centers, each with its own direction. When most find none, a batch of fibers goes
in where they overlap least, all fibers are relaxed by small translations and rotations, and
insertion goes on.

Symbols: A orientation tensor, h half centerline length (m), a radius (m).
Limits: a direction that does not fit between the walls, or that makes a fiber hit its own image, is
    drawn again: A loses directions across the gap; `report` has the tensor achieved.
    Centers are uniform in what the walls leave; ends may stick out of open faces. With contact law
    `none` fibers do not see each other: what cannot be packed then overlaps.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.capsules import (
    Capsules,
    Floats,
    Ints,
    chain_capsules,
    near_pairs,
    stacked,
)
from warpfiber.placement.capsules import pair_gap as gaps_of
from warpfiber.placement.groups import GroupFibers, group_fibers
from warpfiber.placement.insertion import Crowd
from warpfiber.placement.orientations import orientation_tensor, values_from_tensor
from warpfiber.placement.parts import split_tables
from warpfiber.placement.populations import pack, population_report, populations
from warpfiber.placement.relaxation import Freedom, relax
from warpfiber.placement.shaped import insert_shaped
from warpfiber.placement.shapes import straight_nodes
from warpfiber.placement.space import Cell, Container, Inserted
from warpfiber.scene import Fault, Scene, SceneError
from warpfiber.scene.containers import container
from warpfiber.scene.planes import free_planes

BATCH = 0.2
"""Part of all random fibers that goes in overlapping between two relaxations."""
LAST_BATCH = 0.02
"""The same where larger batches jam; if this one jams too, the cell is full."""
FEWEST = 4
"""Smallest batch, fibers."""
SWEEPS = 6000
"""Most sweeps of one relaxation."""
DIRECTION_DRAWS = 500
"""Directions tried for a fiber with a given center that another one is in the way of."""
SORTED_FROM = 10_000
"""Segments of a group from which on neighbors get neighboring numbers: a cache then holds them, and
of two workers, each with a run of numbers, one rarely needs what the other wrote."""
FILE_OVERLAP = 0.2
"""Deepest overlap accepted in a node file (radii); a penalty of decay 50 is then 150 D_0."""


@dataclass(frozen=True)
class Placement:
    """Fibers at the start, all groups one after the other."""

    node_pos: Floats
    """m, (N, 3)"""
    fiber_node_start: NDArray[np.int32]
    """first node of each fiber, and N, (F + 1,)"""
    fiber_group: NDArray[np.int32]
    """(F,)"""
    report: dict[str, Any] = field(default_factory=dict)
    """orientation tensors, tries, relaxations, seconds; JSON-ready"""
    starts_bent: bool | None = None
    """whether the run began with bent fibers; None: as `node_pos` says"""


def place_fibers(scene: Scene, rng: np.random.Generator | None = None) -> Placement:
    """Fibers of a scene, always the same for one seed.

    Capsules keep 2a (1 + 1e-3) between axes, periodic images included, and a (1 + 1e-3) from walls.
    Raises SceneError: what cannot be packed, does not fit, or cannot be read.
    """
    began = time.perf_counter()
    rng = np.random.default_rng(scene.seed) if rng is None else rng
    scene = split_tables(scene)
    cell = scene_cell(scene)
    groups = group_fibers(scene, cell, rng)
    packing = _Packing(scene, cell, groups, rng)
    packing.insert_files()
    packing.insert_given()
    packing.insert_shaped()
    packing.insert_random()
    packing.insert_populations()
    return packing.placement(began)


def scene_cell(scene: Scene) -> Cell:
    """Size and kinds of boundary of the scene's box."""
    if scene.box is None:
        return Cell(None, np.zeros(3, dtype=bool), np.zeros(3, dtype=bool))
    kinds = np.array(scene.box.boundary)
    size, found = np.array(scene.box.size, dtype=np.float64), container(scene)
    around = None
    if found is not None:
        assert found.radius is not None and found.height is not None
        around = Container(np.asarray(found.center), found.radius, found.height)
    planes = tuple((np.asarray(p.normal), np.asarray(p.position)) for p in free_planes(scene))
    return Cell(size, kinds == "periodic", kinds == "wall", around, planes)


def overlap_of(
    node_pos: Floats, fiber_node_start: NDArray[np.integer[Any]], fiber_radius: Floats, cell: Cell
) -> dict[str, float]:
    """Overlaps of fibers: `pairs` that touch, `maximum` and `mean` depth in radii.

    node_pos (N, 3) m, fiber_node_start (F + 1,), fiber_radius (F,) m. A pair is two segments of two
    fibers, or of one fiber and its image; bends of one fiber onto itself do not count.
    """
    capsules = chain_capsules(node_pos, fiber_node_start, fiber_radius)
    pairs = near_pairs(capsules, 0.0, cell.size, cell.periodic)
    if not len(pairs.i):
        return {"pairs": 0, "maximum": 0.0, "mean": 0.0}
    mean_radius = 0.5 * (capsules.radius[pairs.i] + capsules.radius[pairs.j])
    depth = -gaps_of(capsules, pairs, cell.size) / mean_radius
    return {"pairs": len(depth), "maximum": float(depth.max()), "mean": float(depth.mean())}


class _Packing:
    """Fibers of one scene while they are placed."""

    def __init__(
        self, scene: Scene, cell: Cell, groups: list[GroupFibers], rng: np.random.Generator
    ) -> None:
        self.scene, self.cell, self.groups, self.rng = scene, cell, groups, rng
        self.apart = scene.contact.law != "none"
        self.sweeps = self.relaxations = self.squeezed = 0
        halves = [float(g.half) for g in groups if len(g.direction)]
        self.longest = max(halves, default=0.0)
        self.widest = max((g.radius for g in groups), default=0.0)
        self.held: list[Capsules] = []
        self.tables: list[dict[str, Any]] = []
        self.placed = Inserted(cell, self.longest, self.widest)

    def _fault(self, group: int, key: str, value: object, remedy: str) -> SceneError:
        return SceneError([Fault(self.scene.path, f"fibers.{group}.{key}", value, remedy)])

    def _hold(self, capsules: Capsules) -> None:
        self.held.append(capsules)
        for k in range(len(capsules)):
            self.placed.add(
                capsules.center[k],
                capsules.direction[k],
                float(capsules.half[k]),
                float(capsules.radius[k]),
            )

    def insert_files(self) -> None:
        """Fibers of node files, as they are; a deep overlap between them is a fault."""
        for g in self.groups:
            if not g.nodes:
                continue
            start = np.cumsum([0] + [len(n) for n in g.nodes])
            self._hold(
                chain_capsules(np.concatenate(g.nodes), start, np.full(len(g.nodes), g.radius))
            )
        if not self.held or not self.apart:
            return
        last = max(g.index for g in self.groups if g.nodes)
        capsules = stacked(self.held)
        pairs = near_pairs(capsules, 0.0, self.cell.size, self.cell.periodic)
        if not len(pairs.i):
            return
        depth = float(-gaps_of(capsules, pairs, self.cell.size).min()) / self.widest
        if depth > FILE_OVERLAP:
            raise self._fault(
                last,
                "node_file",
                self.scene.fibers[last].node_file,
                f"its fibers overlap by up to {depth:.3g} radii (at most {FILE_OVERLAP}); "
                'move them apart, or contact.law = "none"',
            )

    def insert_given(self) -> None:
        """Fibers with given centers; a direction in the way of another fiber is drawn again."""
        for g in self.groups:
            if g.given is None or self.cell.shaped:
                continue
            for f in range(len(g.direction)):
                draws = 0
                while self.apart:
                    if not self.placed.hit(g.given[f], g.direction[f], g.half, g.radius):
                        break
                    draws += 1
                    fresh = None if draws > DIRECTION_DRAWS else g.redraw(f, self.rng)
                    if fresh is None:
                        raise self._fault(
                            g.index,
                            "position",
                            tuple(float(x) for x in g.given[f]),
                            f"fiber {f} would overlap another one there; move it, "
                            'or contact.law = "none"',
                        )
                    g.direction[f] = fresh
                self.placed.add(g.given[f], g.direction[f], g.half, g.radius)
            g.center = g.given.copy()
            self.held.append(g.capsules())

    def insert_shaped(self) -> None:
        """Fibers that are not straight, or within more than a box, as rigid bodies."""
        for g in self.groups:
            straight = self.scene.fibers[g.index].shape.kind == "straight"
            if not g.nodes and (not straight or self.cell.shaped):
                self.held.append(insert_shaped(self.scene, self.cell, g, self.held, self.rng))

    def insert_random(self) -> None:
        """Fibers with random centers, longest first; from the first stall on in batches."""
        random = [g for g in self.groups if g.given is None and not g.nodes and len(g.direction)]
        random.sort(key=lambda g: -g.half)
        if not random:
            return
        loose = stacked([g.capsules() for g in random])
        group = np.repeat(np.arange(len(random)), [len(g.direction) for g in random])
        n = len(loose)
        freedom = Freedom(np.ones(n), np.array([g.turning for g in random])[group])
        crowd = Crowd(self.cell, loose)
        placed = np.zeros(n, dtype=bool)
        tries = np.zeros(n, dtype=np.int64)
        batch, fewest = max(FEWEST, int(BATCH * n)), max(FEWEST, int(LAST_BATCH * n))
        jammed = False
        self._fill(crowd, placed)
        while not np.all(placed):
            if not jammed:
                placed[crowd.insert(np.flatnonzero(~placed), tries, self.rng)] = True
            more = np.flatnonzero(~placed)[:batch]
            crowd.squeeze(more, self.rng)
            if len(more) and self.apart:
                jammed = not self._relax(loose, freedom, np.append(np.flatnonzero(placed), more))
            if jammed and batch <= fewest:
                first = random[group[more[0]]].index
                raise self._jammed(first, int(np.sum(placed)), n)
            if jammed:
                batch = max(fewest, batch // 3)
            else:
                placed[more] = True
                self.squeezed += len(more)
            if self.apart and not np.all(placed):
                self._fill(crowd, placed)
        for k, g in enumerate(random):
            mine = group == k
            g.center, g.direction = loose.center[mine], loose.direction[mine]
            g.tries += int(tries[mine].sum())

    def insert_populations(self) -> None:
        """Fibers of many lengths or in layers, all at once, bent where they are in the way."""
        crowd = populations(self.scene, self.cell, self.rng)
        if not crowd:
            return
        placed = [g.capsules() for g in self.groups if len(g.center) and g.given is None]
        outcome, strains = pack(self.scene, self.cell, crowd, [*self.held, *placed])
        self.sweeps += outcome.sweeps
        self.relaxations += 1
        for population in crowd:
            for chain, index in zip(population.chains, population.member, strict=True):
                self.groups[index].nodes.append(chain)
            self.tables.append(population_report(self.scene, population, strains))

    def _fill(self, crowd: Crowd, placed: NDArray[np.bool_]) -> None:
        """Lists what is placed from the beginning."""
        crowd.clear()
        for capsules in [*self.held, crowd.loose.taken(np.flatnonzero(placed))]:
            crowd.add(capsules)

    def _relax(self, loose: Capsules, freedom: Freedom, which: Ints) -> bool:
        """Parts overlapping fibers; False, and nothing moved, if they jam."""
        capsules = stacked([loose.taken(which), *self.held])
        n, more = len(which), len(capsules) - len(which)
        free = Freedom(
            np.append(freedom.translation[which], np.zeros(more)),
            np.concatenate([freedom.rotation[which], np.zeros((more, 3, 3))]),
        )
        clear, sweeps = relax(capsules, self.cell, free, SWEEPS)
        self.sweeps += sweeps
        self.relaxations += 1
        if clear:
            center, size = capsules.center[:n], self.cell.size
            if size is not None:
                center -= np.where(self.cell.periodic, np.floor(center / size) * size, 0.0)
            loose.center[which] = center
            loose.direction[which] = capsules.direction[:n]
        return clear

    def _jammed(self, index: int, placed: int, asked: int) -> SceneError:
        """The fault that says how many fibers could be packed."""
        group = self.scene.fibers[index]
        reached = f"only about {placed} of {asked} fibers could be placed without overlap"
        remedy = "ask for less, or for shorter or more aligned fibers"
        if group.volume_fraction is None:
            return self._fault(index, "count", group.count, f"{reached}; {remedy}")
        shares = [g.volume_fraction_achieved or 0.0 for g in self.scene.fibers]
        fraction = f"volume fraction {placed / asked * sum(shares):.3g} was reached"
        return self._fault(
            index, "volume_fraction", group.volume_fraction, f"{reached}, {fraction}; {remedy}"
        )

    def placement(self, began: float) -> Placement:
        """Nodes of all groups in the order of the scene, and the report."""
        nodes: list[Floats] = []
        counts: list[int] = []
        owner: list[int] = []
        for g in self.groups:
            if g.given is None and len(g.center) * g.segments >= SORTED_FROM:
                order = space_order(g.center, 0.5 * g.half)
                g.center, g.direction = g.center[order], g.direction[order]
            chains = g.nodes or list(
                straight_nodes(g.center, g.direction, 2.0 * g.half, g.segments)
            )
            nodes += chains
            counts += [len(chain) for chain in chains]
            owner += [g.index] * len(chains)
        node_pos = np.concatenate(nodes) if nodes else np.zeros((0, 3))
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        radius = np.array([self.groups[g].radius for g in owner])
        # Fibers that do not see each other may all lie on one point: counting pairs would not end.
        overlap = overlap_of(node_pos, start, radius, self.cell) if self.apart and owner else None
        report = {
            "groups": [
                _group_report(g) for g in self.groups if self.scene.fibers[g.index].table is None
            ],
            "tables": self.tables,
            "overlap": overlap,
            "inserted_overlapping": self.squeezed,
            "relaxations": self.relaxations,
            "relaxation_sweeps": self.sweeps,
            "seconds": round(time.perf_counter() - began, 3),
        }
        return Placement(node_pos, start, np.array(owner, dtype=np.int32), report)


def space_order(center: Floats, width: float) -> Ints:
    """Order of points (n, 3) m along a Z-order curve through cells of about this width (m), (n,).

    Cells are the box of the points, halved again and again along its longest edges: the first half
    of the points lies beside the second one.
    """
    extent = np.ptp(center, axis=0)
    halvings = np.ceil(np.log2(np.maximum(extent / width, 1.0))).astype(np.int64)
    cells = 2**halvings
    place = (center - center.min(axis=0)) / np.where(extent > 0.0, extent, 1.0)
    cell = np.minimum((place * cells).astype(np.int64), cells - 1)
    key = np.zeros(len(center), dtype=np.int64)
    for bit in reversed(range(int(halvings.max()))):
        for axis in np.flatnonzero(halvings > bit)[::-1]:
            key = 2 * key + (cell[:, axis] >> bit & 1)
    return np.argsort(key, kind="stable")


def _group_report(g: GroupFibers) -> dict[str, Any]:
    if g.nodes:
        step = np.concatenate([np.diff(chain, axis=0) for chain in g.nodes])
        directions = step / np.linalg.norm(step, axis=1)[:, None]
    else:
        directions = g.direction
    return {
        "count": len(g.nodes) or len(g.direction),
        "orientation_asked": None if g.tensor is None else values_from_tensor(g.tensor),
        "orientation_drawn": None if g.drawn is None else values_from_tensor(g.drawn),
        "orientation_achieved": values_from_tensor(orientation_tensor(directions)),
        "directions_redrawn": g.redrawn,
        "tries": g.tries,
    }
