"""Rows of unilateral contact: candidates between rods, between segments, with a plane wall.

Source: closest points of two line segments; end points of one against the line of the other, which
    for parallel rods are the ends of the overlap and block the turning about a single point.
Symbols: n unit normal from i to j; gap g = d - 2a; s_i, s_j arc positions from the middles of the
    two lines; H half lengths; w = J U + w_0 normal relative velocity, w_0 that of the periodic
    image; c coefficient of a lubrication row, w + f/c = 0 (0 for a contact row).
Limits: one radius. Lines that cross exactly take the normal p_i x p_j.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from .rigid_rod import Rods, bead_positions
from .segments import closest_points

Array = np.ndarray
WALL = -1  # partner of a row with a plane wall
SAME_ARC = 1.0  # rows nearer than this many radii along both lines count once
PARALLEL = 1e-9  # 1 - (p_i.p_j)^2 below this has no unique closest points


class Row(NamedTuple):
    """One row: f pushes j along n and i against it."""

    i: int
    j: int
    arc_i: float
    arc_j: float
    normal: Array
    gap: float
    drift: float = 0.0  # w_0
    coefficient: float = 0.0  # c


class Line(NamedTuple):
    """Center line of a rod or segment."""

    middle: Array
    axis: Array
    half: float


def clip(value: float, half: float) -> float:
    """value inside [-half, half]."""
    return min(max(value, -half), half)


def closest_arcs(a: Line, b: Line) -> tuple[float, float]:
    """Arc positions of the closest points; parallel lines take the middle of the first."""
    if 1.0 - float(a.axis @ b.axis) ** 2 < PARALLEL:
        return 0.0, clip(float(b.axis @ (a.middle - b.middle)), b.half)
    s, t = closest_points(
        a.middle - a.half * a.axis,
        a.middle + a.half * a.axis,
        b.middle - b.half * b.axis,
        b.middle + b.half * b.axis,
    )
    return (2.0 * s - 1.0) * a.half, (2.0 * t - 1.0) * b.half


def end_arcs(a: Line, b: Line) -> list[tuple[float, float]]:
    """The four ends, each against the nearest point of the other line."""
    rows = []
    for s in (a.half, -a.half):
        rows.append((s, clip(float(b.axis @ (a.middle + s * a.axis - b.middle)), b.half)))
    for t in (b.half, -b.half):
        rows.append((clip(float(a.axis @ (b.middle + t * b.axis - a.middle)), a.half), t))
    return rows


def line_rows(a: Line, b: Line, radius: float) -> list[tuple[float, float, Array, float]]:
    """(s_a, s_b, n, gap) of the closest-point row and of the ends that are not near it."""
    kept: list[tuple[float, float, Array, float]] = []
    for s, t in [closest_arcs(a, b), *end_arcs(a, b)]:
        if any(max(abs(s - k[0]), abs(t - k[1])) < SAME_ARC * radius for k in kept):
            continue
        apart = b.middle + t * b.axis - a.middle - s * a.axis
        distance = float(np.linalg.norm(apart))
        kept.append((s, t, unit_normal(apart, distance, a.axis, b.axis), distance - 2.0 * radius))
    return kept


def unit_normal(apart: Array, distance: float, p: Array, q: Array) -> Array:
    """apart/|apart|; where the lines cross, p x q, and any normal of p when they are parallel."""
    if distance > 1e-12:
        return apart / distance
    normal = np.cross(p, q)
    if np.linalg.norm(normal) < 1e-12:
        normal = np.cross(p, np.eye(3)[int(np.argmin(np.abs(p)))])
    return normal / np.linalg.norm(normal)


def rod_line(rods: Rods, rod: int, offset: Array | float = 0.0) -> Line:
    """Center line of a rod, moved by a box vector."""
    return Line(rods.center[rod] + offset, rods.axis[rod], float(rods.half_length[rod]))


def rod_pairs(rods: Rods, reach: float, lattice: Array | None = None) -> list[tuple]:
    """(i, j, offset) of rods whose lines may be within `reach`, every pair and image once.

    lattice (3, 3): columns are the box vectors; images of one box to each side are looked at.
    """
    turns = [(0, 0, 0)]
    if lattice is not None:
        turns = [(i, j, k) for i in (0, 1, -1) for j in (0, 1, -1) for k in (0, 1, -1)]
    pairs = []
    for i in range(len(rods.center)):
        for j in range(i, len(rods.center)):
            for turn in turns:
                if i == j and turn <= (0, 0, 0):
                    continue
                offset = np.zeros(3) if lattice is None else lattice @ np.array(turn, float)
                near = reach + rods.half_length[i] + rods.half_length[j]
                if np.linalg.norm(rods.center[j] + offset - rods.center[i]) <= near:
                    pairs.append((i, j, offset))
    return pairs


def rod_rows(
    rods: Rods,
    reach: float,
    gradient: Array | None = None,
    lattice: Array | None = None,
) -> list[Row]:
    """Contact rows of all rods with a gap below `reach`; w_0 = n.(L offset) of images."""
    a = rods.radius
    rows = []
    for i, j, offset in rod_pairs(rods, 2.0 * a + reach, lattice):
        drift = np.zeros(3) if gradient is None else gradient @ offset
        for s, t, normal, gap in line_rows(rod_line(rods, i), rod_line(rods, j, offset), a):
            if gap < reach:
                rows.append(Row(i, j, s, t, normal, gap, float(normal @ drift)))
    return rows


def wall_rows(
    rods: Rods, point: Sequence[float], inward: Sequence[float], reach: float
) -> list[Row]:
    """One row per end of a rod near a plane; `inward` points into the fluid, g = y - a."""
    m = np.asarray(inward, float) / np.linalg.norm(inward)
    rows = []
    for i, half in enumerate(rods.half_length):
        for s in (float(half), -float(half)):
            gap = float((rods.center[i] + s * rods.axis[i] - np.asarray(point)) @ m) - rods.radius
            if gap < reach:
                rows.append(Row(i, WALL, s, 0.0, -m, gap))
    return rows


def lubrication_coefficient(distance: float, radius: float, viscosity: float) -> float:
    """c = (3/2) pi eta a^2/(r - 2a) for 2.001a <= r <= 3a, else 0."""
    if not 2.001 * radius <= distance <= 3.0 * radius:
        return 0.0
    return 1.5 * math.pi * viscosity * radius**2 / (distance - 2.0 * radius)


def lubrication_rows(
    rods: Rods, gradient: Array | None = None, lattice: Array | None = None
) -> list[Row]:
    """Rows of bead pairs; no sign condition, no gap."""
    a = rods.radius
    rows = []
    for i, j, offset in rod_pairs(rods, 3.0 * a, lattice):
        drift = np.zeros(3) if gradient is None else gradient @ offset
        for s in bead_positions(rods, i):
            for t in bead_positions(rods, j):
                apart = rods.center[j] + offset + t * rods.axis[j]
                apart = apart - rods.center[i] - s * rods.axis[i]
                distance = float(np.linalg.norm(apart))
                c = lubrication_coefficient(distance, a, rods.viscosity)
                if c > 0.0:
                    n = apart / distance
                    rows.append(Row(i, j, float(s), float(t), n, 0.0, float(n @ drift), c))
    return rows


def rod_jacobian(rods: Rods, rows: Iterable[Row]) -> Array:
    """J (R, 6F) on (dx_c/dt, dp/dt) of all rods: w = n.(v_j + s_j dp_j - v_i - s_i dp_i)."""
    rows = list(rows)
    count = len(rods.center)
    jacobian = np.zeros((len(rows), 2, count, 3))
    for k, row in enumerate(rows):
        for rod, arc, sign in ((row.i, row.arc_i, -1.0), (row.j, row.arc_j, 1.0)):
            if rod != WALL:
                jacobian[k, 0, rod] += sign * row.normal
                jacobian[k, 1, rod] += sign * arc * row.normal
    return jacobian.reshape(len(rows), 6 * count)


def rod_mobility(rods: Rods) -> Array:
    """Y (6F, 6F): 1/xi for centers, (I - p p^T)/K_r for directions."""
    count = len(rods.center)
    mobility = np.zeros((2, count, 3, 2, count, 3))
    for k, p in enumerate(rods.axis):
        mobility[0, k, :, 0, k] = np.eye(3) / rods.drag[k]
        mobility[1, k, :, 1, k] = (np.eye(3) - np.outer(p, p)) / rods.turning_drag[k]
    return mobility.reshape(6 * count, 6 * count)


def rod_diagonal(rods: Rods, row: Row) -> float:
    """D = 1/xi_i + 1/xi_j + s_i^2 |q_i|^2/K_i + s_j^2 |q_j|^2/K_j, q = (I - p p^T) n."""
    total = 0.0
    for rod, arc in ((row.i, row.arc_i), (row.j, row.arc_j)):
        if rod != WALL:
            along = float(rods.axis[rod] @ row.normal)
            total += 1.0 / rods.drag[rod] + arc**2 * (1.0 - along**2) / rods.turning_drag[rod]
    return float(total)
