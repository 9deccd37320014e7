"""Forces between fibers and with walls: capsule repulsion, bead lubrication; contact measures.

Source: Sasayama & Inagaki 2018, Appendix A, with the signs and the "-1" inferred there; squeeze
    force of two spheres 6 pi eta R^2 (dv.n)/h, R = a_i a_j/(a_i + a_j), which for equal radii is
    (3/2) pi eta a^2 (dv.n)/(D - 2a).
Symbols: D distance of closest points or of beads; sigma = a_i + a_j (2a for equal radii);
    D_0, G_0 strength [N] and decay [-] of the repulsion; N_R = M - 1.
Limits: repulsion for D <= 1.0005 sigma; lubrication for 1.0005 sigma <= D <= 1.5 sigma. The energy
    is that of the force law at the contact, zero at the end of its range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .segments import SegmentPair, Segments, accepts_vertex, find_pairs, list_segments

Array = np.ndarray
CONTACT_RANGE = 1.0005  # 2.001 a for equal radii
LUBRICATION_RANGE = 1.5  # 3 a for equal radii


class System(NamedTuple):
    """Fibers and box; radius, spacing (M) and bead_mass hold one value per fiber."""

    node_pos: Array
    node_vel: Array
    fiber_node_start: Sequence[int]
    radius: Array
    spacing: Array
    bead_mass: Array
    lattice: Array | None = None
    gradient: Array | None = None  # L of the flow that moves the images
    periodic: Sequence[bool] = (True, True, True)


class Repulsion(NamedTuple):
    """Node forces (N, 3), energy, and the pairs that touch (vertex rule applied)."""

    force: Array
    energy: float
    pairs: list[SegmentPair]


class Lubrication(NamedTuple):
    """Node forces (N, 3), segment pairs with at least one bead pair in range, bead pairs."""

    force: Array
    pairs: list[SegmentPair]
    bead_pairs: int
    power: float  # sum of force times velocity; never positive


def make_system(
    node_pos: Array,
    fiber_node_start: Sequence[int],
    *,
    node_vel: Array | None = None,
    radius: Array | float = 1.0,
    spacing: Array | float = 1.0,
    bead_mass: Array | float = 1.0,
    lattice: Array | None = None,
    gradient: Array | None = None,
    periodic: Sequence[bool] = (True, True, True),
) -> System:
    """System with single numbers spread over the fibers and velocities 0 unless given."""
    fibers = len(fiber_node_start) - 1
    pos = np.asarray(node_pos, float)
    return System(
        pos,
        np.zeros_like(pos) if node_vel is None else np.asarray(node_vel, float),
        [int(k) for k in fiber_node_start],
        np.broadcast_to(np.asarray(radius, float), (fibers,)),
        np.broadcast_to(np.asarray(spacing, float), (fibers,)),
        np.broadcast_to(np.asarray(bead_mass, float), (fibers,)),
        lattice,
        gradient,
        periodic,
    )


def pairs_within(system: System, factor: float) -> list[SegmentPair]:
    """Segment pairs with D <= factor (a_i + a_j)."""
    seg = list_segments(system.fiber_node_start)
    found = find_pairs(
        system.node_pos,
        system.fiber_node_start,
        2.0 * factor * float(np.max(system.radius)),
        radius=system.radius,
        rest_length=2.0 * system.radius * system.spacing,
        lattice=system.lattice,
        periodic=system.periodic,
    )
    return [pair for pair in found if pair.distance <= factor * radius_sum(system, seg, pair)]


def radius_sum(system: System, seg: Segments, pair: SegmentPair) -> float:
    """sigma = a_i + a_j of the fibers of a pair."""
    return float(system.radius[seg.fiber[pair.i]] + system.radius[seg.fiber[pair.j]])


def repulsion_magnitude(distance: float, sigma: float, strength: float, decay: float) -> float:
    """D_0 exp[-G_0 (D/sigma - 1)] for D <= 1.0005 sigma, else 0."""
    if distance > CONTACT_RANGE * sigma:
        return 0.0
    return strength * math.exp(-decay * (distance / sigma - 1.0))


def repulsion_energy(distance: float, sigma: float, strength: float, decay: float) -> float:
    """Integral of the magnitude from D to the end of the range."""
    if distance > CONTACT_RANGE * sigma:
        return 0.0
    end = math.exp(-decay * (CONTACT_RANGE - 1.0))
    return strength * sigma / decay * (math.exp(-decay * (distance / sigma - 1.0)) - end)


def add_to_nodes(force: Array, node: int, fraction: float, value: Array) -> None:
    """Share a force at `fraction` of a segment: (1 - s) F on its first node, s F on the second."""
    force[node] += (1.0 - fraction) * value
    force[node + 1] += fraction * value


def repulsion(system: System, strength: float, decay: float) -> Repulsion:
    """Capsule repulsion of all segment pairs, one contact per local minimum."""
    seg = list_segments(system.fiber_node_start)
    force = np.zeros_like(system.node_pos)
    energy = 0.0
    touching = []
    for pair in pairs_within(system, CONTACT_RANGE):
        if not accepts_vertex(pair, system.node_pos, seg):
            continue
        touching.append(pair)
        sigma = radius_sum(system, seg, pair)
        size = repulsion_magnitude(pair.distance, sigma, strength, decay)
        on_j = size * pair.gap / pair.distance
        add_to_nodes(force, seg.node[pair.j], pair.t, on_j)
        add_to_nodes(force, seg.node[pair.i], pair.s, -on_j)
        energy += repulsion_energy(pair.distance, sigma, strength, decay)
    return Repulsion(force, energy, touching)


def segment_beads(spacing: float, last: bool) -> tuple[Array, Array]:
    """Fractions and weights of the beads that a segment owns.

    Its first node, n = max(1, round(N_R)) evenly spaced interior beads of weight N_R/n (none when
    N_R = 0) and, for the last segment of a fiber, its second node.
    """
    n_r = spacing - 1.0
    interior = max(1, math.floor(n_r + 0.5)) if n_r > 0.0 else 0
    fraction = [0.0] + [k / (interior + 1) for k in range(1, interior + 1)]
    weight = [1.0] + [n_r / interior for _ in range(interior)]
    if last:
        fraction.append(1.0)
        weight.append(1.0)
    return np.array(fraction), np.array(weight)


def lubrication_coefficient(
    distance: float, a_i: float, a_j: float, viscosity: float, kind: str
) -> float:
    """Force per approach velocity of two beads [N s/m]; 0 outside the range.

    kind `paper`: 1/h; `shifted`: 1/h - 1/h_max with h = D - sigma, h_max = sigma/2.
    """
    sigma = a_i + a_j
    if not CONTACT_RANGE * sigma <= distance <= LUBRICATION_RANGE * sigma:
        return 0.0
    inverse_gap = 1.0 / (distance - sigma)
    if kind == "shifted":
        inverse_gap -= 1.0 / ((LUBRICATION_RANGE - 1.0) * sigma)
    elif kind != "paper":
        raise ValueError(f"lubrication kind {kind!r} unknown")
    reduced = a_i * a_j / sigma
    return 6.0 * math.pi * viscosity * reduced**2 * inverse_gap


def limited_coefficient(coefficient: float, dt: float, mass_i: float, mass_j: float) -> float:
    """c/(1 + c dt (1/m_i + 1/m_j)): the pair alone, solved implicitly over one step."""
    return coefficient / (1.0 + coefficient * dt * (1.0 / mass_i + 1.0 / mass_j))


def lubrication(
    system: System, viscosity: float, kind: str = "paper", limit_dt: float | None = None
) -> Lubrication:
    """Bead lubrication of all segment pairs; `limit_dt` switches the limited coefficient on.

    The coefficient that is limited is the one that multiplies the velocity: law times both weights.
    """
    seg = list_segments(system.fiber_node_start)
    x, v = system.node_pos, system.node_vel
    force = np.zeros_like(x)
    active = []
    bead_pairs = 0
    power = 0.0
    for pair in pairs_within(system, LUBRICATION_RANGE):
        fi, fj = seg.fiber[pair.i], seg.fiber[pair.j]
        ni, nj = seg.node[pair.i], seg.node[pair.j]
        # An image moves with the flow of its lattice.
        drift = np.zeros(3) if system.gradient is None else system.gradient @ pair.offset
        found = False
        beads_i = zip(*segment_beads(system.spacing[fi], seg.last[pair.i]), strict=True)
        beads_j = list(zip(*segment_beads(system.spacing[fj], seg.last[pair.j]), strict=True))
        for s, weight_i in beads_i:
            for t, weight_j in beads_j:
                gap = (1 - t) * x[nj] + t * x[nj + 1] + pair.offset
                gap = gap - ((1 - s) * x[ni] + s * x[ni + 1])
                distance = float(np.linalg.norm(gap))
                c = lubrication_coefficient(
                    distance, system.radius[fi], system.radius[fj], viscosity, kind
                )
                if c == 0.0:
                    continue
                found = True
                bead_pairs += 1
                c *= weight_i * weight_j
                if limit_dt is not None:
                    c = limited_coefficient(c, limit_dt, system.bead_mass[fi], system.bead_mass[fj])
                normal = gap / distance
                dv = (1 - t) * v[nj] + t * v[nj + 1] + drift
                dv = dv - ((1 - s) * v[ni] + s * v[ni + 1])
                on_i = c * (dv @ normal) * normal
                add_to_nodes(force, ni, s, on_i)
                add_to_nodes(force, nj, t, -on_i)
                power -= float(on_i @ dv)
        if found:
            active.append(pair)
    return Lubrication(force, active, bead_pairs, power)


def wall_repulsion(
    node_pos: Array,
    radius: Array | float,
    point: Sequence[float],
    normal: Sequence[float],
    strength: float,
    decay: float,
) -> Array:
    """Mirror-image repulsion of nodes at distance y <= 1.0005 a from a plane; (N, 3).

    `normal` points into the fluid; radius: one number or one per node.
    """
    inward = np.asarray(normal, float) / np.linalg.norm(normal)
    a = np.broadcast_to(np.asarray(radius, float), (len(node_pos),))
    y = (node_pos - np.asarray(point, float)) @ inward
    size = np.where(y <= CONTACT_RANGE * a, strength * np.exp(-decay * (y / a - 1.0)), 0.0)
    return size[:, None] * inward


def interaction_count(
    fibers: int, repulsive: Sequence[SegmentPair], lubricated: Sequence[SegmentPair]
) -> float:
    """Mean over fibers of their interacting (own, other) segment pairs; a pair counts for both."""
    return 2.0 * (len(repulsive) + len(lubricated)) / fibers


def coordination_number(system: System, images_distinct: bool = True) -> float:
    """Mean number of distinct fibers with D <= a_i + a_j.

    images_distinct: a periodic image is another fiber, so one fiber touched through two images
    counts twice and its own image counts; else fibers are told apart by number, self excluded.
    """
    seg = list_segments(system.fiber_node_start)
    touched: set[tuple[int, int, tuple[int, ...]]] = set()
    for pair in pairs_within(system, 1.0):
        fi, fj = int(seg.fiber[pair.i]), int(seg.fiber[pair.j])
        shift = pair.shift if images_distinct else (0, 0, 0)
        if fi == fj and shift == (0, 0, 0):
            continue
        touched.add((fi, fj, shift))
        touched.add((fj, fi, tuple(-k for k in shift)))
    return len(touched) / (len(system.fiber_node_start) - 1)
