"""What a bed of bonded spheres is like: contact forces, inclination, numbers and stress by node.

Contact force: mean size over contacts (pairs of segments) and over pairs of fibers, where what
several contacts do adds up as vectors; a fiber's contacts with itself are left out. Inclination:
arcsin(|e_z| / |e|) with e from end to end, of a ring the angle of its plane; shares of fibers in
bins of 10 degrees. `contact_count`: contacts by the node nearest to them, on both fibers.
`bond_stress`: largest normal stress |E e + E_b a |k|| in the bonds of a node, with the strain e and
the change of curvature k.
Source: Xu, Ma & Guo 2023, sections 3 and 5.
Limits: a patch counts once per pair of segments that share it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warpfiber.passes.measurement import fiber_pair_keys

if TYPE_CHECKING:
    from warpfiber.methods.bonded_spheres import BondedSpheres

Array = np.ndarray
BIN = 10  # degrees


def contact_forces(spheres: BondedSpheres) -> dict[str, float]:
    """Mean sizes in N; 0 without contacts."""
    row = {"contact_force_mean": 0.0, "contact_force_pair_mean": 0.0}
    if spheres.contacts is None:
        return row
    i, j, image = spheres.contacts.search.list.host_pairs()
    fiber = spheres.model.host["segment_fiber"]
    acts = (spheres.contacts.acts.numpy()[: len(i)] != 0) & (fiber[i] != fiber[j])
    if not acts.any():
        return row
    force = spheres.contacts.force.numpy()[: len(i)][acts].astype(float)
    force *= spheres.model.units.force
    keys = fiber_pair_keys(fiber[i[acts]], fiber[j[acts]], image[acts])
    pairs, which = np.unique(keys, return_inverse=True)
    total = np.zeros((len(pairs), 3))
    np.add.at(total, which, force)
    row["contact_force_mean"] = float(np.linalg.norm(force, axis=1).mean())
    row["contact_force_pair_mean"] = float(np.linalg.norm(total, axis=1).mean())
    return row


def inclinations(spheres: BondedSpheres) -> Array:
    """(F,) degrees from the horizontal."""
    nodes = spheres.place.numpy().astype(float)
    start, group = spheres.model.host["fiber_node_start"], spheres.model.host["fiber_group"]
    axis = nodes[start[1:] - 1] - nodes[start[:-1]]
    size = np.linalg.norm(axis, axis=1)
    rise = np.abs(axis[:, 2]) / np.where(size > 0.0, size, 1.0)
    closed = np.asarray([row["closed"] for row in _rows(spheres)])[group]
    for f in np.flatnonzero(closed):
        ring = nodes[start[f] : start[f + 1]]
        ring = ring - ring.mean(axis=0)
        normal = np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
        rise[f] = np.hypot(normal[0], normal[1]) / np.linalg.norm(normal)
    degrees: Array = np.degrees(np.arcsin(np.minimum(rise, 1.0)))
    return degrees


def inclination_row(spheres: BondedSpheres) -> dict[str, float]:
    """Mean in degrees, and the share of fibers in every bin."""
    degrees = inclinations(spheres)
    counts, _ = np.histogram(degrees, bins=np.arange(0, 91, BIN))
    row = {"inclination_mean": float(degrees.mean())}
    for k, count in enumerate(counts):
        row[f"inclination_{BIN * k:02d}_{BIN * (k + 1):02d}"] = float(count) / len(degrees)
    return row


def contact_counts(spheres: BondedSpheres) -> Array:
    """(N,) contacts by the node nearest to them."""
    found = np.zeros(spheres.model.node_count)
    if spheres.contacts is None:
        return found
    i, j, _ = spheres.contacts.search.list.host_pairs()
    acts = spheres.contacts.acts.numpy()[: len(i)] != 0
    arms = spheres.contacts.arms.numpy()[: len(i)][acts]
    first = spheres.model.host["segment_node"]
    end = spheres.model.host["segment_end"]
    for segment, part in ((i[acts], arms[:, 0]), (j[acts], arms[:, 1])):
        np.add.at(found, np.where(part >= 0.5, end[segment], first[segment]), 1.0)
    return found


def bond_stresses(spheres: BondedSpheres) -> Array:
    """(N,) Pa."""
    nodes = spheres.place.numpy().astype(float)
    turn = spheres.node_turn.numpy().astype(float)
    axis, rest = spheres.bond_axis.numpy().astype(float), spheres.bond_length.numpy().astype(float)
    start, group = spheres.model.host["fiber_node_start"], spheres.model.host["fiber_group"]
    length = spheres.model.units.length
    found = np.zeros(len(nodes))
    for f, row in enumerate(np.asarray(_rows(spheres), dtype=object)[group]):
        i = np.arange(start[f], start[f + 1] - (not row["closed"]))
        j = np.where(i + 1 < start[f + 1], i + 1, start[f])
        strain = np.linalg.norm(nodes[j] - nodes[i], axis=1) / rest[i] - 1.0
        bend = _bending(turn[i], turn[j], axis[i])
        curvature = bend / (rest[i] * length)
        stress = np.abs(row["axial"] * strain) + row["bending"] * row["radius"] * curvature
        np.maximum.at(found, i, stress)
        np.maximum.at(found, j, stress)
    return found


def _bending(first: Array, second: Array, axis: Array) -> Array:
    """Angle (rad) between two nodes less the twist about the bond; quaternions (x, y, z, w)."""
    v1, w1, v2, w2 = first[:, :3], first[:, 3:], second[:, :3], second[:, 3:]
    vector = w1 * v2 - w2 * v1 - np.cross(v1, v2)
    real = (first * second).sum(axis=1)
    sine = np.linalg.norm(vector, axis=1)
    angle = 2.0 * np.arctan2(sine, np.abs(real))
    turn = vector * (angle / np.where(sine > 0.0, sine, 1.0))[:, None]
    twist = (turn * axis).sum(axis=1, keepdims=True) * axis
    size: Array = np.linalg.norm(turn - twist, axis=1)
    return size


def _rows(spheres: BondedSpheres) -> list[dict[str, float]]:
    """Constants of every group: whether closed, radius (m), moduli (Pa)."""
    return [
        {
            "closed": float(group.shape.kind == "ring" and group.node_file is None),
            "radius": group.radius,
            "axial": group.axial_modulus,
            "bending": group.bending_modulus,
        }
        for group in spheres.scene.fibers
    ]


NODE_FIELDS = {"contact_count": contact_counts, "bond_stress": bond_stresses}
