"""Random sequential insertion of many straight fibers at once: directions are kept, centers drawn.

Fibers go in by groups: all of a group draw centers, those that are free of everything placed are
kept, and of two new fibers in each other's way the later one draws again.

Source: random sequential addition, in the order of the group instead of one by one. Voxels reject
    most centers, cells find the neighbors of the rest.
Limits: a fiber that finds no center in TRIES is set aside: it goes in later, or overlapping.
"""

from __future__ import annotations

import numpy as np

from warpfiber.placement.capsules import Capsules, Floats, Ints, axis_distance, near_pairs, pair_gap
from warpfiber.placement.cells import Entries, make_grid, matches, shift_of
from warpfiber.placement.space import CLEARANCE, Cell, contact_distance
from warpfiber.placement.voxels import Voxels

TRIES = 8192
"""Random centers tried for one fiber before it is set aside."""
FIRST_TRIES = 4
"""Centers per fiber in the first draw; each next draw takes twice as many."""
DRAWN = 1 << 18
"""Most centers drawn at once."""
PART = 32
"""Groups that all fibers go in by: fibers of one group are seldom in each other's way."""
STALLED = 0.5
"""Part of a group set aside from which on insertion counts as stalled."""
DRAWS = 128
"""Random centers of a fiber without free center, of which the least blocked are looked at."""
BEST_OF = 8
"""Centers looked at, of which the fiber takes the one that overlaps least."""


class Crowd:
    """Capsules placed so far, asked about many candidates at once."""

    def __init__(self, cell: Cell, loose: Capsules) -> None:
        """loose: the fibers that will be placed; their centers are written by this class."""
        assert cell.size is not None
        self.cell, self.size, self.loose = cell, cell.size, loose
        self.thinnest = float(loose.radius.min())
        self.longest = float((loose.half + loose.radius).max())
        corners = np.array([np.zeros(3), cell.size])
        edge = 8.0 * float(loose.radius.max())
        self.grid = make_grid(corners, self.longest, edge, cell.size, cell.periodic)
        self.low = np.zeros((len(loose), 3))
        if np.any(cell.wall):
            reach = loose.half[:, None] * np.abs(loose.direction)
            reach += contact_distance(loose.radius)[:, None]  # of a wall and an axis, too
            self.low = np.where(cell.wall, reach, 0.0)
        self.clear()

    def clear(self) -> None:
        """Forgets everything placed."""
        touching = float(contact_distance(np.array(2.0 * self.thinnest)))
        self.voxels = Voxels(self.size, self.cell.periodic, touching, self.longest)
        none = np.zeros(0, dtype=np.int64)
        self.table = Entries(none, none, none)
        self.placed = self.loose.taken(none)

    def add(self, capsules: Capsules) -> None:
        """Capsules that those to come must keep off."""
        new = self._entries(capsules)
        new.row += len(self.placed)
        self.table = self.table.joined(new)
        self.table = self.table.taken(np.argsort(self.table.key, kind="stable"))
        self.placed = self.placed.joined(capsules)
        spare = contact_distance(capsules.radius - self.thinnest)
        self.voxels.add(capsules.center, capsules.direction, capsules.half, spare)

    def _entries(self, capsules: Capsules) -> Entries:
        grow = capsules.radius * (1.0 + 2.0 * CLEARANCE)
        return self.grid.entries(capsules.center, capsules.direction, capsules.half, grow)

    def overlaps(self, new: Capsules) -> tuple[Ints, Floats]:
        """Row and missing distance (m, > 0) of every overlap of candidates with what is placed."""
        asked = self._entries(new)
        # In the order of the table, its rows are read one after the other.
        asked = asked.taken(np.argsort(asked.key, kind="stable"))
        lo = np.searchsorted(self.table.key, asked.key, side="left")
        count = np.searchsorted(self.table.key, asked.key, side="right") - lo
        rows, whom, codes, missing = [], [], [], []
        placed = self.placed
        for k, m in matches(lo, count):
            i, j = asked.row[k], self.table.row[m]
            code = asked.image[k] - self.table.image[m]
            offset = new.center[i] - placed.center[j]
            far = np.flatnonzero(code)
            offset[far] -= shift_of(code[far]) * self.size
            _, _, gap = axis_distance(
                offset, new.direction[i], new.half[i], placed.direction[j], placed.half[j]
            )
            bar = contact_distance(new.radius[i] + placed.radius[j])
            short = bar - np.sqrt(np.einsum("nk,nk->n", gap, gap))
            hit = np.flatnonzero(short > 0.0)
            rows.append(i[hit])
            whom.append(j[hit])
            codes.append(code[hit])
            missing.append(short[hit])
        if not rows:
            return lo[:0], np.zeros(0)
        i, j, code, short = (np.concatenate(x) for x in (rows, whom, codes, missing))
        order = np.lexsort((code, j, i))
        i, j, code, short = i[order], j[order], code[order], short[order]
        same = (i[1:] == i[:-1]) & (j[1:] == j[:-1]) & (code[1:] == code[:-1])
        once = np.append(True, ~same)[: len(i)]
        return i[once], short[once]

    def _drawn(self, which: Ints, tries: int, rng: np.random.Generator) -> tuple[Ints, Floats]:
        """So many random centers (m) for each of these fibers: fiber, center."""
        row = np.repeat(which, tries)
        low = self.low[row]
        return row, low + (self.size - 2.0 * low) * rng.random((len(row), 3))

    def insert(self, which: Ints, tries: Ints, rng: np.random.Generator) -> Ints:
        """Places these fibers at free centers, until stalled; those placed. tries (n,) is added to.

        Centers are uniform over what is free at the time.
        """
        part = max(1, -(-len(self.loose) // PART))
        done = [which[:0]]
        for start in range(0, len(which), part):
            group = which[start : start + part]
            left = self._insert_group(group, tries, rng)
            done.append(np.setdiff1d(group, left))
            if len(left) > STALLED * len(group):
                break
        return np.concatenate(done)

    def _insert_group(self, left: Ints, tries: Ints, rng: np.random.Generator) -> Ints:
        """Places a group; the fibers set aside."""
        used, more = 0, FIRST_TRIES
        while len(left) and used < TRIES:
            more = max(1, min(more, TRIES - used, DRAWN // len(left)))
            row, center = self._drawn(left, more, rng)
            used += more
            tries[left] += more
            more *= 2
            kept = self.voxels.passed(center, self.loose.direction[row], self.loose.half[row])
            row, center = row[kept], center[kept]
            free = np.ones(len(row), dtype=bool)
            free[self.overlaps(self._at(row, center))[0]] = False
            row, center = row[free], center[free]
            row, first = np.unique(row, return_index=True)
            new = self._at(row, center[first])
            keep = self._first_come(new)
            self.loose.center[row[keep]] = new.center[keep]
            self.add(new.taken(keep))
            left = np.setdiff1d(left, row[keep])
        return left

    def squeeze(self, which: Ints, rng: np.random.Generator) -> None:
        """Places these fibers where they overlap least, of some random centers."""
        step = max(1, -(-len(self.loose) // (4 * PART)))
        for start in range(0, len(which), step):
            group = which[start : start + step]
            row, center = self._drawn(group, DRAWS, rng)
            loose = self.loose
            part = self.voxels.blocked_parts(center, loose.direction[row], loose.half[row])
            least = np.argsort(part.reshape(-1, DRAWS), axis=1, kind="stable")[:, :BEST_OF]
            least = (least + DRAWS * np.arange(len(group))[:, None]).ravel()
            row, center = row[least], center[least]
            hit, missing = self.overlaps(self._at(row, center))
            cost = np.bincount(hit, missing**2, minlength=len(row)).reshape(-1, BEST_OF)
            best = np.argmin(cost, axis=1) + BEST_OF * np.arange(len(group))
            self.loose.center[group] = center[best]
            self.add(self.loose.taken(group))

    def _at(self, row: Ints, center: Floats) -> Capsules:
        new = self.loose.taken(row)
        new.center = center
        return new

    def _first_come(self, new: Capsules) -> Ints:
        """Rows without those that come too near an earlier one that stays."""
        stays = np.ones(len(new), dtype=bool)
        if len(new) > 1:
            new.owner = np.arange(len(new))
            margin = 2.0 * CLEARANCE * 1.001 * float(new.radius.max())
            pairs = near_pairs(new, margin, self.size, self.cell.periodic)
            bar = contact_distance(new.radius[pairs.i] + new.radius[pairs.j])
            bar -= new.radius[pairs.i] + new.radius[pairs.j]
            close = (pair_gap(new, pairs, self.size) < bar) & (pairs.i != pairs.j)
            for i, j in zip(pairs.i[close], pairs.j[close], strict=True):
                stays[j] &= not stays[i]
        return np.flatnonzero(stays)
