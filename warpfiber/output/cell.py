"""Cell: the periodic box of one frame, and how unwrapped fibers are brought back into it.

Two cells repeat the same lattice: the parallelepiped of the box vectors, and, if the vectors are
upper triangular (a box sheared along x), an upright brick of the same volume. Pictures use the
brick, which does not lean; cutting at the faces uses the parallelepiped, where one plane per face
is enough.

Symbols: lattice (3, 3), columns = box vectors, m; image = whole numbers of box vectors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpfiber.output.record_error import RecordError

Floats = NDArray[np.float64]
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = [
    (a, b) for a in range(8) for b in range(a) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1
]


@dataclass(frozen=True)
class Cell:
    """Box vectors (columns, m) and which of them repeat."""

    lattice: Floats
    periodic: tuple[bool, bool, bool]

    @classmethod
    def of_scene(cls, scene: Mapping[str, Any], lattice: ArrayLike | None) -> Cell | None:
        """The cell of a frame: its recorded lattice, else the scene's box, else None."""
        box = scene.get("box") or {}
        size, boundary = box.get("size"), box.get("boundary")
        if lattice is not None:
            vectors = np.asarray(lattice, np.float64)
        elif size is not None:
            vectors = np.diag(np.asarray(size, np.float64))
        else:
            return None
        if boundary is None:
            boundary = ("open" if lattice is None else "periodic",) * 3
        x, y, z = (kind == "periodic" for kind in boundary)
        return cls(vectors, (x, y, z))

    @property
    def upright(self) -> bool:
        """Whether an upright brick repeats the lattice too."""
        low = np.tril(self.lattice, -1)
        return bool(np.all(low == 0) and np.all(np.diag(self.lattice) > 0))

    def corner_pos(self, brick: bool = True) -> Floats:
        """Corners (8, 3) of the brick or of the parallelepiped, m."""
        vectors = self.lattice
        if brick and self.upright:
            vectors = np.diag(np.diag(self.lattice))
        return np.asarray(_CORNERS @ vectors.T, dtype=np.float64)

    def edges(self, brick: bool = True) -> Floats:
        """The 12 edges (12, 2, 3), m."""
        edges: Floats = self.corner_pos(brick)[np.array(_EDGES)]
        return edges

    def image_shift(self, center: ArrayLike) -> Floats:
        """Vectors (F, 3) to add so that each of the centers (F, 3) lies in the cell."""
        moved = np.array(center, dtype=np.float64)
        start = moved.copy()
        if not self.upright:
            image = np.floor(np.linalg.solve(self.lattice, moved.T).T) * np.array(self.periodic)
            return np.asarray(-image @ self.lattice.T, dtype=np.float64)
        # From z to x: a step along z also moves x by the shear, never the other way round.
        for axis in (2, 1, 0):
            if self.periodic[axis]:
                count = np.floor(moved[:, axis] / self.lattice[axis, axis])
                moved -= count[:, None] * self.lattice[:, axis]
        return moved - start

    def wrap_fibers(self, node_pos: ArrayLike, fiber_node_start: ArrayLike) -> Floats:
        """Node positions (N, 3) with each fiber moved whole so that its mean position is inside."""
        points, start = np.asarray(node_pos, np.float64), np.asarray(fiber_node_start)
        count = np.diff(start)
        center = np.add.reduceat(points, start[:-1], axis=0) / count[:, None]
        return points + np.repeat(self.image_shift(center), count, axis=0)

    def split_fibers(
        self, node_pos: ArrayLike, fiber_node_start: ArrayLike
    ) -> tuple[Floats, NDArray[np.int32], NDArray[np.int32]]:
        """Fibers cut at the parallelepiped's faces: points, points per piece, fiber of a piece."""
        start = np.asarray(fiber_node_start)
        x = np.linalg.solve(self.lattice, np.asarray(node_pos, np.float64).T).T
        fiber = np.repeat(np.arange(len(start) - 1), np.diff(start))
        first = np.flatnonzero(fiber[1:] == fiber[:-1])
        a, b, owner = x[first], x[first + 1], fiber[first]

        cut_segment = [np.arange(len(a)), np.arange(len(a))]
        cut_at = [np.zeros(len(a)), np.ones(len(a))]
        for axis in np.flatnonzero(self.periodic):
            low = np.floor(np.minimum(a[:, axis], b[:, axis]))
            count = (np.floor(np.maximum(a[:, axis], b[:, axis])) - low).astype(int)
            segment = np.repeat(np.arange(len(a)), count)
            rank = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
            plane = low[segment] + 1 + rank
            cut_segment.append(segment)
            span = b[segment, axis] - a[segment, axis]
            cut_at.append((plane - a[segment, axis]) / span)
        segment, at = np.concatenate(cut_segment), np.clip(np.concatenate(cut_at), 0, 1)
        order = np.lexsort((at, segment))
        segment, at = segment[order], at[order]
        keep = np.flatnonzero((segment[1:] == segment[:-1]) & (np.diff(at) > 1e-9))
        s, t0, t1 = segment[keep], at[keep, None], at[keep + 1, None]
        begin, end = a[s] + t0 * (b[s] - a[s]), a[s] + t1 * (b[s] - a[s])

        # The middle of an interval is never on a face, so its image is not ambiguous.
        image = np.floor(0.5 * (begin + end)) * np.array(self.periodic)
        begin, end = begin - image, end - image
        for axis in np.flatnonzero(self.periodic):
            np.clip(begin[:, axis], 0, 1, out=begin[:, axis])
            np.clip(end[:, axis], 0, 1, out=end[:, axis])
        new = np.ones(len(s), bool)
        new[1:] = (owner[s][1:] != owner[s][:-1]) | np.any(image[1:] != image[:-1], axis=1)
        piece = np.cumsum(new) - 1
        points = np.empty((len(s) + int(new.sum()), 3))
        points[np.arange(len(s)) + piece + 1] = end
        points[(np.arange(len(s)) + piece)[new]] = begin[new]
        count = (np.bincount(piece) + 1).astype(np.int32)
        return points @ self.lattice.T, count, owner[s][new].astype(np.int32)


def closed_lines(
    points: Floats, start: NDArray[np.int32], closed: NDArray[np.bool_]
) -> tuple[Floats, NDArray[np.int32]]:
    """Points and first points of the same fibers, that of `closed` ones (F,) at their end too."""
    first, end = start[:-1][closed], start[1:][closed]
    shift = np.concatenate([[0], np.cumsum(closed)]).astype(np.int32)
    return np.insert(points, end, points[first], axis=0), start + shift


def group_radius(scene: Mapping[str, Any], group_count: int) -> Floats:
    """Fiber radius of each group (G,), m; raises RecordError if the scene lacks it."""
    found = []
    for table in (scene.get("fibers") or [])[:group_count]:
        radius = table.get("radius") or 0.5 * (table.get("diameter") or 0.0)
        found.append(float(radius))
    if len(found) < group_count or min(found, default=1.0) <= 0:
        raise RecordError("the recorded scene does not give the fiber diameter of every group")
    return np.array(found)
