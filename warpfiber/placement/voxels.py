"""Which points of the box are surely blocked: one byte per voxel.

A voxel is blocked if any axis through it would come too close to a placed one. The test takes a few
nanoseconds, so thousands of random centers can be tried for one fiber; what it lets pass is tested
exactly afterwards, so no free center is lost.

Source: triangle inequality: a point is at most half a voxel diagonal from the voxel's center.
Symbols: t position of a point along a fiber, -1 to 1, in the order of van der Corput (1935): each
    next point lies where the ones before are far apart.
Limits: voxels grow with the box beyond MOST of them and then block less; never too much.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.cells import Floats, Ints

MOST = 4e8
"""Voxels (bytes)."""
FINEST = 0.4
"""Voxel edge over the smallest touching distance: finer ones take longer to mark than they save."""
CHUNK = 1 << 18
"""Points handled at once, which bounds the memory."""


class Voxels:
    """Blocked voxels of a box; periodic axes wrap around, others reach `beyond` (m) outside."""

    def __init__(
        self, size: Floats, periodic: NDArray[np.bool_], touching: float, beyond: float
    ) -> None:
        """size: box (3,) m; touching: smallest distance of a new axis from any other, m."""
        self.periodic = periodic
        self.touching = touching
        self.low = np.where(periodic, 0.0, -beyond)
        self.extent = np.where(periodic, size, size + 2.0 * beyond)
        edge = max(FINEST * touching, float(np.prod(self.extent) / MOST) ** (1.0 / 3.0))
        self.count = np.maximum(1, np.ceil(self.extent / edge)).astype(np.int64)
        self.edge = self.extent / self.count
        # The last term is for rounding in single precision.
        self.diagonal = 0.5 * float(np.linalg.norm(self.edge)) + 1e-3 * edge
        self.stride = np.array([self.count[1] * self.count[2], self.count[2], 1])
        self.useful = touching > self.diagonal
        self.blocked = np.zeros(int(np.prod(self.count)), dtype=bool)

    def add(self, center: Floats, direction: Floats, half: Floats, spare: Floats) -> None:
        """Blocks the surroundings of axes; spare (n,) m: touching distance above the smallest."""
        radius = (self.touching + spare - self.diagonal) / self.edge.max()
        if not len(half) or float(radius.max()) <= 0.0:
            return
        per = np.ceil(2.0 * half / float(self.edge.min())).astype(np.int64) + 1
        step = max(1, CHUNK // int(per.max()))
        for first in range(0, len(half), step):
            n = per[first : first + step]
            row = np.repeat(np.arange(first, first + len(n)), n)
            rank = np.arange(len(row)) - np.repeat(np.cumsum(n) - n, n)
            n = per[row]
            t = 2.0 * rank / np.maximum(n - 1, 1) - 1.0
            self._mark(center[row] + (t * half[row])[:, None] * direction[row], radius[row])

    def _mark(self, point: Floats, radius: Floats) -> None:
        """Blocks voxels whose centers are within radius (voxel edges, (n,)) of points (n, 3) m."""
        reach = int(np.ceil(float(radius.max()) - 0.5))
        limit = (radius**2).astype(np.float32)
        away, index = [], []
        for k in range(3):
            u = (point[:, k] - self.low[k]) / self.edge[k]
            home = np.floor(u)
            off = (u - home - 0.5).astype(np.float32)
            shift = range(-reach, reach + 1)
            away.append({d: (off - np.float32(d)) ** 2 for d in shift})
            cell = {d: home.astype(np.int64) + d for d in shift}
            for d in shift:
                if self.periodic[k]:
                    cell[d] %= self.count[k]
                else:
                    away[k][d][(cell[d] < 0) | (cell[d] >= self.count[k])] = np.inf
            index.append({d: cell[d] * self.stride[k] for d in shift})
        for x, y in product(away[0], away[1]):
            flat = away[0][x] + away[1][y]
            keep = np.flatnonzero(flat < limit)
            flat, bar = flat[keep], limit[keep]
            at = index[0][x][keep] + index[1][y][keep]
            for z in away[2]:
                hit = flat + away[2][z][keep] < bar
                self.blocked[(at + index[2][z][keep])[hit]] = True

    def passed(self, center: Floats, direction: Floats, half: Floats) -> Ints:
        """Rows of fibers (n, 3), (n, 3), (n,) of which no tested point is blocked."""
        alive = np.arange(len(half))
        if not len(half) or not self.useful:
            return alive
        middle, reach = self._scaled(center, direction, half)
        places = self._places(half, 2.0)
        tested = 0
        while tested < len(places) and len(alive):
            some = places[tested : max(tested + 1, 2 * tested)]
            tested += len(some)
            free = ~np.any(self.blocked[self._index(middle, reach, some)], axis=0)
            alive, middle, reach = alive[free], middle[:, free], reach[:, free]
        return alive

    def blocked_parts(self, center: Floats, direction: Floats, half: Floats) -> Floats:
        """Part of the length of fibers (n, 3), (n, 3), (n,) that is surely blocked, (n,)."""
        part = np.zeros(len(half))
        if not len(half) or not self.useful:
            return part
        places = self._places(half, 1.0)
        step = max(1, CHUNK // len(places))
        for first in range(0, len(half), step):
            rows = slice(first, first + step)
            middle, reach = self._scaled(center[rows], direction[rows], half[rows])
            part[rows] = np.mean(self.blocked[self._index(middle, reach, places)], axis=0)
        return part

    def _places(self, half: Floats, density: float) -> NDArray[np.float32]:
        """t of the tested points, so many per touching distance of the longest fiber."""
        count = int(np.ceil(2.0 * density * float(half.max()) / self.touching)) + 1
        return (2.0 * _spread(count) - 1.0).astype(np.float32)

    def _scaled(
        self, center: Floats, direction: Floats, half: Floats
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Centers and half fibers in extents of the grid, (3, n)."""
        middle = (center - self.low) / self.extent
        reach = direction * half[:, None] / self.extent
        return middle.T.astype(np.float32), reach.T.astype(np.float32)

    def _index(
        self,
        middle: NDArray[np.float32],
        reach: NDArray[np.float32],
        places: NDArray[np.float32],
    ) -> Ints:
        """Voxel number of points (places, n) of fibers (3, n)."""
        index = np.zeros((len(places), middle.shape[1]), dtype=np.int64)
        for k in range(3):
            u = np.multiply.outer(places, reach[k])
            u += middle[k]
            if self.periodic[k]:
                u -= np.floor(u)
            u *= np.float32(self.count[k])
            cell = u.astype(np.int32)
            np.minimum(cell, np.int32(self.count[k] - 1), out=cell)
            index += cell * self.stride[k]
        return index


def _spread(count: int) -> Floats:
    """The first numbers of van der Corput's sequence, in (0, 1)."""
    k = np.arange(1, count + 1)
    value, weight = np.zeros(count), 0.5
    while np.any(k):
        value += weight * (k & 1)
        k >>= 1
        weight *= 0.5
    return value
