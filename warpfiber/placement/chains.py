"""Pushes overlapping fibers apart that may bend: chains of segments of fixed length.

Straight fibers with many contacts each (volume fraction * aspect ratio above about 2) jam; a chain
gives way where another fiber is, and bends far less than what would break it.

Source: the energy is half the squared missing distance per pair of segments, plus bending; FIRE
    (Bitzek et al., Phys. Rev. Lett. 97, 170201 (2006)) goes down its gradient, all nodes at once.
    After each move the segments of a fiber get their lengths back: they are laid end to end, turned
    as they are, about the mean of the nodes.
Symbols: a radius (m); d (m) second difference of nodes at a joint; bending strain = a |turn| / l
    with the segment length l (m); depth of an overlap in radii.
Limits: bending is as soft as packing needs, not the fiber's own modulus. Fibers of one or two
    segments turn slowly, so that they rather move aside and keep their direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.capsules import Capsules, Floats, Ints, axis_distance, near_pairs
from warpfiber.placement.space import CLEARANCE, Cell

AIM = 0.01
"""Relative distance aimed at beyond touching; the bar is then met after finitely many sweeps."""
WALL_AIM = 0.05
"""The same at walls, which nothing may touch: what presses against them then stops before."""
WALL_STIFFNESS = 2.0
"""Stiffness of walls against that of a contact."""
SOFT = 4.0
"""Bending stiffness of a joint against that of a contact, times (segment length / diameter)^3."""
STIFFEST = 0.25
"""The same stiffness at most: a step that is stable for contacts then is for bending."""
HALF_STRAIN = 8e-3
"""Bending strain at which a joint has become twice as stiff; fibers break near 2e-2."""
SLOW_TURN = 0.1
"""Mobility of fibers of one or two segments against turning; of freely turning ones it is 1."""
FURTHEST = 0.06
"""Furthest move of a node in one sweep, radii: lists then last, and no fiber jumps past another."""
WIDE = 1.0
"""Skin of the list of near pairs, in diameters."""
LAST = 12
"""Sweeps that a list of the closest pairs is to last: shorter lists against fewer of them."""
CHECK_EVERY = 200
"""Sweeps between two looks at the progress."""


@dataclass
class Chains:
    """Fibers as chains of segments; the nodes of a fiber are consecutive."""

    node_pos: Floats
    """m, (N, 3)"""
    start: Ints
    """first node of each fiber, and N, (F + 1,)"""
    radius: Floats
    """m, (F,)"""
    free: NDArray[np.bool_]
    """which fibers may move, (F,)"""

    def __post_init__(self) -> None:
        self.node_fiber = np.repeat(np.arange(len(self.radius)), np.diff(self.start))
        last = np.zeros(len(self.node_pos), dtype=bool)
        last[self.start[1:] - 1] = True
        inner = ~last
        inner[self.start[:-1]] = False
        self.first, self.joint = np.flatnonzero(~last), np.flatnonzero(inner)
        self.owner = self.node_fiber[self.first]
        step = self.node_pos[self.first + 1] - self.node_pos[self.first]
        self.rest = np.sqrt(np.einsum("nk,nk->n", step, step))
        self.loose = self.free[self.node_fiber]

    def capsules(self) -> Capsules:
        """One capsule per segment."""
        a, b = self.node_pos[self.first], self.node_pos[self.first + 1]
        direction = (b - a) / self.rest[:, None]
        return Capsules(
            0.5 * (a + b), direction, 0.5 * self.rest, self.radius[self.owner], self.owner
        )

    def lay(self) -> None:
        """Gives all segments of free fibers their lengths back; the mean of the nodes stays."""
        x, first = self.node_pos, self.first
        step = x[first + 1] - x[first]
        step *= (self.rest / np.sqrt(np.einsum("nk,nk->n", step, step)))[:, None]
        along = np.zeros_like(x)
        along[first + 1] = step
        along = np.cumsum(along, axis=0)
        shift = np.add.reduceat(x - along, self.start[:-1], axis=0)
        shift /= np.diff(self.start)[:, None]
        along += shift[self.node_fiber]
        x[self.loose] = along[self.loose]

    def bends(self) -> Floats:
        """Second differences d (m) at all joints, (J, 3)."""
        x, j = self.node_pos, self.joint
        return np.asarray(x[j - 1] - 2.0 * x[j] + x[j + 1])

    def bending_scale(self) -> Floats:
        """a / l^2 at all joints (1/m), (J,): times |d| it is the bending strain."""
        x, j = self.node_pos, self.joint
        step = x[j + 1] - x[j]
        a = self.radius[self.node_fiber[j]]
        return np.asarray(a / np.einsum("nk,nk->n", step, step))

    def bending_strains(self) -> Floats:
        """Bending strain at all joints, (J,)."""
        return np.asarray(np.linalg.norm(self.bends(), axis=1) * self.bending_scale())


@dataclass
class Rows:
    """Near pairs of segments, with image offsets and touching distances in m."""

    i: Ints
    j: Ints
    offset: Floats
    reach: Floats


@dataclass(frozen=True)
class Outcome:
    """How a relaxation ended."""

    clear: bool
    """whether no overlap is deeper than asked"""
    sweeps: int
    depth: float
    """of the deepest overlap, radii"""
    worst: tuple[int, int]
    """fibers of the deepest overlap, twice the same with its own image; second -1: a wall"""


def relax_chains(chains: Chains, cell: Cell, sweeps: int, depth: float) -> Outcome:
    """Moves free chains in place until no overlap is deeper than `depth` (radii).

    Gives up early when overlaps no longer shrink.
    """
    lists = _Lists(chains, cell)
    joint, start = chains.joint, chains.start
    scale = chains.bending_scale()
    a = chains.radius[chains.node_fiber[joint]]
    stiffness = np.minimum(SOFT * (2.0 * np.sqrt(a * scale)) ** 3, STIFFEST)[:, None]
    bar = (scale / HALF_STRAIN)[:, None]
    short = np.flatnonzero(np.diff(start) <= 3)
    ends = start[short], start[short + 1] - 1
    furthest = FURTHEST * float(chains.radius.max())
    speed = np.zeros_like(chains.node_pos)
    dt, mixing, downhill = 0.1, 0.1, 0
    before = np.inf
    for sweep in range(sweeps):
        force, deepest, worst, energy = _push(chains, cell, lists.touching(sweep))
        if deepest <= depth:
            return Outcome(True, sweep, deepest, worst)
        if sweep % CHECK_EVERY == 0:
            if energy > 0.9 * before:
                return Outcome(False, sweep, deepest, worst)
            before = energy
        d = chains.bends()
        strain = np.sqrt(np.einsum("nk,nk->n", d, d))[:, None] * bar
        pull = np.minimum(stiffness * (1.0 + strain**2), STIFFEST) * d
        force[joint] += 2.0 * pull
        force[joint - 1] -= pull
        force[joint + 1] -= pull
        turn = 0.5 * (1.0 - SLOW_TURN) * (force[ends[1]] - force[ends[0]])
        force[ends[0]] += turn
        force[ends[1]] -= turn
        force[~chains.loose] = 0.0
        if np.einsum("nk,nk->", speed, force) > 0.0:
            downhill += 1
            ratio = np.sqrt(np.einsum("nk,nk->", speed, speed) / np.einsum("nk,nk->", force, force))
            speed = (1.0 - mixing) * speed + mixing * ratio * force
            if downhill > 5:
                dt, mixing = min(1.1 * dt, 0.6), 0.99 * mixing
        else:
            speed[:] = 0.0
            dt, mixing, downhill = max(0.5 * dt, 0.02), 0.1, 0
        speed += dt * force
        fast = np.sqrt(np.einsum("nk,nk->n", speed, speed))
        move = speed * np.minimum(dt, furthest / np.maximum(fast, 1e-300))[:, None]
        old = chains.node_pos.copy()
        chains.node_pos += move
        chains.lay()
        speed = (chains.node_pos - old) / dt
    _, deepest, worst, _ = _push(chains, cell, lists.touching(sweeps))
    return Outcome(deepest <= depth, sweeps, deepest, worst)


class _Lists:
    """Pairs that may touch: near ones, looked up seldom, and of those the closest.

    Both are complete while no node has moved by half of what their skin leaves.
    """

    def __init__(self, chains: Chains, cell: Cell) -> None:
        self.chains, self.cell = chains, cell
        widest = 2.0 * float(chains.radius.max())
        self.wide, self.spare = WIDE * widest, 2.0 * AIM * widest
        self.thin = 0.2 * self.wide
        self.made = 0
        self.near: Rows | None = None
        self.close: Rows | None = None
        self.anchor = self.near_anchor = chains.node_pos

    def _moved(self, anchor: Floats) -> float:
        d = self.chains.node_pos - anchor
        return float(np.sqrt(np.max(np.einsum("nk,nk->n", d, d))))

    def touching(self, sweep: int) -> Rows:
        """All pairs that push each other now."""
        if self.close is None:
            return self._renewed(sweep)
        moved, lasted = self._moved(self.anchor), sweep - self.made
        if moved <= 0.5 * (self.thin - self.spare) and lasted < 2 * LAST:
            return self.close
        thin = 2.0 * moved * LAST / max(lasted, 1) + self.spare
        self.thin = min(max(thin, 2.0 * self.spare), 0.5 * self.wide)
        return self._renewed(sweep)

    def _renewed(self, sweep: int) -> Rows:
        self.made = sweep
        chains, near = self.chains, self.near
        self.anchor = chains.node_pos.copy()
        capsules = chains.capsules()
        left = self.wide - self.spare - 2.0 * self._moved(self.near_anchor)
        # A search costs many sweeps: near pairs serve until they hardly leave a skin.
        if near is not None and left > 0.4 * self.thin:
            self.thin = min(self.thin, left)
        else:
            near = self.near = _near(capsules, chains, self.cell, self.wide)
            self.near_anchor = self.anchor
        _, _, gap = _gaps(capsules, near)
        distance = np.sqrt(np.einsum("nk,nk->n", gap, gap))
        keep = np.flatnonzero(distance < near.reach + self.thin)
        self.close = Rows(near.i[keep], near.j[keep], near.offset[keep], near.reach[keep])
        return self.close


def _near(capsules: Capsules, chains: Chains, cell: Cell, margin: float) -> Rows:
    """Pairs of segments nearer than `margin` (m), of which at least one may move."""
    pairs = near_pairs(capsules, margin, cell.size, cell.periodic)
    free = chains.free[chains.owner]
    moving = free[pairs.i] | free[pairs.j]
    i, j = pairs.i[moving], pairs.j[moving]
    edge = np.zeros(3) if cell.size is None else np.where(cell.periodic, cell.size, 0.0)
    return Rows(i, j, pairs.shift[moving] * edge, capsules.radius[i] + capsules.radius[j])


def _gaps(capsules: Capsules, rows: Rows) -> tuple[Floats, Floats, Floats]:
    i, j, p, h = rows.i, rows.j, capsules.direction, capsules.half
    offset = capsules.center[i] - capsules.center[j] - rows.offset
    return axis_distance(offset, p[i], h[i], p[j], h[j])


def _push(chains: Chains, cell: Cell, rows: Rows) -> tuple[Floats, float, tuple[int, int], float]:
    """Minus the gradient at all nodes (m), deepest overlap (radii), its fibers, energy (m^2)."""
    n, first = len(chains.node_pos), chains.first
    capsules = chains.capsules()
    s, t, gap = _gaps(capsules, rows)
    distance = np.sqrt(np.einsum("nk,nk->n", gap, gap))
    depth, worst = 0.0, (0, 0)
    under = 2.0 * (1.0 - distance / rows.reach)
    if len(under):
        row = int(np.argmax(under))
        depth = max(0.0, float(under[row]))
        worst = int(chains.owner[rows.i[row]]), int(chains.owner[rows.j[row]])
    missing = rows.reach * (1.0 + AIM) - distance
    hit = np.flatnonzero(missing > 0.0)
    i, j, gap, missing = rows.i[hit], rows.j[hit], gap[hit], missing[hit]
    # Axes that cross exactly are parted along their common normal.
    lost = distance[hit] < 1e-9 * rows.reach[hit]
    gap[lost] = np.cross(capsules.direction[i[lost]], capsules.direction[j[lost]])
    away = np.sqrt(np.einsum("nk,nk->n", gap, gap))
    push = (missing / np.maximum(away, 1e-300))[:, None] * gap
    part_i = 0.5 + 0.5 * s[hit] / capsules.half[i]
    part_j = 0.5 + 0.5 * t[hit] / capsules.half[j]
    energy = 0.5 * float(np.sum(missing**2))
    force = np.empty((n, 3))
    for k in range(3):
        q = push[:, k]
        one, two = part_i * q, part_j * q
        force[:, k] = np.bincount(first[i] + 1, one, n) + np.bincount(first[i], q - one, n)
        force[:, k] -= np.bincount(first[j] + 1, two, n) + np.bincount(first[j], q - two, n)
    if cell.size is None:
        return force, depth, worst, energy
    radius = chains.radius[chains.node_fiber]
    for axis in np.flatnonzero(cell.wall):
        z = chains.node_pos[:, axis]
        for side, at in ((1.0, z), (-1.0, cell.size[axis] - z)):
            under = np.where(chains.loose, 1.0 + CLEARANCE - at / radius, -1.0)
            node = int(np.argmax(under))
            # Nothing may stick into a wall: any depth counts as a deep one.
            if under[node] > 0.0 and under[node] + 1.0 > depth:
                depth = 1.0 + float(under[node])
                worst = int(chains.node_fiber[node]), -1
            short = np.maximum(radius * (1.0 + WALL_AIM) - at, 0.0)
            force[:, axis] += (side * WALL_STIFFNESS) * short
            energy += 0.5 * WALL_STIFFNESS * float(np.sum(short**2))
    return force, depth, worst, energy
