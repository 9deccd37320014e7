"""Contact rows between two segments of fibers whose joints are counted once.

Source: the five candidates of `contact_rows` (closest points, four ends), those of a joint given to
    the segment that ends there.
Symbols: s, t fractions along segments i and j; a radius of the thinner fiber; w(s, t) relative
    motion over the step; b = g + n.w predicted gap.
Limits: of two fibers or of a fiber and its image; a pair of one fiber has plain ends, as rods do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .contact_rows import Line, closest_arcs, unit_normal

Array = np.ndarray
SAME_ARC = 1.0
END = 1e-9


class Side(NamedTuple):
    """One segment and the nodes of its fiber before and after it, if there are any."""

    start: Array
    end: Array
    previous: Array | None = None
    following: Array | None = None

    @property
    def first(self) -> bool:
        """Whether it is the first of its fiber."""
        return self.previous is None

    @property
    def span(self) -> Array:
        """Vector along the segment."""
        return self.end - self.start

    @property
    def length(self) -> float:
        """Its length."""
        return float(np.linalg.norm(self.span))

    def at(self, s: float) -> Array:
        """Point at the fraction s."""
        return self.start + s * self.span

    def nearest(self, point: Array) -> float:
        """Fraction of the point of this segment that is nearest to another."""
        return float(np.clip(self.span @ (point - self.start) / self.length**2, 0.0, 1.0))

    def is_joint(self, s: float) -> bool:
        """Whether s is a node that two segments share."""
        return (s <= END and not self.first) or (s >= 1.0 - END and self.following is not None)

    def next(self) -> Side:
        """The next segment; what follows it does not matter but for its end being no free one."""
        assert self.following is not None
        return Side(self.end, self.following, self.start, self.following)


def closest(i: Side, j: Side) -> tuple[float, float]:
    """(s, t) of the closest points."""
    lines = [Line(x.at(0.5), x.span / x.length, 0.5 * x.length) for x in (i, j)]
    arcs = closest_arcs(*lines)
    t = arcs[1] / j.length + 0.5
    # of parallel lines the middle of the first need not be opposite the second
    return i.nearest(j.at(t)), t


def is_nearest(point: Array, side: Side, t: float, a: float) -> bool:
    """Whether fraction t of a segment is a nearest place of its fiber, counted here."""
    if t <= END and not side.first:
        return False
    if t >= 1.0 - END and side.following is not None:
        edge = side.following - side.end
        return bool((side.end - point) @ edge >= -END * (edge @ edge))
    if side.previous is not None:
        before = Side(side.previous, side.start)
        back = 1.0 - before.nearest(point)
        if hidden(back, back * before.length, t * side.length, a, first=True):
            return False
    if side.following is not None:
        after = Side(side.end, side.following)
        ahead = after.nearest(point)
        return not hidden(ahead, ahead * after.length, (1.0 - t) * side.length, a, first=False)
    return True


def hidden(fraction: float, away: float, along: float, a: float, first: bool) -> bool:
    """In a hollow two places are nearest: of those within one radius, the further from the joint.

    That one is nearer to the point. `away`, `along`: from the joint to the other and this place.
    """
    wins = away >= along if first else away > along
    return fraction > END and away + along < SAME_ARC * a and wins


def same(p: tuple[float, float], q: tuple[float, float], i: Side, j: Side, a: float) -> bool:
    """Whether two places are within one radius along both segments."""
    apart = max(abs(p[0] - q[0]) * i.length, abs(p[1] - q[1]) * j.length)
    return bool(apart < SAME_ARC * a)


def nearer(p: tuple[float, float], q: tuple[float, float], i: Side, j: Side) -> bool:
    """Whether two points are nearer, by more than a thousandth, than two others."""
    found = [float(np.linalg.norm(j.at(t) - i.at(s))) for s, t in (p, q)]
    return found[0] < 0.999 * found[1]


def beside_next(i: Side, j: Side, t: float, a: float) -> bool:
    """Whether the end of i is near the closest points of the next segment and j."""
    if i.following is None:
        return False
    other = i.next()
    st = closest(other, j)
    if st[0] <= END or st[0] >= 1.0 - END or j.is_joint(st[1]):
        # a free last end of the next segment is further than one radius away
        return False
    return same(st, (0.0, t), other, j, a)


def counted_places(i: Side, j: Side, a: float) -> dict[int, tuple[float, float]]:
    """Slot -> (s, t) of the rows of a pair, whatever their gaps."""
    found: dict[int, tuple[float, float]] = {}
    top = closest(i, j)
    if not (i.is_joint(top[0]) or j.is_joint(top[1])):
        found[0] = top
    ends = {1: (1.0, j.nearest(i.end)), 2: (0.0, j.nearest(i.start))}
    open_ends = {k: st for k, st in ends.items() if not (found and same(st, top, i, j, a))}
    for k, st in open_ends.items():
        if k == 2 and not i.first:
            continue
        if is_nearest(i.at(st[0]), j, st[1], a) and not (k == 1 and beside_next(i, j, st[1], a)):
            found[k] = st
    for k, st in {3: (i.nearest(j.end), 1.0), 4: (i.nearest(j.start), 0.0)}.items():
        if k == 4 and not j.first:
            continue
        earlier = [*open_ends.values(), *([top] if 0 in found else [])]
        beside = [other for other in earlier if same(st, other, i, j, a)]
        if any(0 in found or not nearer(st, other, i, j) for other in beside):
            continue
        if is_nearest(j.at(st[1]), i, st[0], a) and not (k == 3 and beside_next(j, i, st[0], a)):
            found[k] = st
    return found


class PairRow(NamedTuple):
    """One row: slot, fractions, normal from i to j, predicted gap, gap."""

    slot: int
    s: float
    t: float
    normal: Array
    base: float
    gap: float


def freedom(side: Side, s: float) -> float:
    """How near to a free end of its fiber a place is: 1 there, 1/2 from half a segment on."""
    ends = [0.5] + [1.0 - s] * side.first + [s] * (side.following is None)
    return max(ends)


def pair_rows(
    i: Side,
    j: Side,
    motion_i: Array,
    motion_j: Array,
    radii: tuple[float, float],
    keep: float,
    near_now: float = -np.inf,
) -> list[PairRow]:
    """Rows with a predicted gap below `keep` thinner radii; motions (2, 3) of the two nodes.

    Or with a gap below `near_now` at a free end, half of it inside a fiber.
    """
    a = min(radii)
    rows = []
    for slot, (s, t) in sorted(counted_places(i, j, a).items()):
        apart = j.at(t) - i.at(s)
        distance = float(np.linalg.norm(apart))
        normal = unit_normal(apart, distance, i.span / i.length, j.span / j.length)
        moved = (1 - t) * motion_j[0] + t * motion_j[1] - (1 - s) * motion_i[0] - s * motion_i[1]
        gap = distance - sum(radii)
        held = gap < near_now * a * max(freedom(i, s), freedom(j, t))
        if held or gap + normal @ moved < keep * a:
            rows.append(PairRow(slot, s, t, normal, gap + float(normal @ moved), gap))
    return rows
