"""One step of rods in contact with Coulomb friction, as rigid bodies that also spin.

Source: six displacements of a rod, of its middle and about it: drag xi along and across, K_r across
    its axis, 8 pi eta a^3 N about it. Forces act where surfaces touch, at n a off the center line.
        0 <= f, e >= 0, one of them an equality;  |F| <= mu f;  S = 0 or F = -mu f S/|S|
Symbols: f normal, F tangential force on the partner; e gap at the end of the step, S slip of the
    partner over the owner; n normal from owner to partner.
Limits: rods of one radius; sweeps of projections, so mu must not be large.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .rigid_rod import Array, Rods

WALL = -1


class Touch(NamedTuple):
    """A row: rods, arcs from their middles, normal, gap and slip that come without contact."""

    i: int
    j: int
    arc_i: float
    arc_j: float
    normal: Array
    base: float
    slip: Array
    friction: float


class Rubbed(NamedTuple):
    """Forces (R,), (R, 3), slips (R, 3), displacements of middles and turns of rods (F, 3)."""

    force: Array
    flat: Array
    slip: Array
    move: Array
    turn: Array


def cross_matrix(v: Array) -> Array:
    """[v] with [v] w = v x w."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def mobility(rods: Rods, h: float) -> Array:
    """Displacements (6F, 6F) of a step by forces and torques, rod by rod."""
    count = len(rods.center)
    whole = np.zeros((count, 6, count, 6))
    rolling = 8.0 * math.pi * rods.viscosity * rods.radius**3 * rods.beads
    for k, p in enumerate(rods.axis):
        along = np.outer(p, p)
        whole[k, :3, k, :3] = h * np.eye(3) / rods.drag[k]
        whole[k, 3:, k, 3:] = h * ((np.eye(3) - along) / rods.turning_drag[k] + along / rolling[k])
    return whole.reshape(6 * count, 6 * count)


def slip_matrix(rods: Rods, rows: list[Touch]) -> Array:
    """(3R, 6F): displacement of the partner's surface over the owner's by those of the rods."""
    found = np.zeros((len(rows), 3, len(rods.center), 6))
    for r, row in enumerate(rows):
        for rod, arc, sign in ((row.i, row.arc_i, -1.0), (row.j, row.arc_j, 1.0)):
            if rod == WALL:
                continue
            lever = arc * rods.axis[rod] - sign * rods.radius * row.normal
            found[r, :, rod, :3] += sign * np.eye(3)
            found[r, :, rod, 3:] -= sign * cross_matrix(lever)
    return found.reshape(3 * len(rows), 6 * len(rods.center))


def free_slip(rods: Rods, carried: Rods, spin: Array, row: Touch, offset: Array) -> Array:
    """Slip of a row in a step without contact; `offset`: motion of the image, or of the wall.

    Rods go from `rods` to `carried` and turn about their axes by the angles `spin` (F,).
    """
    total = np.array(offset, float)
    for rod, arc, sign in ((row.i, row.arc_i, -1.0), (row.j, row.arc_j, 1.0)):
        if rod == WALL:
            continue
        p, change = rods.axis[rod], carried.axis[rod] - rods.axis[rod]
        turn = np.cross(p, change) + spin[rod] * p
        moved = carried.center[rod] - rods.center[rod] + arc * change
        total += sign * (moved - np.cross(turn, sign * rods.radius * row.normal))
    return total


def solve_friction(rods: Rods, rows: list[Touch], h: float, sweeps: int = 20000) -> Rubbed:
    """Forces and motion, to 1e-13 of a length."""
    slips = slip_matrix(rods, rows)
    response = mobility(rods, h) @ slips.T
    delassus = (slips @ response).reshape(len(rows), 3, len(rows), 3)
    total = np.zeros((len(rows), 3))  # force on the partner
    free = np.array([row.slip for row in rows])
    for _ in range(sweeps):
        worst = 0.0
        for r, row in enumerate(rows):
            n, own = row.normal, delassus[r, :, r, :]
            press = total[r] @ n
            flat = total[r] - press * n
            gap = row.base + n @ np.tensordot(delassus[r], total, 2)
            new = max(0.0, press - gap / (n @ own @ n))
            total[r] = new * n + flat
            slip = free[r] + np.tensordot(delassus[r], total, 2)
            slip = slip - (slip @ n) * n
            soft = float(np.linalg.eigvalsh(own).max())
            wanted = flat - slip / soft
            size, limit = np.linalg.norm(wanted), row.friction * new
            if size > limit:
                wanted = wanted * (limit / size)
            total[r] = new * n + wanted
            worst = max(worst, soft * abs(new - press), soft * np.abs(wanted - flat).max())
        if worst < 1e-13:
            break
    normal = np.array([row.normal for row in rows])
    press = np.einsum("ri,ri->r", total, normal)
    moved = (response @ total.ravel()).reshape(-1, 6)
    slip = free + (slips @ moved.ravel()).reshape(-1, 3)
    slip -= np.einsum("ri,ri->r", slip, normal)[:, None] * normal
    return Rubbed(press, total - press[:, None] * normal, slip, moved[:, :3], moved[:, 3:])
