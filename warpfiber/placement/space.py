"""The space that fibers are placed in: its faces, the distances kept, and what is there already.

Symbols: p direction, h half centerline length (m), a radius (m).
Limits: orthogonal boxes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.capsules import Floats, axis_distance, image_counts

CLEARANCE = 1e-3
"""Free distance kept at the start, relative to the touching distance."""


@dataclass(frozen=True)
class Container:
    """An upright cylinder around the fibers, all in m."""

    center: Floats
    """its middle, (3,)"""
    radius: float
    height: float

    def holds(self, nodes: Floats, radius: float) -> NDArray[np.bool_]:
        """Which fibers (m, nodes, 3) of this radius lie inside, free of its side, (m,)."""
        away = nodes - self.center
        across = np.hypot(away[..., 0], away[..., 1]).max(axis=1)
        along = np.abs(away[..., 2]).max(axis=1)
        keep = wall_distance(radius)
        held: NDArray[np.bool_] = np.logical_and(
            across <= self.radius - keep, along <= 0.5 * self.height - keep
        )
        return held


@dataclass(frozen=True)
class Cell:
    """The space that fibers are placed in; size None: unbounded."""

    size: Floats | None
    """m, (3,)"""
    periodic: NDArray[np.bool_]
    wall: NDArray[np.bool_]
    container: Container | None = None
    planes: tuple[tuple[Floats, Floats], ...] = ()
    """of each its unit normal, inwards, and a point, m"""

    @property
    def shaped(self) -> bool:
        """Whether there are more bounds than those of a box."""
        return self.container is not None or bool(self.planes)

    def holds(self, nodes: Floats, radius: float) -> NDArray[np.bool_]:
        """Which fibers (m, nodes, 3) of this radius lie inside container and planes, (m,)."""
        held = np.ones(len(nodes), dtype=bool)
        if self.container is not None:
            held &= self.container.holds(nodes, radius)
        for normal, point in self.planes:
            held &= ((nodes - point) @ normal).min(axis=1) >= wall_distance(radius)
        return held


def wall_distance(radius: float) -> float:
    """Smallest distance of a centerline from a wall (m); a little above the bar, for rounding."""
    return radius * (1.0 + CLEARANCE * 1.001)


def contact_distance(radius_sum: Floats) -> Floats:
    """Smallest distance of two centerlines (m); a little above the bar, for rounding."""
    return radius_sum * (1.0 + CLEARANCE * 1.001)


def own_image_hit(direction: Floats, half: Floats, radius: Floats, cell: Cell) -> NDArray[np.bool_]:
    """Which straight fibers come too close to their own periodic image, (n,)."""
    hit = np.zeros(len(half), dtype=bool)
    if cell.size is None or not np.any(cell.periodic) or not len(half):
        return hit
    extent = np.full(3, 2.0 * float((half + radius).max()) * 1.01)
    for n in _shifts(extent, cell):
        if not np.any(n):
            continue
        offset = n * np.where(cell.periodic, cell.size, 0.0)
        along = direction @ offset
        across = np.sum(offset * offset) - along**2
        beyond = np.maximum(np.abs(along) - 2.0 * half, 0.0)
        hit |= across + beyond**2 < contact_distance(2.0 * radius) ** 2
    return hit


def _shifts(extent: Floats, cell: Cell) -> list[NDArray[np.int64]]:
    assert cell.size is not None
    ranges = image_counts(extent, cell.size, cell.periodic)
    return [np.array([x, y, z]) for x in ranges[0] for y in ranges[1] for z in ranges[2]]


class Inserted:
    """Capsules placed so far with those of their periodic images that a new fiber can meet."""

    def __init__(self, cell: Cell, longest: float, widest: float) -> None:
        """longest: half centerline (m) of the longest fiber to come; widest: its radius (m)."""
        self.cell = cell
        self.longest = longest
        self.widest = widest
        self.count = 0
        self.center = np.zeros((64, 3))
        self.direction = np.zeros((64, 3))
        self.half = np.zeros(64)
        self.radius = np.zeros(64)

    def add(self, center: Floats, direction: Floats, half: float, radius: float) -> None:
        """Adds one capsule; center (3,) m, any image of it."""
        images = center[None, :]
        size = self.cell.size
        if size is not None and np.any(self.cell.periodic):
            images = center - np.where(self.cell.periodic, np.floor(center / size) * size, 0.0)
            reach = half * np.abs(direction) + (self.longest + 2.01 * (radius + self.widest))
            shifts = np.array(_shifts(reach, self.cell))
            images = images + shifts * np.where(self.cell.periodic, size, 0.0)
            inside = (images > -reach) & (images < size + reach)
            images = images[np.all(inside | ~self.cell.periodic, axis=1)]
        self._store(images, direction, half, radius)

    def _store(self, images: Floats, direction: Floats, half: float, radius: float) -> None:
        end = self.count + len(images)
        if end > len(self.half):
            for name in ("center", "direction", "half", "radius"):
                old = getattr(self, name)
                new = np.zeros((2 * end, *old.shape[1:]))
                new[: self.count] = old[: self.count]
                setattr(self, name, new)
        self.center[self.count : end] = images
        self.direction[self.count : end] = direction
        self.half[self.count : end] = half
        self.radius[self.count : end] = radius
        self.count = end

    def hit(self, center: Floats, direction: Floats, half: float, radius: float) -> bool:
        """Whether a fiber at center (3,) m comes too close to anything placed."""
        n = self.count
        if self.cell.size is not None:
            size = self.cell.size
            center = center - np.where(self.cell.periodic, np.floor(center / size) * size, 0.0)
        p = np.broadcast_to(direction, (n, 3))
        offset = center - self.center[:n]
        h, bar = np.full(n, half), contact_distance(self.radius[:n] + radius)
        _, _, gap = axis_distance(offset, p, h, self.direction[:n], self.half[:n])
        return bool(np.any(np.einsum("nk,nk->n", gap, gap) < bar**2))
