"""Places rigid fibers of a given shape: random turn and center, free of everything placed.

The way from end to end takes the direction drawn for the fiber (of a ring, a diameter); the turn
about it is random.

Source: random sequential addition, as in `insertion`: voxels reject most centers, cells find the
    neighbors of the rest. A fiber is free if each of its segments is.
Symbols: n segments per fiber.
Limits: moderate crowding; fibers are not pushed apart. A fiber may touch, not overlap, its own
    periodic image; if it does at every turn, its direction is drawn again. Report of overlaps: the
    closing segment of a ring is not in it.
"""

from __future__ import annotations

import math

import numpy as np

from warpfiber.placement.capsules import Capsules, Floats, near_pairs, stacked
from warpfiber.placement.groups import GroupFibers, asked_tensor, given_centers
from warpfiber.placement.insertion import Crowd
from warpfiber.placement.orientations import draw_directions, match_moments
from warpfiber.placement.shapes import feret_diameter, rest_nodes, segments_of
from warpfiber.placement.space import CLEARANCE, Cell, wall_distance
from warpfiber.scene import Fault, FiberGroup, Scene, SceneError

TRIES = 64
"""Centers tried at once for one fiber."""
ROUNDS = 1000
"""Times that a fiber gets another turn about its direction and new centers."""
REDRAWS = 20
"""Directions for a fiber that overlaps its own periodic image at every turn about the first."""


def insert_shaped(
    scene: Scene, cell: Cell, made: GroupFibers, held: list[Capsules], rng: np.random.Generator
) -> Capsules:
    """Fills `made.nodes` with the fibers of one group; the segments of them all.

    Raises SceneError: a shape that overlaps itself, does not fit, or cannot be packed.
    """
    group = scene.fibers[made.index]

    def error(key: str, value: object, remedy: str) -> SceneError:
        return SceneError([Fault(scene.path, f"fibers.{made.index}.{key}", value, remedy)])

    shape = _rest(scene, made.index)
    try:
        tensor = asked_tensor(group.orientation, group.direction)
    except ValueError as problem:
        raise error("orientation", group.orientation, str(problem)) from problem
    direction = draw_directions(tensor, group.count, rng, group.orientation_law)
    if group.orientation != "aligned":
        direction = match_moments(direction, tensor)
    made.tensor, made.segments = tensor, group.segments
    given = None if isinstance(group.position, str) else given_centers(scene, made.index, group)
    if given is None and cell.size is None:
        raise error("position", group.position, "needs a [box]; give centers")
    places = _Places(scene, cell, group, shape, held)
    for f in range(group.count):
        nodes = places.place(direction[f], None if given is None else given[f], rng)
        for _ in range(REDRAWS):
            if nodes is not None or not places.meets_image or group.orientation == "aligned":
                break
            again = draw_directions(tensor, 1, rng, group.orientation_law)[0]
            nodes = places.place(again, None if given is None else given[f], rng)
        if nodes is None:
            if given is not None:
                where = tuple(float(x) for x in given[f])
                raise error("position", where, f"fiber {f} overlaps or cuts a wall; move it")
            key = "count" if group.volume_fraction is None else "volume_fraction"
            remedy = f"only {f} of {group.count} fibers of this shape found a free place"
            raise error(key, getattr(group, key), f"{remedy}; ask for less, or enlarge box.size")
        made.nodes.append(nodes)
        made.tries += places.tries
    return places.segments(np.array(made.nodes))


def shape_feret(scene: Scene, index: int) -> float:
    """Largest distance of two centerline nodes (m) of the fibers of a group; raises SceneError."""
    return feret_diameter(_rest(scene, index))


def _rest(scene: Scene, index: int) -> Floats:
    """Nodes of the stress-free shape of a group; raises SceneError."""
    group = scene.fibers[index]
    try:
        return rest_nodes(group.shape, group.centerline_length, group.segments, group.diameter)
    except ValueError as problem:
        fault = Fault(scene.path, f"fibers.{index}.shape", group.shape.kind, str(problem))
        raise SceneError([fault]) from problem


class _Places:
    """Free places for fibers of one shape."""

    def __init__(
        self, scene: Scene, cell: Cell, group: FiberGroup, shape: Floats, held: list[Capsules]
    ) -> None:
        self.cell, self.shape, self.radius = cell, shape, group.radius
        self.closed = group.shape.kind == "ring"
        self.apart = scene.contact.law != "none"
        self.tries = 0
        self.meets_image = False
        self.crowd: Crowd | None = None
        self.inserted: list[Capsules] = list(held)
        if cell.size is not None:
            self.crowd = Crowd(cell, self.segments(shape[None]))
            for capsules in held:
                self.crowd.add(capsules)

    def segments(self, nodes: Floats) -> Capsules:
        """One capsule per segment of fibers (m, nodes, 3) m; owners are the fibers."""
        parts = [segments_of(chain, self.closed) for chain in nodes]
        center, direction, half = (np.concatenate(part) for part in zip(*parts, strict=True))
        owner = np.repeat(np.arange(len(nodes)), len(half) // len(nodes))
        return Capsules(center, direction, half, np.full(len(half), self.radius), owner)

    def place(
        self, direction: Floats, given: Floats | None, rng: np.random.Generator
    ) -> Floats | None:
        """Nodes (n, 3) m of a fiber that is free of the others, now one of them; or None."""
        self.tries, self.meets_image = 0, True
        for _ in range(ROUNDS):
            turned = self.shape @ _frame(direction, 2.0 * math.pi * rng.random())
            center = self._centers(turned, given, rng)
            found = self._free(turned, center)
            if found is not None:
                if self.apart and self.crowd is not None:
                    self.crowd.add(self.segments(found[None]))
                elif self.apart:
                    self.inserted.append(self.segments(found[None]))
                return found
        return None

    def _centers(self, turned: Floats, given: Floats | None, rng: np.random.Generator) -> Floats:
        """Centers (m) at which no node comes too near a wall; none if it does not fit."""
        size, wall = self.cell.size, self.cell.wall
        if size is None:
            assert given is not None
            return given[None]
        keep = np.where(wall, wall_distance(self.radius), 0.0)
        low = np.where(wall, keep - turned.min(axis=0), 0.0)
        high = np.where(wall, size - keep - turned.max(axis=0), size)
        if given is not None:
            inside = bool(np.all((given >= low) & (given <= high) | ~wall))
            if inside and self.cell.shaped:
                inside = bool(self.cell.holds((turned + given)[None], self.radius)[0])
            return given[None] if inside else np.zeros((0, 3))
        if np.any(low > high):
            return np.zeros((0, 3))
        around = self.cell.container
        if around is not None:  # the box around it
            half = np.array([around.radius, around.radius, 0.5 * around.height])
            low, high = (
                np.maximum(low, around.center - half),
                np.minimum(high, around.center + half),
            )
        center = np.asarray(low + (high - low) * rng.random((TRIES, 3)))
        if self.cell.shaped:
            center = center[self.cell.holds(turned + center[:, None], self.radius)]
        return center

    def _free(self, turned: Floats, center: Floats) -> Floats | None:
        """Nodes of the first of these places that is free."""
        self.tries += len(center)
        if not len(center):
            return None
        if not self.apart:
            return np.asarray(turned + center[0])
        none = np.zeros(3, dtype=bool)
        periodic = self.cell.periodic if self.cell.size is not None else none
        own = near_pairs(
            self.segments(turned[None]),
            2.0 * CLEARANCE * self.radius,
            self.cell.size,
            periodic,
        )
        if len(own.i):  # whatever the center, it overlaps its own image
            return None
        self.meets_image = False
        crowd = self.crowd
        if crowd is None:
            new = self.segments(turned[None] + center[:1, None])
            all_of_them = stacked([new, *self.inserted])
            pairs = near_pairs(all_of_them, 2.0 * CLEARANCE * self.radius, None, periodic)
            hit = np.any(np.minimum(pairs.i, pairs.j) < len(new))
            return None if hit else np.asarray(turned + center[0])
        new = self.segments(turned[None] + center[:, None])
        passed = np.zeros(len(new), dtype=bool)
        passed[crowd.voxels.passed(new.center, new.direction, new.half)] = True
        each = len(new) // len(center)
        left = np.flatnonzero(np.all(passed.reshape(-1, each), axis=1))
        for k in left:
            rows = np.arange(k * each, (k + 1) * each)
            if not len(crowd.overlaps(new.taken(rows))[0]):
                return np.asarray(turned + center[k])
        return None


def _frame(direction: Floats, turn: float) -> Floats:
    """Rows: the direction, and two more axes turned about it by `turn`, (3, 3)."""
    least = int(np.argmin(np.abs(direction)))
    side = np.eye(3)[least] - direction[least] * direction
    side /= np.linalg.norm(side)
    other = np.cross(direction, side)
    second = math.cos(turn) * side + math.sin(turn) * other
    return np.stack([direction, second, np.cross(direction, second)])
