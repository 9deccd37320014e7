"""Bonded spheres in float64 NumPy: energy of the bonds, its exact gradient, damping, plane walls.

Source: one-point geometrically exact rod between two nodes, the frame midway between the two
    nodes' frames; linearized it is Xu, Ma & Guo 2023, Eqs. (3)-(6). Written with angles and
    logarithms, where the kernels use rational forms. Damping as in their Eq. (10).
Symbols: x, q, v, w position, quaternion (x, y, z, w), velocity and angular velocity of the nodes;
    X stress-free positions, where every quaternion is 1; l arc length of a segment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

Array = np.ndarray
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def product(p: Array, q: Array) -> Array:
    """Quaternion product p q, (..., 4)."""
    pv, pw, qv, qw = p[..., :3], p[..., 3:], q[..., :3], q[..., 3:]
    vector = pw * qv + qw * pv + np.cross(pv, qv)
    return np.concatenate([vector, pw * qw - (pv * qv).sum(-1, keepdims=True)], axis=-1)


def conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def turn(q: Array, vector: Array) -> Array:
    """The vector turned by q."""
    pure = np.concatenate([vector, np.zeros((*vector.shape[:-1], 1))], axis=-1)
    turned: Array = product(product(q, pure), conjugate(q))[..., :3]
    return turned


def exponential(rotation: Array) -> Array:
    """Quaternion of a rotation vector, (..., 3)."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(0.5 * angle / np.pi) * rotation, np.cos(0.5 * angle)], -1)


def logarithm(q: Array) -> Array:
    """Rotation vector of a unit quaternion with w >= 0."""
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    factor = np.divide(angle, sine, out=np.full_like(angle, 2.0), where=sine > 0.0)
    return factor * q[..., :3]


@dataclass
class Rod:
    """One fiber: `rest` (n, 3) m stress-free nodes; `closed`: a bond from the last to the first."""

    rest: Array
    radius: float
    density: float = 1340.0
    modulus: float = 7.5e5
    poisson: float = 0.5
    shear: str = "rbf"
    damping: float = 0.0
    closed: bool = False
    caps: str = "centerline"
    segment_length: float | None = None  # arc; None: mean chord
    first: Array = field(init=False)
    second: Array = field(init=False)

    def __post_init__(self) -> None:
        n = len(self.rest)
        self.first = np.arange(n if self.closed else n - 1)
        self.second = (self.first + 1) % n
        chord = self.rest[self.second] - self.rest[self.first]
        self.rest_length = np.linalg.norm(chord, axis=1)
        self.axis = chord / self.rest_length[:, None]
        length = self.segment_length or float(self.rest_length.mean())
        area = math.pi * self.radius**2
        second_moment = 0.25 * math.pi * self.radius**4
        shear_modulus = 0.5 * self.modulus / (1.0 + self.poisson)
        self.length = length
        self.k_n = self.modulus * area / length
        self.k_b = self.modulus * second_moment / length
        self.k_w = shear_modulus * 2.0 * second_moment / length
        flexibility = length / (shear_modulus * area)
        if self.shear == "rbf":
            flexibility += length**3 / (12.0 * self.modulus * second_moment)
        self.k_t = 1.0 / flexibility
        inner = self.density * area * length
        cap = {"centerline": 0.0, "capsule": 2.0 / 3.0, "cylinder": 1.0}[self.caps]
        self.mass = np.full(n, inner)
        if not self.closed:
            self.mass[[0, -1]] = 0.5 * inner + cap * math.pi * self.radius**3 * self.density
        self.inertia = 0.4 * self.mass * self.radius**2
        turning = 0.4 * inner * self.radius**2
        self.c_n = self.damping * math.sqrt(2.0 * inner * self.k_n)
        self.c_t = self.damping * math.sqrt(2.0 * inner * self.k_t)
        self.c_b = self.damping * math.sqrt(2.0 * turning * self.k_b)
        self.c_w = self.damping * math.sqrt(2.0 * turning * self.k_w)

    def largest_step(self) -> float:
        """dt_c without damping: min of the axial and the rotational limit."""
        inner = self.density * math.pi * self.radius**2 * self.length
        turning = 0.4 * inner * self.radius**2
        stiffest = max(self.k_t * self.length**2, 4.0 * self.k_b, 4.0 * self.k_w)
        return min(math.sqrt(inner / self.k_n), 2.0 * math.sqrt(turning / stiffest))


@dataclass
class Strains:
    """What deforms every bond: gamma and psi in the mid frame, and that frame as a quaternion."""

    gamma: Array
    psi: Array
    middle: Array


def bond_strains(rod: Rod, x: Array, q: Array) -> Strains:
    """Stretch and shear (m), rotation (rad) of every bond."""
    qi, qj = q[rod.first], q[rod.second]
    qj = np.where((qi * qj).sum(1, keepdims=True) < 0.0, -qj, qj)
    middle = (qi + qj) / np.linalg.norm(qi + qj, axis=1, keepdims=True)
    psi = logarithm(product(conjugate(qi), qj))
    gamma = turn(conjugate(middle), x[rod.second] - x[rod.first])
    return Strains(gamma - rod.rest_length[:, None] * rod.axis, psi, middle)


def _split(values: Array, axis: Array, along: float, across: float) -> Array:
    part: Array = (values * axis).sum(1, keepdims=True) * axis
    return across * values + (along - across) * part


def bond_energy(rod: Rod, x: Array, q: Array) -> Array:
    """Energy of every bond, J."""
    strains = bond_strains(rod, x, q)
    force = _split(strains.gamma, rod.axis, rod.k_n, rod.k_t)
    moment = _split(strains.psi, rod.axis, rod.k_w, rod.k_b)
    energy: Array = 0.5 * (force * strains.gamma).sum(1) + 0.5 * (moment * strains.psi).sum(1)
    return energy


def bond_loads(rod: Rod, x: Array, q: Array) -> tuple[Array, Array]:
    """Forces (n, 3) N and moments (n, 3) N m of the bonds on the nodes."""
    strains = bond_strains(rod, x, q)
    psi, middle = strains.psi, strains.middle
    force = turn(middle, _split(strains.gamma, rod.axis, rod.k_n, rod.k_t))
    moment = _split(psi, rod.axis, rod.k_w, rod.k_b)
    angle = np.linalg.norm(psi, axis=1, keepdims=True)
    u = np.divide(psi, angle, out=np.zeros_like(psi), where=angle > 0.0)
    g = 1.0 / np.sinc(0.5 * angle / np.pi)
    moment = turn(middle, g * moment + (1.0 - g) * (u * moment).sum(1, keepdims=True) * u)
    couple = np.cross(x[rod.second] - x[rod.first], force)
    swing = 0.5 * np.tan(0.25 * angle) * np.cross(couple, turn(middle, u))
    forces, moments = np.zeros_like(x), np.zeros_like(x)
    np.add.at(forces, rod.first, force)
    np.add.at(forces, rod.second, -force)
    np.add.at(moments, rod.first, 0.5 * couple + swing + moment)
    np.add.at(moments, rod.second, 0.5 * couple - swing - moment)
    return forces, moments


def damping_loads(rod: Rod, x: Array, v: Array, w: Array) -> tuple[Array, Array]:
    """Forces and moments of the dashpots beside the bonds."""
    i, j = rod.first, rod.second
    d = x[j] - x[i]
    axis = d / np.linalg.norm(d, axis=1, keepdims=True)
    force = _split(v[j] - v[i] - 0.5 * np.cross(w[i] + w[j], d), axis, rod.c_n, rod.c_t)
    moment = _split(w[j] - w[i], axis, rod.c_w, rod.c_b)
    couple = 0.5 * np.cross(d, force)
    forces, moments = np.zeros_like(x), np.zeros_like(x)
    np.add.at(forces, i, force)
    np.add.at(forces, j, -force)
    np.add.at(moments, i, couple + moment)
    np.add.at(moments, j, couple - moment)
    return forces, moments


@dataclass
class Surroundings:
    """What acts on nodes from outside: weight, planes (axis, place, inward sign), settling."""

    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    walls: tuple[tuple[int, float, float], ...] = ()
    wall_modulus: float = 0.0  # E_c / (1 - nu^2)
    wall_damping: float = 0.0
    settling: float = 0.0


def wall_forces(rod: Rod, around: Surroundings, x: Array, v: Array) -> Array:
    """Hertz force and its damping of a sphere on a rigid plane; never an attraction."""
    forces = np.zeros_like(x)
    for axis, place, inward in around.walls:
        depth = np.maximum(rod.radius - inward * (x[:, axis] - place), 0.0)
        spring = 4.0 / 3.0 * around.wall_modulus * np.sqrt(rod.radius) * depth**1.5
        stiffness = 2.0 * around.wall_modulus * np.sqrt(rod.radius * depth)
        resistance = 2.0 * math.sqrt(5.0 / 6.0) * around.wall_damping
        damper = resistance * np.sqrt(stiffness * rod.mass) * inward * v[:, axis]
        forces[:, axis] += inward * np.maximum(spring - damper, 0.0)
    return forces


@dataclass
class Motion:
    """State of one fiber; `a`, `b` are the accelerations that the next half kick uses."""

    x: Array
    v: Array
    q: Array
    w: Array
    a: Array
    b: Array


def start(
    rod: Rod,
    around: Surroundings | None = None,
    *,
    x: Array | None = None,
    v: Array | None = None,
    q: Array | None = None,
    w: Array | None = None,
) -> Motion:
    """The start; what is not given is stress-free and at rest."""
    n = len(rod.rest)
    motion = Motion(
        x=(rod.rest if x is None else x).copy(),
        v=np.zeros((n, 3)) if v is None else v.copy(),
        q=np.tile(IDENTITY, (n, 1)) if q is None else q.copy(),
        w=np.zeros((n, 3)) if w is None else w.copy(),
        a=np.zeros((n, 3)),
        b=np.zeros((n, 3)),
    )
    _accelerate(rod, around or Surroundings(), motion)
    return motion


def _accelerate(rod: Rod, around: Surroundings, motion: Motion) -> None:
    forces, moments = bond_loads(rod, motion.x, motion.q)
    if rod.damping > 0.0:
        more = damping_loads(rod, motion.x, motion.v, motion.w)
        forces, moments = forces + more[0], moments + more[1]
    forces = forces + wall_forces(rod, around, motion.x, motion.v)
    motion.a = forces / rod.mass[:, None] + np.asarray(around.gravity)
    motion.a = motion.a - around.settling * motion.v
    motion.b = moments / rod.inertia[:, None] - around.settling * motion.w


def step(rod: Rod, motion: Motion, dt: float, around: Surroundings | None = None) -> None:
    """Kick, drift, kick; forces that depend on speed take that of the middle of the step."""
    motion.v = motion.v + 0.5 * dt * motion.a
    motion.w = motion.w + 0.5 * dt * motion.b
    motion.x = motion.x + dt * motion.v
    q = product(exponential(dt * motion.w), motion.q)
    motion.q = q / np.linalg.norm(q, axis=1, keepdims=True)
    _accelerate(rod, around or Surroundings(), motion)
    motion.v = motion.v + 0.5 * dt * motion.a
    motion.w = motion.w + 0.5 * dt * motion.b


def kinetic_energy(rod: Rod, motion: Motion) -> float:
    """Of translation and rotation, J."""
    moving = rod.mass * (motion.v**2).sum(1) + rod.inertia * (motion.w**2).sum(1)
    return float(0.5 * moving.sum())


def momentum(rod: Rod, motion: Motion) -> tuple[Array, Array]:
    """Linear and angular momentum about the origin."""
    linear = rod.mass[:, None] * motion.v
    spin = rod.inertia[:, None] * motion.w
    return linear.sum(0), (np.cross(motion.x, linear) + spin).sum(0)


def residual(rod: Rod, x: Array, q: Array) -> Array:
    """Forces and moments of the bonds as one vector (6 n,), node by node."""
    forces, moments = bond_loads(rod, x, q)
    return np.concatenate([forces, moments], axis=1).ravel()


def stiffness(rod: Rod, x: Array, q: Array) -> Array:
    """(6 n, 6 n) minus the derivative of `residual` by displacements and world rotations."""
    n = len(x)
    size = 6 * n
    columns = np.zeros((size, size))
    lengths = np.tile(np.repeat([1e-6 * rod.length, 1e-6], 3), n)
    for k, h in enumerate(lengths):
        ends = []
        for sign in (1.0, -1.0):
            move = np.zeros((n, 6))
            move.flat[k] = sign * h
            ends.append(residual(rod, x + move[:, :3], product(exponential(move[:, 3:]), q)))
        columns[:, k] = (ends[1] - ends[0]) / (2.0 * h)
    return columns


def equilibrium(
    rod: Rod, load: Array, fixed: Array, *, load_steps: int = 1, tolerance: float = 1e-12
) -> tuple[Array, Array]:
    """Positions and quaternions under dead loads (6 n,) with the degrees of freedom `fixed` held.

    Newton's method; the residual falls below `tolerance` times the largest load.
    """
    n = len(rod.rest)
    x, q = rod.rest.copy(), np.tile(IDENTITY, (n, 1))
    free = np.setdiff1d(np.arange(6 * n), fixed)
    for level in range(1, load_steps + 1):
        wanted = load * level / load_steps
        for _ in range(40):
            rest = (residual(rod, x, q) + wanted)[free]
            if np.abs(rest).max() < tolerance * np.abs(load).max():
                break
            matrix = stiffness(rod, x, q)[np.ix_(free, free)]
            move = np.zeros(6 * n)
            move[free] = np.linalg.solve(matrix, rest)
            step_size = min(1.0, 0.3 / np.abs(move.reshape(n, 6)[:, 3:]).max(initial=1e-300))
            parts = step_size * move.reshape(n, 6)
            x = x + parts[:, :3]
            q = product(exponential(parts[:, 3:]), q)
        else:
            raise ArithmeticError("no equilibrium found")
    return x, q
