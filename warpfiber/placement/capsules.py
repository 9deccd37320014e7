"""Distances between capsules, and the pairs of capsules that are near each other in a periodic box.

A straight fiber is one capsule: a center, a unit direction, half a centerline length and a radius.
A bent fiber is one capsule per segment, all with the same owner.

Source: the closest points are found by projecting and clamping twice, as in Ericson, Real-Time
    Collision Detection (2005), section 5.1.9, here without branches.
Symbols: s, t (m) closest points along the two directions, from the centers; D (m) distance of the
    axes; the image of capsule j with integer shift n has its center at center_j + n * size.
Limits: orthogonal boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.cells import Floats as Floats
from warpfiber.placement.cells import Ints as Ints
from warpfiber.placement.cells import make_grid, matches, shift_of

CELL = 2.0
"""Edge of a cell over the reach; measured best for random fibers of aspect ratio 20 to 100."""


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

    def taken(self, index: NDArray[np.integer[Any]]) -> Capsules:
        """Copies of these rows, (n,)."""
        return Capsules(
            self.center[index],
            self.direction[index],
            self.half[index],
            self.radius[index],
            self.owner[index],
        )

    def joined(self, other: Capsules) -> Capsules:
        """These rows, then the others; owners stay as they are."""
        return Capsules(
            np.concatenate([self.center, other.center]),
            np.concatenate([self.direction, other.direction]),
            np.concatenate([self.half, other.half]),
            np.concatenate([self.radius, other.radius]),
            np.concatenate([self.owner, other.owner]),
        )


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


def stacked(parts: list[Capsules]) -> Capsules:
    """Capsules one after the other; owners stay distinct."""
    first: Ints = np.cumsum([0] + [int(part.owner.max()) + 1 for part in parts])
    return Capsules(
        np.concatenate([part.center for part in parts]),
        np.concatenate([part.direction for part in parts]),
        np.concatenate([part.half for part in parts]),
        np.concatenate([part.radius for part in parts]),
        np.concatenate([part.owner + first[k] for k, part in enumerate(parts)]),
    )


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
    n = len(capsules)
    grow = capsules.radius + 0.5 * margin
    edge = CELL * max(2.0 * float(grow.max()), 4.0 * float(capsules.radius.max()))
    extent = float((capsules.half + grow).max())
    grid = make_grid(capsules.center, extent, edge, size, periodic)
    made = grid.entries(capsules.center, capsules.direction, capsules.half, grow)
    made = made.taken(np.argsort(made.key, kind="stable"))
    after = np.arange(1, len(made.key) + 1)
    last = np.searchsorted(made.key, made.key, side="right")
    packed = _Packed(n, shift_of(made.image))
    found: list[Ints] = []
    for k, m in matches(after, last - after):
        key = packed.key(made.row, k, m)
        i, j, shift = packed.pair(key)
        own = capsules.owner[i] == capsules.owner[j]
        if np.any(own):
            key = key[~own | (shift != 0)]
        key = _unique(key)
        found.append(key[pair_gap(capsules, packed.pairs(key), size) < margin])
    return packed.pairs(_unique(np.concatenate(found or [after[:0]])))


class _Packed:
    """Pairs packed into one number each: i, j, and the three digits of the shift."""

    def __init__(self, n: int, image: Ints) -> None:
        """n: capsules; image: of every entry, (m, 3)."""
        self.base = 4 * int(np.abs(image).max(initial=0)) + 1
        self.row_bits = n.bit_length()
        self.middle = self.base**3 // 2
        self.code_bits = int(self.base**3).bit_length()
        if 2 * self.row_bits + self.code_bits > 63:
            raise ValueError("fibers reach through too many images of the box; enlarge box.size")
        self.code = (image[:, 0] * self.base + image[:, 1]) * self.base + image[:, 2]

    def key(self, row: Ints, k: Ints, m: Ints) -> Ints:
        """Of entries k and m; i is the smaller row, and of own images the upper one counts."""
        i, j = row[k], row[m]
        shift = self.code[k] - self.code[m]
        turned = (i > j) | ((i == j) & (shift < 0))
        shift[turned] *= -1
        upper = np.minimum(i, j) << (self.row_bits + self.code_bits)
        return np.asarray(upper | (np.maximum(i, j) << self.code_bits) | (shift + self.middle))

    def pair(self, key: Ints) -> tuple[Ints, Ints, Ints]:
        """i, j and the packed shift."""
        j = (key >> self.code_bits) & ((1 << self.row_bits) - 1)
        shift = (key & ((1 << self.code_bits) - 1)) - self.middle
        return key >> (self.row_bits + self.code_bits), j, shift

    def pairs(self, key: Ints) -> Pairs:
        """The same with the shift of every axis."""
        i, j, code = self.pair(key)
        shift = np.zeros((len(key), 3), dtype=np.int64)
        far = np.flatnonzero(code)
        rest = code[far] + self.middle
        for k in (2, 1, 0):
            shift[far, k] = rest % self.base - self.base // 2
            rest //= self.base
        return Pairs(i, j, shift)


def _unique(key: Ints) -> Ints:
    """Sorted, each once."""
    key = np.sort(key)
    return key[np.append(True, key[1:] != key[:-1])] if len(key) else key


def pair_gap(capsules: Capsules, pairs: Pairs, size: Floats | None) -> Floats:
    """Surface gap D - radius_i - radius_j (m) of every pair; negative is overlap."""
    i, j = pairs.i, pairs.j
    offset = capsules.center[i] - capsules.center[j]
    if size is not None:
        far = np.flatnonzero(np.any(pairs.shift, axis=1))
        offset[far] -= pairs.shift[far] * np.where(np.isfinite(size), size, 0.0)
    _, _, gap = axis_distance(
        offset, capsules.direction[i], capsules.half[i], capsules.direction[j], capsules.half[j]
    )
    distance = np.sqrt(np.einsum("nk,nk->n", gap, gap))
    return np.asarray(distance - capsules.radius[i] - capsules.radius[j])
