"""Largest step of the explicit methods, term by term, and the step that a scene takes.

Source: the step m* (v1 - v0) = dt (-K x - C v0 - Z v0), x1 = x0 + dt v1 with the drag Z inside m* =
    max(m + dt Z / 2, dt Z) (laws/drag.py) turns unstable through the eigenvalue -1, that is where
    4 max(m, dt Z / 2) - 2 dt C - dt^2 K is no longer positive. The modes are those of a straight
    fiber: axial (stretching against the closure's inertia and drag) and transverse (bending,
    hydrodynamic torque C). Contact: two touching beads with the stiffness of the repulsion at an
    overlap of 0.1 a. Lubrication, where it is not limited: C of two beads at the inner end of its
    range, h = 0.001 a. Flow: accuracy, not stability; a strain of 0.02.
    A matrix is positive where all pivots of its elimination are (Sylvester 1852), and no node acts
    beyond the next but one: a test of one dt takes as many operations as there are nodes.
Symbols: all SI, per bead; matrices per node of a fiber, by their diagonals: row d of `Bands`
    couples node i with i + d.
Limits: bent fibers and several contacts on one bead lower the true limit; `dt_fraction` covers
    them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from warpfiber.laws.closure import galerkin_entries
from warpfiber.methods.bond_steps import bond_steps
from warpfiber.methods.strain_steps import LARGEST_STRAIN, largest_step, strain_step
from warpfiber.scene import FiberGroup, Scene
from warpfiber.scene.derived import INERTIALESS

Bands = np.ndarray  # (3, nodes), symmetric
CONTACT_OVERLAP = 0.1  # radii, where the stiffness of the exponential repulsion is taken
LUBRICATION_GAP = 0.001  # radii, inner end of the lubrication range
FLOW_STRAIN = 0.02  # largest strain of a step


@dataclass(frozen=True)
class StepLimit:
    """One term's largest step in s."""

    term: str
    dt: float
    group: int
    kind: str = "stable"
    """what a step up to it is: `stable`, or `accurate` where the flow decides"""


def stable_limit(stiffness: Bands, damping: Bands, mass: Bands, drag: Bands) -> float:
    """Largest stable step in s, by bisection; inf without a limit."""

    def is_stable(dt: float) -> bool:
        rest = 4.0 * np.maximum(mass, 0.5 * dt * drag) - 2.0 * dt * damping - dt * dt * stiffness
        return _is_positive(rest)

    low, high = 1e-30, 1e30
    if is_stable(high):
        return math.inf
    while high / low > 1.0 + 1e-6:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low


def _is_positive(matrix: Bands) -> bool:
    """Whether all eigenvalues are positive."""
    off = here = after = 0.0  # what the eliminated nodes take from the entries ahead
    for diagonal, next_one, next_but_one in zip(*matrix.tolist(), strict=True):
        pivot = diagonal - here
        if not pivot > 0.0:
            return False
        couple = next_one - off
        off = couple * next_but_one / pivot
        here = after + couple * couple / pivot
        after = next_but_one * next_but_one / pivot
    return True


def _bead_limit(stiffness: float, damping: float, mass: float, drag: float) -> float:
    """The same for one bead, all in SI."""
    return stable_limit(*(_diagonal(np.array([v])) for v in (stiffness, damping, mass, drag)))


def _diagonal(values: np.ndarray) -> Bands:
    return np.stack([values, np.zeros_like(values), np.zeros_like(values)])


def _gram(row: tuple[float, ...], weight: np.ndarray) -> Bands:
    """Sum of weight[k] r_k r_k^T, where r_k is this row of numbers from node k on."""
    bands = np.zeros((3, len(weight) + len(row) - 1))
    for i, x in enumerate(row):
        for d, y in enumerate(row[i:]):
            bands[d, i : i + len(weight)] += weight * x * y
    return bands


def _matrices(group: FiberGroup, eta: float, weights: str) -> tuple[Bands, ...]:
    """Axial and transverse stiffness, torque damping and Galerkin matrix of a straight fiber."""
    n, a, m = group.segments, group.radius, group.bead_spacing
    rest = 2.0 * a * m
    k_s = math.pi * a * group.axial_modulus / (2.0 * m)
    k_b = math.pi * a**3 * group.bending_modulus / (8.0 * m)
    weight = np.full(n, m)
    if weights == "end_weighted":
        weight[0] += 0.5
        weight[-1] += 0.5
    axial = _gram((-1.0, 1.0), np.full(n, k_s))
    bending = _gram((1.0, -2.0, 1.0), np.full(n - 1, k_b / rest**2))
    torque = _gram((-1.0, 1.0), 8.0 * math.pi * eta * a**3 * weight / rest**2)
    end, inner, off = galerkin_entries(m)
    galerkin = _diagonal(np.full(n + 1, inner))
    galerkin[0, [0, -1]] = end
    galerkin[1, :-1] = off
    return axial, bending, torque, galerkin


def _published_closure(n: int, m: float) -> tuple[Bands, ...]:
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
    both = (1.0 / along, drag_along), (1.0 / across, drag_across)
    return tuple(_diagonal(values) for pair in both for values in pair)


def _group_limits(scene: Scene, index: int) -> list[StepLimit]:
    group = scene.fibers[index]
    if scene.numerics.method == "bonded_spheres":
        return [StepLimit(term, dt, index) for term, dt in bond_steps(scene, group).items()]
    eta = scene.flow.viscosity if scene.flow else 0.0
    a, m = group.radius, group.bead_spacing
    mass = 4.0 / 3.0 * math.pi * a**3 * (group.density or 0.0)
    zeta = 6.0 * math.pi * eta * a
    axial, bending, torque, galerkin = _matrices(group, eta, scene.numerics.torque_weights)
    n = group.segments
    closure = scene.numerics.closure
    if closure == "paper":
        axial_inertia, axial_drag, inertia, drag = _published_closure(n, m)
    else:
        inertia = drag = galerkin if closure == "consistent" else _diagonal(np.ones(n + 1))
        axial_inertia, axial_drag = inertia, drag
    still = np.zeros_like(axial)
    limits = [
        StepLimit(
            "stretching",
            stable_limit(axial, still, mass * axial_inertia, zeta * axial_drag),
            index,
        ),
        StepLimit(
            "bending and hydrodynamic torque",
            stable_limit(bending, torque, mass * inertia, zeta * drag),
            index,
        ),
    ]
    if scene.flow and scene.flow.velocity_gradient:
        factors = [abs(factor) for _, factor in scene.flow.schedule or ((0.0, 1.0),)]
        rate = np.abs(scene.flow.velocity_gradient).max() * max(factors)
        if rate > 0.0:
            limits.append(StepLimit("flow", FLOW_STRAIN / rate, index, "accurate"))
    contact = scene.contact
    if contact.strength:  # walls push by it even without pairs
        steepness = contact.decay / (2.0 * a)
        stiffness = contact.strength * steepness * math.exp(contact.decay * CONTACT_OVERLAP / 2.0)
        limits.append(StepLimit("contact", _bead_limit(2.0 * stiffness, 0.0, mass, zeta), index))
    if contact.lubrication != "none" and scene.numerics.lubrication_step == "explicit":
        resistance = 1.5 * math.pi * eta * a**2 / (LUBRICATION_GAP * a)
        limits.append(
            StepLimit("lubrication", _bead_limit(0.0, 2.0 * resistance, mass, zeta), index)
        )
    return limits


@lru_cache(maxsize=4)
def step_limits(scene: Scene) -> tuple[StepLimit, ...]:
    """All limits of all groups, smallest first.

    `overdamped` has none but the strain of a step, `rigid_rod` none at all where nothing touches.
    """
    meets = scene.contact.law != "none" or scene.contact.lubrication != "none"
    if scene.numerics.method == "rigid_rod" and meets:
        term = f"contact: a strain of {LARGEST_STRAIN}"
        return (StepLimit(term, largest_step(scene), 0, "accurate"),)
    if scene.numerics.method == "rigid_rod":
        return (StepLimit("none: maps of the flow are exact", math.inf, 0, "accurate"),)
    if scene.numerics.method == "overdamped":
        dt = largest_step(scene)
        return (StepLimit(f"accuracy: a strain of {LARGEST_STRAIN}", dt, 0, "accurate"),)
    limits = [limit for i in range(len(scene.fibers)) for limit in _group_limits(scene, i)]
    return tuple(sorted(limits, key=lambda limit: limit.dt))


def chosen_step(scene: Scene) -> float:
    """dt in s: given (or from the strain step), or `dt_fraction` of the smallest limit."""
    numerics = scene.numerics
    if numerics.method in INERTIALESS:
        return strain_step(scene)
    if numerics.dt is not None:
        return numerics.dt
    return numerics.dt_fraction * step_limits(scene)[0].dt
