"""Random sequential insertion of straight fibers: the direction is kept, a free center is drawn.

Source: random sequential addition. Of a fiber with fixed direction, each placed fiber blocks a
    parallelepiped of centers with rounded edges; points are tested against it exactly, lines by
    separating axes.
Symbols: p direction, h half centerline length (m), a radius (m).
Limits: a direction is never traded for an easier one, so insertion keeps the orientations drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.capsules import Capsules, Floats, axis_distance, image_counts

CLEARANCE = 1e-3
"""Free distance kept at the start, relative to the touching distance."""


@dataclass(frozen=True)
class Cell:
    """The space that fibers are placed in; size None: unbounded."""

    size: Floats | None
    """m, (3,)"""
    periodic: NDArray[np.bool_]
    wall: NDArray[np.bool_]

    def center_range(self, direction: Floats, half: float, radius: float) -> tuple[Floats, Floats]:
        """Lowest and highest center (3,) m of a fiber that stays off the walls."""
        if self.size is None:
            return np.zeros(3), np.zeros(3)
        reach = np.where(self.wall, half * np.abs(direction) + wall_distance(radius), 0.0)
        return reach, self.size - reach


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

    def around(self, direction: Floats, half: float, radius: float) -> Capsules:
        """Placed capsules and images that a fiber of this direction reaches from inside the box."""
        n = self.count
        center, p, h, a = self.center[:n], self.direction[:n], self.half[:n], self.radius[:n]
        keep = np.ones(n, dtype=bool)
        size = self.cell.size
        if size is not None:
            for k in range(3):
                reach = h * np.abs(p[:, k]) + (half * abs(direction[k]) + 2.01 * radius) + 2 * a
                if self.cell.periodic[k]:
                    keep &= np.abs(center[:, k] - 0.5 * size[k]) < 0.5 * size[k] + reach
        return Capsules(center[keep], p[keep], h[keep], a[keep], np.flatnonzero(keep))


class Trial:
    """One fiber of fixed direction against everything placed, for many centers at once."""

    def __init__(self, placed: Inserted, direction: Floats, half: float, radius: float) -> None:
        self.direction, self.half = direction, half
        self.near = near = placed.around(direction, half, radius)
        self.bar = contact_distance(near.radius + radius)
        normal = np.cross(direction, near.direction)
        sine = np.sqrt(np.einsum("nk,nk->n", normal, normal))
        spare = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        parallel = sine < 1e-6
        normal[parallel] = spare
        normal /= np.where(parallel, np.sqrt(spare @ spare), sine)[:, None]
        self.normal = normal
        self.level, self.slab = self._slab(normal)

    def _slab(self, axis: Floats) -> tuple[Floats, Floats]:
        """Separating axes: where the neighbors lie along them and the half width they block (m)."""
        near = self.near
        width = self.bar + near.half * np.abs(np.einsum("nk,nk->n", axis, near.direction))
        width += self.half * np.abs(axis @ self.direction)
        width += 1e-9 * (self.half + near.half + self.bar)
        return np.einsum("nk,nk->n", axis, near.center), width

    def overlaps(self, centers: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Candidate number and missing distance (m, > 0) of every overlap; centers (b, 3) m."""
        near = self.near
        height = np.multiply.outer(centers[:, 0], self.normal[:, 0]) - self.level
        for k in (1, 2):
            height += np.multiply.outer(centers[:, k], self.normal[:, k])
        np.abs(height, out=height)
        flat = np.flatnonzero((height < self.slab).ravel())
        b, m = np.divmod(flat, max(len(near), 1))
        offset = centers[b] - near.center[m]
        apart = np.einsum("nk,nk->n", offset, offset)
        close = apart < (self.half + near.half[m] + self.bar[m]) ** 2
        b, m, offset = b[close], m[close], offset[close]
        own = np.broadcast_to(self.direction, (len(b), 3))
        half = np.full(len(b), self.half)
        _, _, gap = axis_distance(offset, own, half, near.direction[m], near.half[m])
        missing = self.bar[m] - np.sqrt(np.einsum("nk,nk->n", gap, gap))
        hit = missing > 0.0
        return b[hit], missing[hit]

    def free_center(
        self, low: Floats, high: Floats, rng: np.random.Generator, lines: int
    ) -> tuple[Floats | None, int]:
        """A free center (m), uniform in [low, high], and the draws; None after so many lines."""
        used = 0
        for batch in (8, 24):
            centers = low + (high - low) * rng.random((batch, 3))
            taken = np.zeros(batch, dtype=bool)
            taken[self.overlaps(centers)[0]] = True
            free = np.flatnonzero(~taken)
            if len(free):
                return np.asarray(centers[free[0]]), used + int(free[0]) + 1
            used += batch
        scan = LineScan(self, low, high)
        searched, batch = 0, 4
        while searched < lines:
            point = scan.free_point(batch, rng)
            searched += batch
            if point is not None and not len(self.overlaps(point[None, :])[0]):
                return point, used + searched
            batch = min(2 * batch, 64)
        return None, used + searched

    def least_overlap(
        self, low: Floats, high: Floats, tries: int, rng: np.random.Generator
    ) -> Floats:
        """The center (m) of `tries` random ones with the least sum of squared overlap."""
        centers = low + (high - low) * rng.random((tries, 3))
        b, missing = self.overlaps(centers)
        return np.asarray(
            centers[int(np.argmin(np.bincount(b, missing**2, minlength=tries)))], dtype=np.float64
        )


class LineScan:
    """Free stretches on random lines through the box: one line does for thousands of points.

    A neighbor blocks where its shadow overlaps on four axes: normal to both fibers, normal to
    either one in their plane, along the new fiber. The rounded edges are taken as sharp: a little
    more is blocked than need be.
    """

    def __init__(self, trial: Trial, low: Floats, high: Floats) -> None:
        near = trial.near
        # Across the fiber the blocked stretches are shortest.
        self.k = int(np.argmin(np.where(high > low, np.abs(trial.direction), 2.0)))
        self.other = [k for k in range(3) if k != self.k]
        self.low, self.high = low, high
        axes = [
            trial.normal,
            _unit(np.cross(trial.normal, near.direction)),
            _unit(np.cross(trial.normal, trial.direction)),
            np.broadcast_to(trial.direction, trial.normal.shape),
        ]
        self.slabs = []
        for axis in axes:
            level, width = trial._slab(np.asarray(axis))
            along = axis[:, self.k]
            along = np.where(np.abs(along) < 1e-9, 1e-9, along)
            slope = axis[:, self.other[0]] / along, axis[:, self.other[1]] / along
            self.slabs.append((level / along, slope[0], slope[1], width / np.abs(along)))

    def free_point(self, lines: int, rng: np.random.Generator) -> Floats | None:
        """A center (m), uniform over the free stretches of so many random lines, if there are."""
        c = self.low + (self.high - self.low) * rng.random((lines, 3))
        pick = rng.random()
        u, v = c[:, self.other[0]], c[:, self.other[1]]
        start, end = self.low[self.k], self.high[self.k]
        lo = np.full((lines, len(self.slabs[0][0])), start)
        hi = np.full_like(lo, end)
        for middle, slope_u, slope_v, width in self.slabs:
            at = middle - np.multiply.outer(u, slope_u)
            at -= np.multiply.outer(v, slope_v)
            np.maximum(lo, at - width, out=lo)
            at += width
            np.minimum(hi, at, out=hi)
        b, m = np.nonzero(lo < hi)
        # All lines one after the other on one axis; empty stretches mark their starts and ends.
        span = 2.0 * (end - start)
        first = span * np.arange(lines)
        begin = np.concatenate([first, first + (end - start), lo[b, m] - start + span * b])
        finish = np.concatenate([first, first + span, hi[b, m] - start + span * b])
        order = np.argsort(begin, kind="stable")
        begin, finish = begin[order], np.maximum.accumulate(finish[order])
        gap = begin[1:] - finish[:-1]
        # Rounding between the end mark of a line and the start mark of the next is no free stretch.
        gap[gap < 1e-9 * span] = 0.0
        total = np.cumsum(gap)
        if not len(total) or total[-1] <= 0.0:
            return None
        g = int(np.searchsorted(total, pick * total[-1], side="right"))
        g = min(g, len(gap) - 1)
        where = finish[g] + (pick * total[-1] - (total[g] - gap[g]))
        line = min(int(where / span), lines - 1)
        center = c[line].copy()
        center[self.k] = start + (where - span * line)
        return np.asarray(center)


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.maximum(np.sqrt(np.einsum("nk,nk->n", v, v)), 1e-300)[:, None])
