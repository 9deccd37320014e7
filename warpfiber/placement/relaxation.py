"""Pushes overlapping straight fibers apart by small rigid translations and rotations.

Source: the energy is half the squared missing distance per overlapping pair; FIRE (Bitzek et al.,
    Phys. Rev. Lett. 97, 170201 (2006)) goes down its gradient, all fibers at once.
Symbols: s, t (m) arms of a contact; gyration (m) = h / sqrt(3), the length that makes a rotation
    comparable with a translation.
Limits: a fiber does not find a way around another one that blocks it, so starts that overlap a lot
    jam (random ones at volume_fraction * aspect_ratio = 5), starts that overlap little do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpfiber.placement.capsules import Capsules, Floats, Ints, Pairs, axis_distance, near_pairs
from warpfiber.placement.space import CLEARANCE, Cell, contact_distance, wall_distance

AIM = 3.0 * CLEARANCE
"""Relative distance aimed at; above the bar, so that the bar is met after finitely many sweeps."""
WIDE = 2.0
"""Skin of the list of near pairs, in diameters; twice the skin, half as many searches."""
LAST = 12
"""Sweeps that a list of the closest pairs is to last: shorter lists against fewer of them."""
CHECK_EVERY = 250
"""Sweeps between two looks at the progress."""


@dataclass
class Freedom:
    """How each capsule may move."""

    translation: Floats
    """1 free, 0 held, (n,)"""
    rotation: Floats
    """projector of the change of direction: identity free, zero held, (n, 3, 3)"""


@dataclass
class Rows:
    """Near pairs of the moment, with the image offsets in m."""

    i: Ints
    j: Ints
    offset: Floats
    reach: Floats


def relax(capsules: Capsules, cell: Cell, freedom: Freedom, sweeps: int) -> tuple[bool, int]:
    """Moves capsules in place until all keep their distance; (whether they do, sweeps used).

    Gives up early when the energy no longer falls. A fiber that may move is one capsule.
    """
    n = len(capsules)
    h, a = capsules.half, capsules.radius
    gyration = np.maximum(h / np.sqrt(3.0), a)
    furthest = 0.4 * float(a.max())
    speed = np.zeros((n, 3))
    spin = np.zeros((n, 3))
    dt, mixing, downhill = 0.1, 0.1, 0
    lists = _Lists(capsules, cell)
    before = np.inf
    for sweep in range(sweeps):
        force, torque, energy, clear = _push(capsules, cell, lists.touching(sweep))
        if clear:
            return True, sweep
        if sweep % CHECK_EVERY == 0:
            if energy > 0.9 * before:
                return False, sweep
            before = energy
        force *= freedom.translation[:, None]
        torque = np.einsum("nkl,nl->nk", freedom.rotation, torque / gyration[:, None])
        power = float(np.sum(speed * force) + np.sum(spin * torque))
        if power > 0.0:
            downhill += 1
            ratio = np.sqrt(
                (np.sum(speed**2) + np.sum(spin**2)) / (np.sum(force**2) + np.sum(torque**2))
            )
            speed = (1.0 - mixing) * speed + mixing * ratio * force
            spin = (1.0 - mixing) * spin + mixing * ratio * torque
            if downhill > 5:
                dt, mixing = min(1.1 * dt, 0.5), 0.99 * mixing
        else:
            speed[:], spin[:] = 0.0, 0.0
            dt, mixing, downhill = max(0.5 * dt, 0.02), 0.1, 0
        speed += dt * force
        spin += dt * torque
        # No fiber jumps past a neighbor in one sweep.
        fastest = float(np.sqrt(np.max(np.sum(speed**2, axis=1) + np.sum(spin**2, axis=1))))
        step = min(dt, furthest / max(fastest, 1e-300))
        capsules.center += step * speed
        turned = capsules.direction + step * spin / gyration[:, None]
        capsules.direction[:] = turned / np.linalg.norm(turned, axis=1)[:, None]
        spin -= np.einsum("nk,nk->n", spin, capsules.direction)[:, None] * capsules.direction
        _keep_inside(capsules, cell, freedom)
    return False, sweeps


class _Lists:
    """Pairs that may touch: near ones, looked up seldom, and of those the closest.

    Both are complete while no point has moved by half of what their skin leaves.
    """

    def __init__(self, capsules: Capsules, cell: Cell) -> None:
        self.capsules, self.cell = capsules, cell
        widest = 2.0 * float(capsules.radius.max())
        self.wide = WIDE * widest
        self.thin = 0.2 * self.wide
        self.spare = 2.0 * AIM * widest
        self.made = 0
        self.near: Rows | None = None
        self.close: Rows | None = None
        self.anchor = self.near_anchor = capsules.center, capsules.direction

    def touching(self, sweep: int) -> Rows:
        """All pairs that push each other now."""
        if self.close is None:
            return self._renewed(sweep)
        moved, lasted = _moved(self.capsules, self.anchor), sweep - self.made
        if moved <= 0.5 * (self.thin - self.spare) and lasted < 2 * LAST:
            return self.close
        thin = 2.0 * moved * LAST / lasted + self.spare
        self.thin = min(max(thin, 2.0 * self.spare), 0.5 * self.wide)
        return self._renewed(sweep)

    def _renewed(self, sweep: int) -> Rows:
        self.made = sweep
        capsules = self.capsules
        self.anchor = capsules.center.copy(), capsules.direction.copy()
        near = self.near
        left = self.wide - self.spare - 2.0 * _moved(capsules, self.near_anchor)
        # A search costs many sweeps: near pairs serve until they hardly leave a skin.
        if near is not None and left > 0.4 * self.thin:
            self.thin = min(self.thin, left)
        else:
            pairs = near_pairs(capsules, self.wide, self.cell.size, self.cell.periodic)
            near = self.near = _rows(pairs, capsules, self.cell)
            self.near_anchor = self.anchor
        _, _, gap = _gaps(capsules, near)
        distance = np.sqrt(np.einsum("nk,nk->n", gap, gap))
        keep = np.flatnonzero(distance < near.reach + self.thin)
        self.close = Rows(near.i[keep], near.j[keep], near.offset[keep], near.reach[keep])
        return self.close


def _moved(capsules: Capsules, anchor: tuple[Floats, Floats]) -> float:
    """Bound of the largest displacement of any point since the anchor (m)."""
    moved = np.linalg.norm(capsules.center - anchor[0], axis=1)
    turned = np.linalg.norm(capsules.direction - anchor[1], axis=1)
    return float(np.max(moved + capsules.half * turned))


def _rows(pairs: Pairs, capsules: Capsules, cell: Cell) -> Rows:
    i, j = pairs.i, pairs.j
    edge = np.zeros(3) if cell.size is None else np.where(cell.periodic, cell.size, 0.0)
    return Rows(i, j, pairs.shift * edge, capsules.radius[i] + capsules.radius[j])


def _gaps(capsules: Capsules, rows: Rows) -> tuple[Floats, Floats, Floats]:
    i, j, p, h = rows.i, rows.j, capsules.direction, capsules.half
    offset = capsules.center[i] - capsules.center[j] - rows.offset
    return axis_distance(offset, p[i], h[i], p[j], h[j])


def _push(capsules: Capsules, cell: Cell, rows: Rows) -> tuple[Floats, Floats, float, bool]:
    """Minus the gradients (m; m^2), the energy (m^2), and whether all distances are kept."""
    n = len(capsules)
    i, j = rows.i, rows.j
    p = capsules.direction
    s, t, gap = _gaps(capsules, rows)
    distance = np.sqrt(np.einsum("nk,nk->n", gap, gap))
    clear = not np.any(distance < contact_distance(rows.reach))
    missing = rows.reach * (1.0 + AIM) - distance
    hit = np.flatnonzero(missing > 0.0)
    i, j, gap, s, t, missing = i[hit], j[hit], gap[hit], s[hit], t[hit], missing[hit]
    # Axes that cross exactly are parted along their common normal.
    lost = distance[hit] < 1e-9 * rows.reach[hit]
    gap[lost] = np.cross(p[i[lost]], p[j[lost]])
    normal = gap / np.maximum(np.linalg.norm(gap, axis=1), 1e-300)[:, None]
    push = missing[:, None] * normal
    who = np.concatenate([i, j])
    linear = np.concatenate([push, -push])
    arm = np.concatenate([s, -t])[:, None] * np.concatenate([push, push])
    energy = 0.5 * float(np.sum(missing**2))
    if cell.size is not None and np.any(cell.wall):
        w_who, w_push, w_arm, w_energy, w_clear = _wall_push(capsules, cell)
        who = np.concatenate([who, w_who])
        linear = np.concatenate([linear, w_push])
        arm = np.concatenate([arm, w_arm])
        energy += w_energy
        clear = clear and w_clear
    force, torque = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(3):
        force[:, k] = np.bincount(who, linear[:, k], n)
        torque[:, k] = np.bincount(who, arm[:, k], n)
    torque -= np.einsum("nk,nk->n", torque, p)[:, None] * p
    return force, torque, energy, clear


def _wall_push(capsules: Capsules, cell: Cell) -> tuple[Ints, Floats, Floats, float, bool]:
    """The same of fiber ends at walls: capsule, push (m), push * arm (m^2), energy, clear."""
    assert cell.size is not None
    who, push, arm = [], [], []
    energy, clear = 0.0, True
    for k in np.flatnonzero(cell.wall):
        for end in (-1.0, 1.0):
            at = capsules.center[:, k] + end * capsules.half * capsules.direction[:, k]
            for side, depth in ((1.0, at), (-1.0, cell.size[k] - at)):
                clear = clear and not np.any(depth < capsules.radius * (1.0 + CLEARANCE))
                missing = capsules.radius * (1.0 + AIM) - depth
                hit = np.flatnonzero(missing > 0.0)
                row = np.zeros((len(hit), 3))
                row[:, k] = side * missing[hit]
                who.append(hit)
                push.append(row)
                arm.append(end * capsules.half[hit, None] * row)
                energy += 0.5 * float(np.sum(missing[hit] ** 2))
    return np.concatenate(who), np.concatenate(push), np.concatenate(arm), energy, clear


def _keep_inside(capsules: Capsules, cell: Cell, freedom: Freedom) -> None:
    """Centers of free fibers stay between walls and inside open faces."""
    if cell.size is None:
        return
    free = freedom.translation > 0.0
    for k in np.flatnonzero(~cell.periodic):
        low = wall_distance(float(capsules.radius.max())) if cell.wall[k] else 0.0
        inside = np.clip(capsules.center[free, k], low, cell.size[k] - low)
        capsules.center[free, k] = inside
