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
        if not len(half) or self.touching <= self.diagonal:
            return alive
        tested, points = 0, int(np.ceil(4.0 * float(half.max()) / self.touching)) + 1
        places = 2.0 * _spread(points) - 1.0
        while tested < points and len(alive):
            some = places[tested : max(tested + 1, 2 * tested)]
            tested += len(some)
            free = np.ones(len(alive), dtype=bool)
            for t in some:
                free &= ~self.blocked[self._index(center, direction, t * half, alive)]
            alive = alive[free]
        return alive

    def _index(self, center: Floats, direction: Floats, along: Floats, row: Ints) -> Ints:
        """Voxel number of the points center + along * direction of these rows."""
        index = np.zeros(len(row), dtype=np.int64)
        for k in range(3):
            u = center[row, k] + along[row] * direction[row, k]
            u = (u - self.low[k]) / self.extent[k]
            u -= np.floor(u) if self.periodic[k] else 0.0
            cell = (u * self.count[k]).astype(np.int64)
            index += np.clip(cell, 0, self.count[k] - 1) * self.stride[k]
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
