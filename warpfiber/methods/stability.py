"""Largest stable step of the explicit bead chain, term by term.

Source: semi-implicit Euler (velocity first) of x'' = -w^2 x - c v is stable iff w^2 dt^2 + 2 c dt <
    4. The modes are those of a straight fiber: axial (stretching against the closure's inertia and
    drag) and transverse (bending, hydrodynamic torque). Contact: two touching beads with the
    stiffness of the repulsion at an overlap of 0.1 a. Lubrication, where it is not limited: 2 m /
    (2 c + zeta) at the inner end of its range, h = 0.001 a.
Symbols: all SI; w^2 and c are per unit mass of a bead.
Limits: bent fibers and several contacts on one bead lower the true limit; `dt_fraction` covers
    them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpfiber.laws.closure import galerkin_entries
from warpfiber.scene import FiberGroup, Scene

CONTACT_OVERLAP = 0.1  # radii, where the stiffness of the exponential repulsion is taken
LUBRICATION_GAP = 0.001  # radii, inner end of the lubrication range


@dataclass(frozen=True)
class StepLimit:
    """One term's largest stable step in s."""

    term: str
    dt: float
    group: int


def oscillator_limit(w2: float, c: float) -> float:
    """Largest stable dt of one mode; inf for a mode without stiffness and damping."""
    if w2 > 1e-300:
        # the conjugate form has no cancellation when damping dominates
        return 4.0 / (c + math.sqrt(c * c + 4.0 * w2))
    return 2.0 / c if c > 0.0 else math.inf


def _matrices(group: FiberGroup, eta: float, weights: str) -> tuple[np.ndarray, ...]:
    """Axial and transverse stiffness, torque damping and Galerkin matrix of a straight fiber."""
    n, a, m = group.segments, group.radius, group.bead_spacing
    rest = 2.0 * a * m
    k_s = math.pi * a * group.axial_modulus / (2.0 * m)
    k_b = math.pi * a**3 * group.bending_modulus / (8.0 * m)
    first = np.diff(np.eye(n + 1), axis=0)
    weight = np.full(n, m)
    if weights == "end_weighted":
        weight[0] += 0.5
        weight[-1] += 0.5
    axial = k_s * first.T @ first
    second = np.diff(np.eye(n + 1), n=2, axis=0) if n > 1 else np.zeros((0, n + 1))
    bending = k_b / rest**2 * second.T @ second
    torque = first.T @ np.diag(8.0 * math.pi * eta * a**3 * weight / rest**2) @ first
    end, inner, off = galerkin_entries(m)
    galerkin = np.diag(np.full(n + 1, inner))
    galerkin[0, 0] = galerkin[-1, -1] = end
    galerkin += off * (np.eye(n + 1, k=1) + np.eye(n + 1, k=-1))
    return axial, bending, torque, galerkin


def _slowest_mode_limit(
    stiffness: np.ndarray, damping: np.ndarray, inertia: np.ndarray, drag: np.ndarray, mass: float
) -> float:
    """Smallest limit over the modes of `stiffness` against `inertia`, with damping and drag."""
    root = np.linalg.cholesky(inertia)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ stiffness @ inverse.T)
    modes = inverse.T @ vectors
    limit = math.inf
    for w2, mode in zip(values, modes.T, strict=True):
        c = mode @ (damping + drag) @ mode
        limit = min(limit, oscillator_limit(max(float(w2), 0.0) / mass, float(c) / mass))
    return limit


def _group_limits(scene: Scene, index: int) -> list[StepLimit]:
    group = scene.fibers[index]
    eta = scene.flow.viscosity if scene.flow else 0.0
    a, m = group.radius, group.bead_spacing
    mass = 4.0 / 3.0 * math.pi * a**3 * group.density
    zeta = 6.0 * math.pi * eta * a
    axial, bending, torque, galerkin = _matrices(group, eta, scene.numerics.torque_weights)
    n = group.segments
    eye = np.eye(n + 1)
    closure = scene.numerics.closure
    if closure == "consistent":
        inertia, drag, along, across = galerkin, zeta * galerkin, 1.0, 1.0
    elif closure == "none":
        inertia, drag, along, across = eye, zeta * eye, 1.0, 1.0
    else:
        total = n * m + 1.0
        along = (n + 1.0) / total
        across = m * (n + 1.0) * (n + 2.0) / (total * (total + 1.0))
        beta = np.full(n + 1, m)
        beta[0] = beta[-1] = (m + 1.0) / 2.0
        inertia, drag = eye, zeta * along * np.diag(beta)
    limits = [
        StepLimit(
            "stretching",
            _slowest_mode_limit(along * axial, np.zeros_like(axial), inertia, drag, mass),
            index,
        ),
        StepLimit(
            "bending and hydrodynamic torque",
            _slowest_mode_limit(across * bending, across * torque, inertia, drag, mass),
            index,
        ),
    ]
    contact = scene.contact
    if contact.law == "exponential":
        steepness = contact.decay / (2.0 * a)
        stiffness = contact.strength * steepness * math.exp(contact.decay * CONTACT_OVERLAP / 2.0)
        limits.append(
            StepLimit("contact", oscillator_limit(2.0 * stiffness / mass, zeta / mass), index)
        )
    if contact.lubrication != "none" and scene.numerics.lubrication_step == "explicit":
        resistance = 1.5 * math.pi * eta * a**2 / (LUBRICATION_GAP * a)
        limits.append(StepLimit("lubrication", 2.0 * mass / (2.0 * resistance + zeta), index))
    return limits


def step_limits(scene: Scene) -> list[StepLimit]:
    """All limits of all groups, smallest first."""
    limits = [limit for i in range(len(scene.fibers)) for limit in _group_limits(scene, i)]
    return sorted(limits, key=lambda limit: limit.dt)


def chosen_step(scene: Scene) -> float:
    """dt in s: given, from the strain step, or `dt_fraction` of the smallest limit."""
    numerics = scene.numerics
    if numerics.dt is not None:
        return numerics.dt
    if numerics.strain_step is not None and scene.flow is not None and scene.flow.rate > 0.0:
        return numerics.strain_step / scene.flow.rate
    return numerics.dt_fraction * step_limits(scene)[0].dt
