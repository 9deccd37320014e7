"""Which cells of a grid the capsules pass through: what shares no cell is not near.

Each capsule is grown by half the reach and entered once into every cell that it may touch. Two
capsules within the reach of each other then share the cell of the point half way between them.

Source: spatial hashing of bounding boxes, Ericson, Real-Time Collision Detection (2005), section
    7.1, of short pieces of a capsule one after the other. The boxes move one way along an axis, so
    a cell is new exactly if the piece before does not have it.
Symbols: q integer image of a cell: the cell is found in the box after a shift by -q edges.
Limits: memory grows with length / cell edge.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

IMAGES = 1 << 20
"""Base of image codes; a code packs three signed image numbers."""
MOST_CELLS = 1e6
"""Cells per axis where nothing bounds the fibers; three of these fit one 64-bit cell number."""
CHUNK = 1 << 17
"""Pieces or pairs handled at once, which bounds the memory."""


@dataclass
class Entries:
    """One row per capsule and cell."""

    row: Ints
    """capsule"""
    key: Ints
    """cell number"""
    image: Ints
    """code of q"""

    def taken(self, index: NDArray[np.intp]) -> Entries:
        """These rows, (n,)."""
        return Entries(self.row[index], self.key[index], self.image[index])

    def joined(self, other: Entries) -> Entries:
        """These rows, then the others."""
        return Entries(
            np.concatenate([self.row, other.row]),
            np.concatenate([self.key, other.key]),
            np.concatenate([self.image, other.image]),
        )


@dataclass
class CellGrid:
    """Cells of equal edges; periodic axes wrap around."""

    edge: Floats
    """m, (3,)"""
    low: Floats
    """m, (3,)"""
    count: Ints
    """(3,)"""
    periodic: NDArray[np.bool_]

    def entries(self, center: Floats, direction: Floats, half: Floats, grow: Floats) -> Entries:
        """Cells within `grow` (m) of axes; center (n, 3) m, direction (n, 3), half, grow (n,) m."""
        room = np.maximum(float(self.edge.min()) - 2.0 * grow, grow)
        per = np.maximum(1, np.ceil(2.0 * half / np.maximum(room, 1e-300))).astype(np.int64)
        none = np.zeros(0, dtype=np.int64)
        parts = [(none, none, none)]
        for rows in _split(per):
            parts += self._entries(rows, center, direction, half, grow, per[rows])
        return Entries(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _entries(
        self, rows: slice, center: Floats, direction: Floats, half: Floats, grow: Floats, per: Ints
    ) -> list[tuple[Ints, Ints, Ints]]:
        row = np.repeat(np.arange(rows.start, rows.stop), per)
        rank = np.arange(len(row)) - np.repeat(np.cumsum(per) - per, per)
        part = np.repeat(half[rows] / per, per)
        along = (2 * rank + 1) * part - half[row]
        first = rank == 0
        lows, highs, olds = [], [], []
        for k in range(3):
            p = direction[row, k]
            at = center[row, k] + along * p - self.low[k]
            reach = part * np.abs(p) + grow[row]
            low = np.floor((at - reach) / self.edge[k]).astype(np.int64)
            high = np.floor((at + reach) / self.edge[k]).astype(np.int64)
            old_low, old_high = np.roll(low, 1), np.roll(high, 1)
            old_high[first] = old_low[first] - 1
            lows.append(low)
            highs.append(high)
            olds.append((old_low, old_high))
        made: list[tuple[Ints, Ints, Ints]] = []
        spans = [int((high - low).max()) + 1 for low, high in zip(lows, highs, strict=True)]
        for step in product(*(range(span) for span in spans)):
            new = np.zeros(len(row), dtype=bool)
            real = np.ones(len(row), dtype=bool)
            for k in range(3):
                cell = lows[k] + step[k]
                new |= (cell < olds[k][0]) | (cell > olds[k][1])
                if step[k]:
                    real &= cell <= highs[k]
            at = np.flatnonzero(new & real)
            made.append((row[at], *self._number([lows[k][at] + step[k] for k in range(3)])))
        return made

    def _number(self, cell: list[Ints]) -> tuple[Ints, Ints]:
        """Cell number in the box and code of q; cell three arrays (n,)."""
        key = image = np.zeros(len(cell[0]), dtype=np.int64)
        for k in range(3):
            q = np.floor_divide(cell[k], self.count[k]) if self.periodic[k] else 0
            key = key * self.count[k] + (cell[k] - q * self.count[k])
            image = image * IMAGES + q
        return key, image


def make_grid(
    center: Floats, extent: float, edge: float, size: Floats | None, periodic: NDArray[np.bool_]
) -> CellGrid:
    """Grid of cells of at least `edge` (m) over all centers (n, 3) m and `extent` m beyond."""
    low, high = center.min(axis=0) - extent, center.max(axis=0) + extent
    # Fibers very far apart in an unbounded cell: larger cells keep the cell number an integer.
    edge = max(edge, float((high - low).max()) / MOST_CELLS)
    edges = np.full(3, edge)
    count = np.floor((high - low) / edge).astype(np.int64) + 2
    if size is not None and np.any(periodic):
        wrapped = np.maximum(1, np.floor(np.where(periodic, size, edge) / edge)).astype(np.int64)
        count = np.where(periodic, wrapped, count)
        edges = np.where(periodic, size / count, edge)
        low = np.where(periodic, 0.0, low)
    return CellGrid(edges, low, count, periodic if size is not None else np.zeros(3, dtype=bool))


def shift_of(code: Ints) -> Ints:
    """Three image numbers (n, 3) of codes or differences of codes (n,)."""
    half = IMAGES // 2
    z = (code + half) % IMAGES - half
    code = (code - z) // IMAGES
    y = (code + half) % IMAGES - half
    return np.stack([(code - y) // IMAGES, y, z], axis=1)


def matches(first: Ints, count: Ints) -> Iterator[tuple[Ints, Ints]]:
    """In chunks: k, and each of first[k] ... first[k] + count[k] - 1; first, count (n,)."""
    for rows in _split(count):
        n = count[rows]
        k = np.repeat(np.arange(rows.start, rows.stop), n)
        yield k, np.arange(len(k)) + np.repeat(first[rows] - (np.cumsum(n) - n), n)


def _split(count: Ints) -> Iterator[slice]:
    """Ranges of rows whose counts add up to about a chunk."""
    total = np.cumsum(count)
    start = 0
    while start < len(count):
        before = total[start - 1] if start else 0
        end = max(start + 1, int(np.searchsorted(total, before + CHUNK, side="right")))
        yield slice(start, end)
        start = end
