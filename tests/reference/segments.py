"""Closest points of two segments, brute-force list of segment pairs, vertex rule.

Source: Ericson, Real-Time Collision Detection, 5.1.9 (closest points); Sasayama & Inagaki 2018,
    Appendix A (own-fiber rule); vertex rule: one contact per local minimum of the distance.
Symbols: s, t in [0, 1] closest points on segments i, j; shift = whole numbers of box vectors that
    move segment j; a radius; l rest length of a segment.
Limits: open fibers (no rings). Exactly parallel segments have no unique closest points; their
    distance is right, s and t are one valid choice.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

Array = np.ndarray


class Segments(NamedTuple):
    """Segments of all fibers in node order; each array (S,)."""

    fiber: Array  # fiber of the segment
    local: Array  # its number inside the fiber
    node: Array  # its first node; the second is node + 1
    last: Array  # whether it is the last of its fiber


class SegmentPair(NamedTuple):
    """Two segments near each other; i < j, or i == j with its own periodic image."""

    i: int
    j: int
    shift: tuple[int, int, int]
    s: float
    t: float
    distance: float
    gap: Array  # closest point of j (shifted) minus closest point of i, (3,)
    offset: Array  # lattice @ shift, to be added to the nodes of j, (3,)


def list_segments(fiber_node_start: Sequence[int]) -> Segments:
    """Segments of fibers whose nodes are fiber_node_start[f] : fiber_node_start[f + 1]."""
    rows = [
        (f, p, start + p, p == stop - start - 2)
        for f, (start, stop) in enumerate(itertools.pairwise(fiber_node_start))
        for p in range(stop - start - 1)
    ]
    columns = zip(*rows, strict=True)
    return Segments(*(np.array(column) for column in columns))


def closest_points(p1: Array, q1: Array, p2: Array, q2: Array) -> tuple[float, float]:
    """s, t in [0, 1] of the closest points p1 + s (q1 - p1) and p2 + t (q2 - p2)."""
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e, f = float(d1 @ d1), float(d2 @ d2), float(d2 @ r)
    tiny = 1e-300
    if a <= tiny and e <= tiny:
        return 0.0, 0.0
    if a <= tiny:
        return 0.0, min(max(f / e, 0.0), 1.0)
    c = float(d1 @ r)
    if e <= tiny:
        return min(max(-c / a, 0.0), 1.0), 0.0
    b = float(d1 @ d2)
    denominator = a * e - b * b
    s = min(max((b * f - c * e) / denominator, 0.0), 1.0) if denominator > 0.0 else 0.0
    t = (b * s + f) / e
    if t < 0.0:
        t = 0.0
        s = min(max(-c / a, 0.0), 1.0)
    elif t > 1.0:
        t = 1.0
        s = min(max((b - c) / a, 0.0), 1.0)
    return s, t


def own_fiber_excluded(p: int, q: int, rest_length: float, radius: float) -> bool:
    """Whether two segments of one fiber are too near along it to be a contact."""
    return (abs(p - q) - 1) * rest_length < math.pi * radius


def find_pairs(
    node_pos: Array,
    fiber_node_start: Sequence[int],
    reach: float,
    *,
    radius: Array | float,
    rest_length: Array | float,
    lattice: Array | None = None,
    periodic: Sequence[bool] = (True, True, True),
) -> list[SegmentPair]:
    """All pairs with a centerline distance <= reach, every pair once, with all periodic images.

    radius, rest_length: one number or one per fiber. lattice (3, 3): columns are the box vectors;
    a non-periodic axis needs a column too (any length). Image numbers are searched as far as the
    reach asks for, so positions may be unwrapped and the box short or sheared.
    """
    seg = list_segments(fiber_node_start)
    fibers = len(fiber_node_start) - 1
    radii = np.broadcast_to(np.asarray(radius, float), (fibers,))
    rests = np.broadcast_to(np.asarray(rest_length, float), (fibers,))
    first, second = node_pos[seg.node], node_pos[seg.node + 1]
    middle = 0.5 * (first + second)
    half = 0.5 * np.linalg.norm(second - first, axis=1)
    cell = np.eye(3) if lattice is None else np.asarray(lattice, float)
    inverse = np.linalg.inv(cell)
    # A vector of length r has |fractional coordinate k| <= r times the norm of row k.
    per_length = np.linalg.norm(inverse, axis=1)
    turns = np.array([lattice is not None and bool(axis) for axis in periodic])

    pairs: list[SegmentPair] = []
    count = len(seg.fiber)
    for i in range(count):
        j_all = np.arange(i, count)
        apart = middle[j_all] - middle[i]
        within = half[i] + half[j_all] + reach
        fraction = apart @ inverse.T
        low = np.ceil((-fraction - within[:, None] * per_length).min(axis=0)).astype(int)
        high = np.floor((-fraction + within[:, None] * per_length).max(axis=0)).astype(int)
        low, high = np.where(turns, low, 0), np.where(turns, high, 0)
        for shift in itertools.product(
            *(range(int(lo), int(hi) + 1) for lo, hi in zip(low, high, strict=True))
        ):
            offset = cell @ np.array(shift, float)
            near = np.linalg.norm(apart + offset, axis=1) <= within
            for j in j_all[near]:
                if j == i and shift <= (0, 0, 0):
                    continue  # itself, or the same own-image pair seen from the other side
                f = int(seg.fiber[i])
                if (
                    shift == (0, 0, 0)
                    and f == seg.fiber[j]
                    and own_fiber_excluded(int(seg.local[i]), int(seg.local[j]), rests[f], radii[f])
                ):
                    continue
                pj, qj = first[j] + offset, second[j] + offset
                s, t = closest_points(first[i], second[i], pj, qj)
                gap = (pj + t * (qj - pj)) - (first[i] + s * (second[i] - first[i]))
                distance = float(np.linalg.norm(gap))
                if distance <= reach:
                    pairs.append(SegmentPair(i, int(j), shift, s, t, distance, gap, offset))
    return sorted(pairs, key=lambda pair: (pair.i, pair.j, pair.shift))


def accepts_vertex(
    pair: SegmentPair, node_pos: Array, seg: Segments, tolerance: float = 1e-9
) -> bool:
    """Vertex rule: whether the pair is a local minimum of the distance counted only here.

    Parameters within `tolerance` of a node count as the node. Without it (tolerance = 0) a touch
    exactly at a node is counted once, twice or not at all, as the rounding falls.
    """
    for k, parameter, gap in ((pair.i, pair.s, pair.gap), (pair.j, pair.t, -pair.gap)):
        if parameter >= 1.0 - tolerance and not seg.last[k]:
            return False
        if parameter <= tolerance and seg.local[k] > 0:
            node = seg.node[k]
            before = node_pos[node] - node_pos[node - 1]
            if gap @ before < -tolerance * (before @ before):
                return False
    return True


def expected_contacts(volume_fraction: float, aspect_ratio: float, crossing: float) -> float:
    """Mean contacts per fiber of randomly placed overlapping spherocylinders.

    aspect_ratio: tip to tip over diameter; crossing f = <|p x p'|>: pi/4 isotropic, 2/pi planar,
    0 aligned. volume_fraction counts the round ends.
    """
    d = 1.0
    length = (aspect_ratio - 1.0) * d
    excluded = 2 * length**2 * d * crossing + 2 * math.pi * d**2 * length + 4 / 3 * math.pi * d**3
    volume = math.pi / 4 * d**2 * length + math.pi / 6 * d**3
    return volume_fraction * excluded / volume
