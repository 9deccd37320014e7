"""Largest stable steps of a straight fiber of bonded spheres, by what sets them.

Source: with M, K, C of small motions and forces that take the speed of the middle of the step, the
    step turns unstable through the eigenvalue -1: where 4 M - 2 dt C - dt^2 K is no longer
    positive, that is at the largest l = 1 / dt of (4 l^2 M - 2 l C - K) x = 0. Contacts: Hertz of
    crossed cylinders and its tangential stiffness at an estimated overlap, nodes against nodes.
Limits: the terms are taken one by one; bent fibers, larger overlaps and more contacts on one node
    lower the true limit; `dt_fraction` covers them.
"""

from __future__ import annotations

import math

import numpy as np

from warpfiber.laws.hertz import DASHPOT
from warpfiber.methods.bond_constants import bond_constants
from warpfiber.scene import FiberGroup, Scene
from warpfiber.scene.planes import present_faces, rubs

Matrix = np.ndarray
OVERLAP = 0.1  # radii, where the stiffness of a contact is taken
CROWD = 2  # contacts with other fibers that an inner node of a dense bed has; an end has one
LONGEST_CHAIN = 16  # segments; longer fibers have the same limits


def stable_step(mass: np.ndarray, damping: Matrix, stiffness: Matrix) -> float:
    """Largest dt in s; mass (n,), matrices (n, n), symmetric."""
    n = len(mass)
    pencil = np.zeros((2 * n, 2 * n))
    pencil[:n, n:] = np.eye(n)
    pencil[n:, :n] = 0.25 * stiffness / mass[:, None]
    pencil[n:, n:] = 0.5 * damping / mass[:, None]
    return float(1.0 / np.linalg.eigvals(pencil).real.max())


def bond_steps(scene: Scene, group: FiberGroup) -> dict[str, float]:
    """Steps (s) of motions along, across and about a fiber, and of its end at a wall.

    A turn counts as t = l times the angle, so that all entries are masses and stiffnesses. Across,
    the shear of a bond is w1 - w0 - (t0 + t1) / 2 and its bending (t1 - t0) / l.
    """
    c = bond_constants(scene, group)
    n = min(group.segments, LONGEST_CHAIN)
    arm = c.segment_length**-2
    after, before = np.eye(n, n + 1, k=1), np.eye(n, n + 1)
    first, still = after - before, np.zeros((n, n + 1))
    shear = np.concatenate([first, -0.5 * (after + before)], axis=1)
    bending = np.concatenate([still, first], axis=1)
    mass = np.full(n + 1, c.mass)
    mass[[0, -1]] = c.end_mass
    turning = np.full(n + 1, c.inertia * arm)
    turning[[0, -1]] = c.end_inertia * arm

    def limit(inertia: np.ndarray, *parts: tuple[int, float, Matrix]) -> float:
        stiffness = sum(c.stiffness[k] * factor * strain.T @ strain for k, factor, strain in parts)
        damping = sum(c.dashpots[k] * factor * strain.T @ strain for k, factor, strain in parts)
        return stable_step(inertia, np.asarray(damping), np.asarray(stiffness))

    steps = {
        "bond stretching": limit(mass, (0, 1.0, first)),
        "bond shear and bending": limit(
            np.concatenate([mass, turning]), (1, 1.0, shear), (2, arm, bending)
        ),
        "bond twist": limit(turning, (3, arm, first)),
    }
    contact = scene.contact
    end, inner = (c.end_mass, c.end_inertia), (c.mass, c.inertia)
    if present_faces(scene):
        stiffness = 2.0 * c.wall_modulus * group.radius * math.sqrt(OVERLAP)
        steps["walls"] = touch_step(scene, group, end, stiffness, float(rubs(scene)))
    if contact.law != "none":
        # against a fiber of its own kind half the modulus; what it touches moves against it
        stiffness = 2.0 * c.wall_modulus * group.radius * math.sqrt(OVERLAP)
        touched = [touch_step(scene, group, end, stiffness, contact.friction)]
        if n > 1:
            touched.append(touch_step(scene, group, inner, CROWD * stiffness, contact.friction))
        steps["contacts"] = min(touched)
    return steps


def touch_step(
    scene: Scene,
    group: FiberGroup,
    node: tuple[float, float],
    stiffness: float,
    friction: float,
) -> float:
    """Of a node (mass, moment of inertia) that is held with this normal stiffness.

    With friction also its rolling under the tangential stiffness: slip = v + a w.
    """
    c = bond_constants(scene, group)
    moved = np.array([node[0], node[1] / group.radius**2])
    ratio = 4.0 * c.compliance / c.shear_compliance
    steps = []
    for held, k in ((np.diag([1.0, 0.0]), stiffness), (np.ones((2, 2)), ratio * stiffness)):
        resistance = DASHPOT * scene.contact.damping * math.sqrt(k * node[0])
        steps.append(stable_step(moved, resistance * held, k * held))
    return min(steps) if friction > 0.0 else steps[0]
