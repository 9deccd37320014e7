"""Distances between capsules, and the pairs of capsules that are near each other in a periodic box.

A straight fiber is one capsule: a center, a unit direction, half a centerline length and a radius.
A bent fiber is one capsule per segment, all with the same owner.

Source: the closest points are found by projecting and clamping twice, as in Ericson, Real-Time
    Collision Detection (2005), section 5.1.9, here without branches.
Symbols: s, t (m) closest points along the two directions, from the centers; D (m) distance of the
    axes; the image of capsule j with integer shift n has its center at center_j + n * size.
Limits: orthogonal boxes; capsules are cut into pieces for a cell grid, so memory grows with
    length / radius.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass
class Capsules:
    """Capsules as arrays; rows are capsules, `owner` is the fiber that a capsule belongs to."""

    center: Floats
    """m, (n, 3)"""
    direction: Floats
    """unit vectors, (n, 3)"""
    half: Floats
    """half the axis length, m, (n,)"""
    radius: Floats
    """m, (n,)"""
    owner: Ints
    """fiber index, (n,)"""

    def __len__(self) -> int:
        return len(self.half)


@dataclass
class Pairs:
    """Unordered pairs: capsule i, and the image of capsule j shifted by `shift` box edges."""

    i: Ints
    j: Ints
    shift: Ints
    """(n, 3)"""


def chain_capsules(
    node_pos: Floats, fiber_node_start: NDArray[np.integer[Any]], fiber_radius: Floats
) -> Capsules:
    """One capsule per segment of chains; node_pos (N, 3) m, starts (F + 1,), radius (F,) m."""
    start = np.asarray(fiber_node_start, dtype=np.int64)
    first = np.ones(len(node_pos), dtype=bool)
    first[start[1:] - 1] = False
    a = np.flatnonzero(first)
    owner = np.searchsorted(start, a, side="right").astype(np.int64) - 1
    step = node_pos[a + 1] - node_pos[a]
    length = np.sqrt(np.einsum("nk,nk->n", step, step))
    direction = step / np.maximum(length, 1e-300)[:, None]
    center = 0.5 * (node_pos[a + 1] + node_pos[a])
    return Capsules(center, direction, 0.5 * length, fiber_radius[owner], owner)


def axis_distance(
    offset: Floats, p1: Floats, h1: Floats, p2: Floats, h2: Floats
) -> tuple[Floats, Floats, Floats]:
    """Closest points of axes: s, t (m), vector from axis 2 to 1 (m); offset = center 1 - 2 (m)."""
    b = np.einsum("nk,nk->n", p1, p2)
    d1 = np.einsum("nk,nk->n", p1, offset)
    d2 = np.einsum("nk,nk->n", p2, offset)
    # Parallel axes: any s is a minimum along the line, the two clamped steps below finish the job.
    s = np.clip((b * d2 - d1) / np.maximum(1.0 - b * b, 1e-14), -h1, h1)
    t = np.clip(b * s + d2, -h2, h2)
    s = np.clip(b * t - d1, -h1, h1)
    return s, t, offset + s[:, None] * p1 - t[:, None] * p2


def image_counts(extent: Floats, size: Floats, periodic: NDArray[np.bool_]) -> list[range]:
    """Integer shifts per axis whose images can come within `extent` (3,) m of a wrapped point."""
    return [
        range(-int(np.ceil(extent[k] / size[k])), int(np.ceil(extent[k] / size[k])) + 1)
        if periodic[k]
        else range(1)
        for k in range(3)
    ]


def near_pairs(
    capsules: Capsules, margin: float, size: Floats | None, periodic: NDArray[np.bool_]
) -> Pairs:
    """Every pair (also with images, also of one's own) with D < radius_i + radius_j + margin (m).

    Two capsules of one owner count only if one of them is an image.
    """
    reach = 2.0 * float(capsules.radius.max()) + margin
    piece = max(4.0 * reach, float(capsules.half.max()) / 32.0)
    per = np.maximum(1, np.ceil(2.0 * capsules.half / piece)).astype(np.int64)
    whose = np.repeat(np.arange(len(capsules)), per)
    rank = np.arange(len(whose)) - np.repeat(np.cumsum(per) - per, per)
    along = ((2 * rank + 1) / per[whose] - 1.0) * capsules.half[whose]
    pos = capsules.center[whose] + along[:, None] * capsules.direction[whose]
    part = capsules.half[whose] / per[whose]
    cell = reach + 2.0 * float(part.max())

    shift = np.zeros((len(pos), 3), dtype=np.int64)
    if size is not None:
        edge = np.where(periodic, size, 1.0)
        shift[:, periodic] = -np.floor(pos / edge).astype(np.int64)[:, periodic]
        pos = pos + shift * edge
    ghost_of, ghost_pos, ghost_shift = _ghosts(pos, shift, cell, size, periodic)

    # Fibers very far apart in an unbounded cell: larger cells keep the cell number an integer.
    cell = max(cell, float((ghost_pos.max(axis=0) - ghost_pos.min(axis=0)).max()) / 1e6)
    low = ghost_pos.min(axis=0) - cell
    dims = np.floor((ghost_pos.max(axis=0) - low) / cell).astype(np.int64) + 2
    key = _cell_key(np.floor((ghost_pos - low) / cell).astype(np.int64), dims)
    order = np.argsort(key, kind="stable")
    key = key[order]
    home = np.floor((pos - low) / cell).astype(np.int64)
    found_i: list[Ints] = []
    found_g: list[Ints] = []
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            # Cells along z follow each other in the key: one range of the list is three cells.
            middle = _cell_key(home + np.array([dx, dy, 0]), dims)
            lo = np.searchsorted(key, middle - 1, side="left")
            hi = np.searchsorted(key, middle + 1, side="right")
            n = hi - lo
            i = np.repeat(np.arange(len(pos)), n)
            g = order[np.arange(len(i)) + np.repeat(lo - (np.cumsum(n) - n), n)]
            u, v = whose[i], whose[ghost_of[g]]
            keep = (u <= v) & (
                np.einsum("nk,nk->n", pos[i] - ghost_pos[g], pos[i] - ghost_pos[g])
                < (reach + part[i] + part[ghost_of[g]]) ** 2
            )
            found_i.append(i[keep])
            found_g.append(g[keep])
    pi = np.concatenate(found_i)
    pg = np.concatenate(found_g)
    return _unique_pairs(
        capsules, margin, size, whose[pi], whose[ghost_of[pg]], ghost_shift[pg] - shift[pi]
    )


def _cell_key(index: Ints, dims: Ints) -> Ints:
    """Cell number with z running fastest; index (n, 3)."""
    return np.asarray((index[:, 0] * dims[1] + index[:, 1]) * dims[2] + index[:, 2])


def _ghosts(
    pos: Floats, shift: Ints, reach: float, size: Floats | None, periodic: NDArray[np.bool_]
) -> tuple[Ints, Floats, Ints]:
    """Points with their images within `reach` (m) of the box: point, position, total shift."""
    source = np.arange(len(pos))
    if size is None:
        return source, pos, shift
    counts = image_counts(np.full(3, reach), size, periodic)
    for k in range(3):
        if not periodic[k]:
            continue
        parts = []
        for n in counts[k]:
            z = pos[:, k] + n * size[k]
            keep = (z > -reach) & (z < size[k] + reach) if n else np.ones(len(pos), dtype=bool)
            moved, moved_shift = pos[keep].copy(), shift[keep].copy()
            moved[:, k] += n * size[k]
            moved_shift[:, k] += n
            parts.append((source[keep], moved, moved_shift))
        source, pos, shift = (np.concatenate(part) for part in zip(*parts, strict=True))
    return source, pos, shift


def _unique_pairs(
    capsules: Capsules, margin: float, size: Floats | None, i: Ints, j: Ints, shift: Ints
) -> Pairs:
    """Drops repeated pairs, mirrored own images, bonded segments and pairs that are not near."""
    own = i == j
    x, y, z = shift.T
    keep = ~own | (x > 0) | ((x == 0) & ((y > 0) | ((y == 0) & (z > 0))))
    keep &= (capsules.owner[i] != capsules.owner[j]) | np.any(shift != 0, axis=1)
    rows = np.column_stack([i, j, shift])[keep]
    if len(rows):
        rows = rows[np.lexsort(rows.T[::-1])]
        rows = rows[np.append(True, np.any(rows[1:] != rows[:-1], axis=1))]
    pairs = Pairs(rows[:, 0], rows[:, 1], rows[:, 2:])
    gap = pair_gap(capsules, pairs, size)
    near = gap < margin
    return Pairs(pairs.i[near], pairs.j[near], pairs.shift[near])


def pair_gap(capsules: Capsules, pairs: Pairs, size: Floats | None) -> Floats:
    """Surface gap D - radius_i - radius_j (m) of every pair; negative is overlap."""
    i, j = pairs.i, pairs.j
    offset = capsules.center[i] - capsules.center[j]
    if size is not None:
        offset = offset - pairs.shift * np.where(np.isfinite(size), size, 0.0)
    _, _, gap = axis_distance(
        offset, capsules.direction[i], capsules.half[i], capsules.direction[j], capsules.half[j]
    )
    distance = np.sqrt(np.einsum("nk,nk->n", gap, gap))
    return np.asarray(distance - capsules.radius[i] - capsules.radius[j])
