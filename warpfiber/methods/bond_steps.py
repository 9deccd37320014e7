"""Largest stable steps of a straight fiber of bonded spheres, by what sets them.

Source: with M, K, C of small motions and forces that take the speed of the middle of the step, the
    step turns unstable through the eigenvalue -1: where 4 M - 2 dt C - dt^2 K is no longer
    positive, that is at the largest l = 1 / dt of (4 l^2 M - 2 l C - K) x = 0.
Limits: bent fibers and several contacts on one node lower the true limit; `dt_fraction` covers
    them.
"""

from __future__ import annotations

import math

import numpy as np

from warpfiber.laws.hertz import DASHPOT
from warpfiber.methods.bond_constants import bond_constants
from warpfiber.scene import FiberGroup, Scene

Matrix = np.ndarray
WALL_OVERLAP = 0.1  # radii, where the stiffness of a wall is taken
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
    if scene.box is not None and "wall" in scene.box.boundary:
        stiffness = 2.0 * c.wall_modulus * group.radius * math.sqrt(WALL_OVERLAP)
        resistance = DASHPOT * scene.contact.damping * math.sqrt(stiffness * c.end_mass)
        end = np.array([c.end_mass])
        steps["walls"] = stable_step(end, np.array([[resistance]]), np.array([[stiffness]]))
    return steps
