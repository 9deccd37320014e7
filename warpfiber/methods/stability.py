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
EXACT_NODES = 13  # fibers of up to so many nodes get the exact limit of their linear motion
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


def _published_closure(n: int, m: float) -> tuple[np.ndarray, ...]:
    """Inertia and drag of a straight fiber along and across it, in beads per node.

    m dv/dt = a F^ND + b F^D is the same as (m / a) dv/dt = F^ND + (b / a) F^D. Along: alpha^T and
    beta^T; across: alpha^R and beta^R. The middle node of an even number of segments lies on the
    center, and the two exchange there.
    """
    total = n * m + 1.0
    along = np.full(n + 1, (n + 1.0) / total)
    across = np.full(n + 1, m * (n + 1.0) * (n + 2.0) / (total * (total + 1.0)))
    drag_along, drag_across = np.full(n + 1, m), np.full(n + 1, m)
    drag_along[[0, -1]] = (m + 1.0) / 2.0
    drag_across[[0, -1]] = (m + 1.0) * (3.0 * m * n - 2.0 * m + 2.0) / (6.0 * m * n)
    if n % 2 == 0:
        # however little it bends, the line to the middle node then points across the fiber
        middle = n // 2
        along[middle], across[middle] = across[middle], along[middle]
        # beta^R / alpha^R of Eq. (8) for a parabola, where n_i - n_(i-1) = -24 / (n (n + 2)) N3_i
        drag_along[middle] = m - 4.0 * (m * m - 1.0) / (m * n * (n + 2.0))
    # beta = alpha times the drag of a node in beads, for both directions
    return np.diag(1.0 / along), np.diag(drag_along), np.diag(1.0 / across), np.diag(drag_across)


def _stable_limit(
    stiffness: np.ndarray, damping: np.ndarray, inertia: np.ndarray, drag: np.ndarray, mass: float
) -> float:
    """Largest stable step of M x'' = -K x - C x': exact for few nodes, else mode by mode."""
    limit = _slowest_mode_limit(stiffness, damping, inertia, drag, mass)
    if len(stiffness) > EXACT_NODES or not 0.0 < limit < math.inf:
        return limit
    return _exact_limit(stiffness, damping + drag, mass * inertia, limit)


def _exact_limit(
    stiffness: np.ndarray, damping: np.ndarray, mass: np.ndarray, near: float
) -> float:
    """Step at which the amplification matrix gets an eigenvalue beyond 1, by bisection.

    Where the damping of few nodes differs much (`paper`), the stiffness alone has other modes.
    """
    inverse = np.linalg.inv(mass)
    k, c, eye = inverse @ stiffness, inverse @ damping, np.eye(len(mass))

    def is_stable(dt: float) -> bool:
        velocity = np.hstack([-dt * k, eye - dt * c])
        position = np.hstack([eye, np.zeros_like(eye)]) + dt * velocity
        step = np.vstack([position, velocity])
        return bool(np.abs(np.linalg.eigvals(step)).max() < 1.0 + 1e-6)

    low, high = near / 16.0, 16.0 * near
    while high / low > 1.0 + 1e-4:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low


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
    if closure == "paper":
        axial_inertia, axial_drag, inertia, drag = _published_closure(n, m)
    else:
        inertia = drag = galerkin if closure == "consistent" else eye
        axial_inertia, axial_drag = inertia, drag
    still = np.zeros_like(axial)
    limits = [
        StepLimit(
            "stretching",
            _stable_limit(axial, still, axial_inertia, zeta * axial_drag, mass),
            index,
        ),
        StepLimit(
            "bending and hydrodynamic torque",
            _stable_limit(bending, torque, inertia, zeta * drag, mass),
            index,
        ),
    ]
    contact = scene.contact
    if contact.strength:  # walls push by it even without pairs
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
    """dt in s: given (or from the strain step), or `dt_fraction` of the smallest limit."""
    numerics = scene.numerics
    if numerics.dt is not None:
        return numerics.dt
    return numerics.dt_fraction * step_limits(scene)[0].dt
