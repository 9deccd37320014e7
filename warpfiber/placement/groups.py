"""Fiber groups before they are packed: directions, given centers, nodes from files.

Limits: directions that do not fit between the walls at any (or at the given) center, or that make a
    fiber hit its own periodic image, are drawn again. The tensor asked for is aimed at again after
    that; across a narrow gap it stays out of reach, and A loses what points across.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from warpfiber.placement.capsules import Capsules, Floats, Ints
from warpfiber.placement.node_file import read_node_file
from warpfiber.placement.orientations import (
    FLAT,
    draw_directions,
    match_moments,
    orientation_tensor,
    tensor_from_values,
)
from warpfiber.placement.space import Cell, own_image_hit, wall_distance
from warpfiber.scene import Fault, FiberGroup, Scene, SceneError

ROUNDS = 1000
"""Times that directions which do not fit are drawn again."""
MATCHES = 10
"""Times that the tensor asked for is aimed at after directions were drawn again."""


@dataclass
class GroupFibers:
    """Fibers of one group while they are placed."""

    index: int
    cell: Cell
    radius: float
    """m"""
    half: float = 0.0
    """half the centerline, m"""
    segments: int = 0
    tensor: Floats | None = None
    """orientation tensor asked for, (3, 3); None: nodes from a file"""
    law: str = "acg"
    """distribution of directions"""
    drawn: Floats | None = None
    """orientation tensor of the directions before packing, (3, 3)"""
    direction: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3)"""
    center: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """m, (n, 3)"""
    given: Floats | None = None
    """centers that the scene gives, m, (n, 3)"""
    nodes: list[Floats] = field(default_factory=list)
    """nodes of each fiber of a node file, m, (n_f, 3)"""
    turning: Floats = field(default_factory=lambda: np.eye(3))
    """projector on the changes of direction that keep the kind of orientation, (3, 3)"""
    apart: bool = True
    """whether fibers must not overlap"""
    redrawn: int = 0
    tries: int = 0

    def capsules(self) -> Capsules:
        """One capsule per straight fiber."""
        n = len(self.direction)
        half, radius = np.full(n, self.half), np.full(n, self.radius)
        return Capsules(self.center, self.direction, half, radius, np.arange(n))

    def misfits(self, direction: Floats, center: Floats | None) -> Ints:
        """Rows of directions (n, 3) that fit at no center, or not at the given ones (n, 3) m."""
        n = len(direction)
        hit = np.zeros(n, dtype=bool)
        if self.apart:
            half, radius = np.full(n, self.half), np.full(n, self.radius)
            hit = own_image_hit(direction, half, radius, self.cell)
        if self.cell.size is not None:
            reach = self.half * np.abs(direction) + wall_distance(self.radius)
            size = self.cell.size
            low = 0.5 * size if center is None else np.minimum(center, size - center)
            hit |= np.any((reach > low) & self.cell.wall, axis=1)
        return np.flatnonzero(hit).astype(np.int64)

    def redraw(self, f: int, rng: np.random.Generator) -> Floats | None:
        """Another direction (3,) for fiber f that fits; None if all its directions are alike."""
        assert self.tensor is not None
        if not np.any(self.turning):
            return None
        center = None if self.given is None else self.given[f][None, :]
        for _ in range(ROUNDS):
            fresh = draw_directions(self.tensor, 1, rng, self.law)
            if not len(self.misfits(fresh, center)):
                self.redrawn += 1
                return np.asarray(fresh[0])
        return None


def group_fibers(scene: Scene, cell: Cell, rng: np.random.Generator) -> list[GroupFibers]:
    """Directions, given centers and node files of all groups; SceneError has the faults of all."""
    groups: list[GroupFibers] = []
    faults: list[Fault] = []
    for index, group in enumerate(scene.fibers):
        # fibers of many lengths are drawn together, shaped ones one after the other
        if group.table is not None or group.shape.kind != "straight":
            groups.append(GroupFibers(index, cell, group.radius, segments=group.segments))
            continue
        try:
            made = _from_file(scene, index, group, cell)
            groups.append(made or _from_statistics(scene, index, group, cell, rng))
        except SceneError as error:
            faults += error.faults
    if faults:
        raise SceneError(faults)
    return groups


def _error(scene: Scene, index: int, key: str, value: object, remedy: str) -> SceneError:
    return SceneError([Fault(scene.path, f"fibers.{index}.{key}", value, remedy)])


def _from_file(scene: Scene, index: int, group: FiberGroup, cell: Cell) -> GroupFibers | None:
    """Group whose nodes a file gives; None if there is no file."""
    if group.node_file is None:
        return None
    file = group.node_file
    try:
        nodes = read_node_file(file, group.diameter)
    except ValueError as error:
        raise _error(scene, index, "node_file", file, str(error)) from error
    segments = len(nodes[0]) - 1
    if group.segments and group.segments != segments:
        remedy = f"its fibers have {segments} segments, numerics.segments asks for {group.segments}"
        raise _error(scene, index, "node_file", file, f"{remedy}; make them agree")
    if cell.size is not None:
        for f, node_pos in enumerate(nodes):
            low = np.minimum(node_pos, cell.size - node_pos)
            if np.any((low < group.radius * (1.0 - 1e-9)) & cell.wall):
                remedy = f"fiber {f} reaches into a wall; keep its nodes a radius inside the box"
                raise _error(scene, index, "node_file", file, remedy)
    length = max(float(np.linalg.norm(chain[1] - chain[0])) for chain in nodes)
    return GroupFibers(index, cell, group.radius, 0.5 * length, segments, nodes=nodes)


def _from_statistics(
    scene: Scene, index: int, group: FiberGroup, cell: Cell, rng: np.random.Generator
) -> GroupFibers:
    """Group of straight fibers: directions as asked, centers if given."""
    asked = group.orientation
    try:
        tensor = asked_tensor(asked, group.direction)
    except ValueError as error:
        raise _error(scene, index, "orientation", asked, str(error)) from error
    made = GroupFibers(
        index, cell, group.radius, 0.5 * group.centerline_length, group.segments, tensor
    )
    n, made.law = group.count, group.orientation_law
    made.apart = scene.contact.law != "none"
    made.center = np.zeros((n, 3))
    if not isinstance(group.position, str):
        made.given = given_centers(scene, index, group)
    elif cell.size is None:
        raise _error(scene, index, "position", group.position, "needs a [box]; give centers")
    eigen, axes = np.linalg.eigh(tensor)
    live = axes[:, eigen > FLAT]
    made.turning = live @ live.T if live.shape[1] > 1 else np.zeros((3, 3))
    if asked == "aligned":
        made.direction = np.tile(_aligned(group.direction), (n, 1))
    else:
        made.direction = match_moments(draw_directions(tensor, n, rng, made.law), tensor)
    bad = _redraw_misfits(made, rng)
    for _ in range(MATCHES):
        if not made.redrawn or len(bad):
            break
        # The directions that fit may still have the tensor asked for.
        matched = match_moments(made.direction, tensor)
        if not len(made.misfits(matched, made.given)):
            made.direction = matched
            break
        kept = made.direction
        made.direction = matched
        if len(_redraw_misfits(made, rng)):
            made.direction = kept
    if len(bad):
        what = f"fiber {int(bad[0])} would cut a wall or its own periodic image"
        key = "orientation" if made.given is None else "position"
        value = asked if made.given is None else tuple(float(x) for x in made.given[bad[0]])
        remedy = f"{what}; shorten it, enlarge box.size, or turn or move it"
        raise _error(scene, index, key, value, remedy)
    made.drawn = orientation_tensor(made.direction)
    return made


def _redraw_misfits(made: GroupFibers, rng: np.random.Generator) -> Ints:
    """Draws directions again that do not fit; the rows that never did."""
    assert made.tensor is not None
    bad = made.misfits(made.direction, made.given)
    for _ in range(ROUNDS):
        if not len(bad) or not np.any(made.turning):
            break
        made.redrawn += len(bad)
        made.direction[bad] = draw_directions(made.tensor, len(bad), rng, made.law)
        given = None if made.given is None else made.given[bad]
        bad = bad[made.misfits(made.direction[bad], given)]
    return bad


def asked_tensor(
    asked: str | tuple[float, ...], direction: tuple[float, float, float] | None
) -> Floats:
    """A (3, 3) of the keys `orientation` and `direction`; ValueError says what is wrong."""
    if asked == "isotropic":
        return np.asarray(np.eye(3) / 3.0)
    if asked == "planar":
        return np.diag([0.5, 0.5, 0.0])
    if asked == "aligned":
        along = _aligned(direction)
        return np.outer(along, along)
    if isinstance(asked, str):
        raise ValueError("allowed: isotropic, planar, aligned, or six tensor components")
    return tensor_from_values(asked)


def _aligned(direction: tuple[float, float, float] | None) -> Floats:
    along = np.array(direction or (1.0, 0.0, 0.0), dtype=np.float64)
    return np.asarray(along / np.linalg.norm(along))


def given_centers(scene: Scene, index: int, group: FiberGroup) -> Floats:
    """Centers (n, 3) m: one per fiber, or one that all share."""
    centers = np.array(group.position, dtype=np.float64).reshape(-1, 3)
    if len(centers) == 1:
        return np.tile(centers, (group.count, 1))
    if len(centers) != group.count:
        remedy = f"{len(centers)} centers for {group.count} fibers; give one per fiber"
        raise _error(scene, index, "position", group.position, remedy)
    return centers
