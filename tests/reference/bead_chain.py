"""One fiber of the reduced bead chain: forces, closures, energies, explicit time steppers.

Source: Sasayama & Inagaki 2018, Eqs. (1)-(16) (closure `paper`); Galerkin projection of the
    unreduced chain on hat functions (closure `consistent`); stretching, bending and torque forces
    from E = k_s (d - l)^2 / 2, k_b theta^2 / 2 and the couple of 8 pi eta a^3 per bead.
Symbols: a bead radius; N_seg segments, nodes i = 0..N_seg; M = N_R + 1 segment length in
    diameters (real); l = 2 a M rest length; r_f = N_tot = N_seg M + 1 beads of the unreduced
    fiber; m, zeta mass and drag coefficient of one bead; n_p, d_p direction and length of segment
    p; G mean of the nodes, r^G = r - G; w_p beads whose torque segment p carries.
    A = sum_k w w^T over unreduced beads, w the hat functions.
Limits: uniform velocity gradient u = L x; open fibers, no rings; straight rest shape.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

Array = np.ndarray
CLOSURES = ("none", "paper", "consistent")
TORQUES = ("end_weighted", "plain")


@dataclass(frozen=True)
class Chain:
    """Constants of one fiber; `modulus` is used for both stiffnesses unless one is given."""

    segments: int
    spacing: float  # M, segment length in diameters, >= 1
    radius: float = 1.0
    viscosity: float = 1.0
    density: float = 0.1
    modulus: float = 1.0
    axial_modulus: float | None = None
    bending_modulus: float | None = None
    closure: str = "consistent"
    torque: str = "end_weighted"
    fluid_density: float = 0.0
    matrix: Array = field(init=False, repr=False, compare=False)
    inverse: Array = field(init=False, repr=False, compare=False)
    weights: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.closure not in CLOSURES or self.torque not in TORQUES:
            raise ValueError(f"closure {self.closure!r} or torque {self.torque!r} unknown")
        matrix = mass_matrix(self.segments, self.spacing)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "inverse", np.linalg.inv(matrix))
        weights = np.full(self.segments, float(self.spacing))
        if self.torque == "end_weighted":
            weights[0] += 0.5
            weights[-1] += 0.5
        object.__setattr__(self, "weights", weights)

    @property
    def reduced_beads(self) -> float:
        """N_R = M - 1, beads left out of a segment."""
        return self.spacing - 1.0

    @property
    def bead_count(self) -> float:
        """N_tot = r_f, beads of the unreduced fiber."""
        return self.segments * self.spacing + 1.0

    @property
    def rest_length(self) -> float:
        """l = 2 a M."""
        return 2.0 * self.radius * self.spacing

    @property
    def length(self) -> float:
        """Distance of the end nodes of the straight fiber, 2 a (r_f - 1)."""
        return self.segments * self.rest_length

    @property
    def mass(self) -> float:
        """Mass of one bead."""
        return 4.0 / 3.0 * np.pi * self.radius**3 * self.density

    @property
    def drag(self) -> float:
        """zeta = 6 pi eta a of one bead."""
        return 6.0 * np.pi * self.viscosity * self.radius

    @property
    def stretching_stiffness(self) -> float:
        """k_s = E A / l = pi a E / (2 M)."""
        modulus = self.modulus if self.axial_modulus is None else self.axial_modulus
        return np.pi * self.radius * modulus / (2.0 * self.spacing)

    @property
    def bending_stiffness(self) -> float:
        """k_b = E I / l = pi a^3 E / (8 M)."""
        modulus = self.modulus if self.bending_modulus is None else self.bending_modulus
        return np.pi * self.radius**3 * modulus / (8.0 * self.spacing)


def mass_matrix(segments: int, spacing: float) -> Array:
    """A (n, n): e at the ends, 2e - 1 inside, (M^2 - 1)/(6 M) beside the diagonal."""
    m = float(spacing)
    end = (m + 1.0) * (2.0 * m + 1.0) / (6.0 * m)
    count = segments + 1
    matrix = np.zeros((count, count))
    np.fill_diagonal(matrix, 2.0 * end - 1.0)
    matrix[0, 0] = matrix[-1, -1] = end
    for i in range(segments):
        matrix[i, i + 1] = matrix[i + 1, i] = (m * m - 1.0) / (6.0 * m)
    return matrix


def bead_weights(segments: int, spacing: int) -> Array:
    """Hat functions w (N_tot, n) of the unreduced beads; integer M only."""
    rows = []
    for p in range(segments):
        for k in range(spacing):
            row = np.zeros(segments + 1)
            row[p] = 1.0 - k / spacing
            row[p + 1] += k / spacing
            rows.append(row)
    last = np.zeros(segments + 1)
    last[-1] = 1.0
    return np.array([*rows, last])


def straight_nodes(chain: Chain, direction: Sequence[float], center: Sequence[float]) -> Array:
    """Node positions (n, 3) of the unloaded fiber with its middle at `center`."""
    axis = np.asarray(direction, float)
    axis = axis / np.linalg.norm(axis)
    along = (np.arange(chain.segments + 1) - chain.segments / 2.0) * chain.rest_length
    return np.asarray(center, float) + along[:, None] * axis


def arc_nodes(chain: Chain, angle: float) -> Array:
    """Nodes (n, 3) in the x-z plane, segments unstretched, end tangents `angle` apart."""
    turn = angle / chain.segments
    heading = (np.arange(chain.segments) - (chain.segments - 1) / 2.0) * turn
    steps = chain.rest_length * np.stack(
        [np.cos(heading), np.zeros(chain.segments), np.sin(heading)], axis=1
    )
    nodes = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return nodes - nodes.mean(axis=0)


def walk_nodes(chain: Chain, rng: np.random.Generator, spread: float = 0.5) -> Array:
    """Bent nodes (n, 3): segments unstretched, directions a random walk of step `spread`."""
    heading = np.array([1.0, 0.0, 0.0]) + spread * rng.normal(size=(chain.segments, 3)).cumsum(0)
    heading /= np.linalg.norm(heading, axis=1)[:, None]
    return np.concatenate([np.zeros((1, 3)), (chain.rest_length * heading).cumsum(0)])


def shear_gradient(rate: float) -> Array:
    """L of u = (rate z, 0, 0)."""
    gradient = np.zeros((3, 3))
    gradient[0, 2] = rate
    return gradient


def dot(a: Array, b: Array) -> Array:
    """Row-wise scalar product (n,)."""
    return np.einsum("ij,ij->i", a, b)


def segment_geometry(node_pos: Array) -> tuple[Array, Array]:
    """Unit directions (N_seg, 3) and lengths (N_seg,)."""
    span = node_pos[1:] - node_pos[:-1]
    length = np.sqrt(dot(span, span))
    return span / length[:, None], length


def joint_angles(node_pos: Array) -> Array:
    """theta (N_seg - 1,) between neighboring segments."""
    axis, _ = segment_geometry(node_pos)
    cosine = dot(axis[:-1], axis[1:])
    rest = axis[:-1] - cosine[:, None] * axis[1:]
    return np.arctan2(np.sqrt(dot(rest, rest)), cosine)


def stretching_force(chain: Chain, axis: Array, length: Array) -> Array:
    """k_s (d - l) n on node p, the opposite on node p + 1; (n, 3)."""
    tension = (chain.stretching_stiffness * (length - chain.rest_length))[:, None] * axis
    force = np.zeros((chain.segments + 1, 3))
    force[:-1] += tension
    force[1:] -= tension
    return force


def bending_force(chain: Chain, axis: Array, length: Array) -> Array:
    """-grad(k_b theta^2 / 2) of every joint; (n, 3)."""
    force = np.zeros((chain.segments + 1, 3))
    if chain.segments < 2:
        return force
    before, after = axis[:-1], axis[1:]
    cosine = dot(before, after)[:, None]
    # The part of `before` across `after` has the length sin(theta).
    across_after = before - cosine * after
    across_before = after - cosine * before
    sine = np.sqrt(dot(across_after, across_after))[:, None]
    theta = np.arctan2(sine, cosine)
    # np.sinc(x) = sin(pi x)/(pi x), so the limit theta/sin(theta) -> 1 is taken exactly.
    factor = chain.bending_stiffness / np.sinc(theta / np.pi)
    on_next = factor * across_after / length[1:, None]
    on_previous = -factor * across_before / length[:-1, None]
    force[2:] += on_next
    force[:-2] += on_previous
    force[1:-1] -= on_next + on_previous
    return force


def torque_force(
    chain: Chain, axis: Array, length: Array, node_vel: Array, gradient: Array
) -> Array:
    """Hydrodynamic torque as a couple on the two nodes of each segment; (n, 3).

    T x n with T = 8 pi eta a^3 w (Omega - n x dv / d): Omega x n is the antisymmetric part of L
    applied to n, (n x dv) x n is the part of dv across n.
    """
    spin = 0.5 * (gradient - gradient.T)
    dv = node_vel[1:] - node_vel[:-1]
    across = dv - dot(dv, axis)[:, None] * axis
    strength = 8.0 * np.pi * chain.viscosity * chain.radius**3 * chain.weights / length
    couple = strength[:, None] * (axis @ spin.T - across / length[:, None])
    force = np.zeros((chain.segments + 1, 3))
    force[1:] += couple
    force[:-1] -= couple
    return force


def drag_force(chain: Chain, node_pos: Array, node_vel: Array, gradient: Array) -> Array:
    """6 pi eta a (u - v) of one bead at every node; (n, 3)."""
    return chain.drag * (node_pos @ gradient.T - node_vel)


def gravity_force(chain: Chain, gravity: Sequence[float]) -> Array:
    """Weight minus buoyancy of one bead, (3,)."""
    volume = 4.0 / 3.0 * np.pi * chain.radius**3
    return volume * (chain.density - chain.fluid_density) * np.asarray(gravity, float)


def nodal_force(
    chain: Chain, node_pos: Array, node_vel: Array, gradient: Array, extra: Array | None = None
) -> Array:
    """F^ND = F^S + F^b + F^ht + F^P, all forces that act at nodes only; (n, 3)."""
    axis, length = segment_geometry(node_pos)
    force = stretching_force(chain, axis, length)
    force += bending_force(chain, axis, length)
    force += torque_force(chain, axis, length, node_vel, gradient)
    return force if extra is None else force + extra


@dataclass(frozen=True)
class PaperFactors:
    """Correction factors of Sasayama & Inagaki 2018, Eqs. (5)-(16)."""

    alpha_t: float
    alpha_r: float
    beta_t: Array  # (n,)
    beta_r: Array  # (n,)


def paper_factors(chain: Chain, node_pos: Array) -> PaperFactors:
    """alpha^T, alpha^R, beta^T (n,), beta^R (n,) of a shape."""
    n_seg, m, n_r, a = chain.segments, chain.spacing, chain.reduced_beads, chain.radius
    n_tot = chain.bead_count
    alpha_t = (n_seg + 1) / n_tot
    beta_t = np.full(n_seg + 1, m * (n_seg + 1) / n_tot)
    beta_t[0] = beta_t[-1] = (m + 1) * (n_seg + 1) / (2 * n_tot)

    axis, _ = segment_geometry(node_pos)
    arm = node_pos - node_pos.mean(axis=0)
    arm2 = dot(arm, arm)
    unreduced = (
        3 * arm2[-1]
        + 3 * m * np.sum(arm2[:-1] + 2 * a * n_r * dot(arm[:-1], axis))
        + 2 * a * a * n_seg * n_r * m * (2 * n_r + 1)
    )
    alpha_r = float(3 * arm2.sum() / unreduced)

    p = np.arange(1, n_seg + 1)
    n0 = np.concatenate([np.zeros((1, 3)), np.cumsum(axis, axis=0)])
    n1 = (n_seg - p + 1) @ axis
    n2 = p @ axis
    n3 = (n0 - n1 / (n_seg + 1))[1:-1]
    beta_r = np.empty(n_seg + 1)
    end = alpha_r * (n_r + 2) * (n_seg + 1) / (6 * m)
    for node, lever, tip in ((0, n1, axis[0]), (n_seg, n2, axis[-1])):
        beta_r[node] = end * ((3 * m / (n_seg + 1)) * lever - n_r * tip) @ lever / (lever @ lever)
    square = dot(n3, n3)
    on_center = square == 0.0
    number = dot(6 * m * m * n3 + n_r * (n_r + 2) * (axis[1:] - axis[:-1]), n3)
    ratio = number / np.where(on_center, 1.0, square)
    beta_r[1:-1] = alpha_r * np.where(on_center, m, ratio / (6 * m))
    return PaperFactors(alpha_t, alpha_r, beta_t, beta_r)


def correct(force: Array, radial: Array, along: Array | float, across: Array | float) -> Array:
    """Scale the part along r^G by `along`, the rest by `across`; (n, 3)."""
    part = dot(force, radial)[:, None] * radial
    along_column = np.reshape(along, (-1, 1))
    across_column = np.reshape(across, (-1, 1))
    return along_column * part + across_column * (force - part)


def damping_share(chain: Chain, dt: float, beta: Array | float) -> Array:
    """m / m*, the share of an explicit change of velocity that is left with the drag in the step.

    m* = m + beta zeta dt / 2 (drag at the middle of the step) up to beta zeta dt = 2 m, from there
    beta zeta dt; m for a negative beta.
    """
    gain = chain.drag * dt / chain.mass * np.maximum(beta, 0.0)
    return 1.0 / np.where(gain < 2.0, 1.0 + 0.5 * gain, gain)


def acceleration(
    chain: Chain,
    node_pos: Array,
    node_vel: Array,
    gradient: Array,
    extra: Array | None = None,
    gravity: Sequence[float] | None = None,
    dt: float = 0.0,
) -> Array:
    """dv/dt (n, 3); `extra` F^P (n, 3) acts at nodes, `gravity` (3,) on every bead.

    With `dt` the mean over a step that takes the drag implicitly.
    """
    distributed = drag_force(chain, node_pos, node_vel, gradient)
    if gravity is not None:
        distributed = distributed + gravity_force(chain, gravity)
    nodal = nodal_force(chain, node_pos, node_vel, gradient, extra)
    if chain.closure == "none":
        total = damping_share(chain, dt, 1.0) * (distributed + nodal)
    elif chain.closure == "consistent":
        total = damping_share(chain, dt, 1.0) * (distributed + chain.inverse @ nodal)
    else:
        factors = paper_factors(chain, node_pos)
        arm = node_pos - node_pos.mean(axis=0)
        reach = np.sqrt(dot(arm, arm))[:, None]
        radial = arm / np.where(reach == 0.0, 1.0, reach)
        along = damping_share(chain, dt, factors.beta_t)
        across = damping_share(chain, dt, factors.beta_r)
        total = correct(nodal, radial, along * factors.alpha_t, across * factors.alpha_r)
        total += correct(distributed, radial, along * factors.beta_t, across * factors.beta_r)
    return total / chain.mass


def kinetic_energy(chain: Chain, node_vel: Array) -> float:
    """m v^T A v / 2: all beads of the unreduced fiber, moving with their segments."""
    return float(0.5 * chain.mass * np.sum(node_vel * (chain.matrix @ node_vel)))


def stretching_energy(chain: Chain, node_pos: Array) -> float:
    """sum k_s (d - l)^2 / 2."""
    _, length = segment_geometry(node_pos)
    return float(0.5 * chain.stretching_stiffness * np.sum((length - chain.rest_length) ** 2))


def bending_energy(chain: Chain, node_pos: Array) -> float:
    """sum k_b theta^2 / 2."""
    return float(0.5 * chain.bending_stiffness * np.sum(joint_angles(node_pos) ** 2))


Law = Callable[[Array, Array], Array]
StepLaw = Callable[[Array, Array, float], Array]


def step_rk4(law: Law, node_pos: Array, node_vel: Array, dt: float) -> tuple[Array, Array]:
    """One classical Runge-Kutta step of dx/dt = v, dv/dt = law(x, v)."""
    half = 0.5 * dt
    a1 = law(node_pos, node_vel)
    v2 = node_vel + half * a1
    a2 = law(node_pos + half * node_vel, v2)
    v3 = node_vel + half * a2
    a3 = law(node_pos + half * v2, v3)
    v4 = node_vel + dt * a3
    a4 = law(node_pos + dt * v3, v4)
    return (
        node_pos + dt / 6.0 * (node_vel + 2.0 * (v2 + v3) + v4),
        node_vel + dt / 6.0 * (a1 + 2.0 * (a2 + a3) + a4),
    )


def step_drag_implicit(
    law: StepLaw, node_pos: Array, node_vel: Array, dt: float
) -> tuple[Array, Array]:
    """v first, by the mean acceleration law(x, v, dt) over the step, then x with the new v."""
    new_vel = node_vel + dt * law(node_pos, node_vel, dt)
    return node_pos + dt * new_vel, new_vel
