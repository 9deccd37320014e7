"""Rigid straight chain of touching beads in a linear flow: Jeffery orbit and rotation with inertia.

Source: Jeffery 1922 (orbit of a spheroid); balance of bead drag 6 pi eta a and bead torque
    8 pi eta a^3 along a rigid line of beads (no hydrodynamic interaction).
Symbols: S = sum (x_i/a)^2 over beads; N_t = beads whose torque counts; r_e equivalent aspect
    ratio; theta angle of the fiber from x toward z in shear u = (rate z, 0, 0), negative turns.
Limits: the fiber stays straight and unstretched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Array = np.ndarray


def bead_moment(aspect_ratio: float) -> float:
    """S = r_f (r_f^2 - 1)/3 of the unreduced fiber."""
    return aspect_ratio * (aspect_ratio**2 - 1.0) / 3.0


def node_moment(segments: int, spacing: float) -> float:
    """S = M^2 N_n (N_n^2 - 1)/3 of the nodes alone (closure `none`)."""
    nodes = segments + 1
    return spacing**2 * nodes * (nodes**2 - 1.0) / 3.0


def torque_count(aspect_ratio: float, torque: str = "end_weighted") -> float:
    """N_t = sum of w_p: r_f (end_weighted) or r_f - 1 (plain)."""
    return aspect_ratio if torque == "end_weighted" else aspect_ratio - 1.0


def equivalent_aspect_ratio(moment: float, torques: float) -> float:
    """r_e = sqrt(1 + 3 S/(2 N_t))."""
    return math.sqrt(1.0 + 1.5 * moment / torques)


def period(r_e: float, rate: float = 1.0) -> float:
    """T = 2 pi (r_e + 1/r_e)/rate without inertia."""
    return 2.0 * math.pi / rate * (r_e + 1.0 / r_e)


def jeffery_angle(r_e: float, time: float, rate: float = 1.0) -> float:
    """theta(t) from theta = 0, unwrapped."""
    phase = r_e * rate * time / (r_e**2 + 1.0)
    turns = math.floor(phase / math.pi + 0.5)
    return -turns * math.pi - math.atan(math.tan(phase - turns * math.pi) / r_e)


def jeffery_orbit(p0: Sequence[float], gradient: Array, r_e: float, time: float) -> Array:
    """p(t) = F p0/|F p0|, F = exp(t (W + lambda D)), by scaling and squaring of the series."""
    shape = (r_e**2 - 1.0) / (r_e**2 + 1.0)
    lam_d = 0.5 * shape * (gradient + gradient.T)
    generator = time * (0.5 * (gradient - gradient.T) + lam_d)
    doublings = max(0, math.ceil(math.log2(max(np.abs(generator).sum(), 1e-300))) + 4)
    small = generator / 2.0**doublings
    term = result = np.eye(3)
    for k in range(1, 20):
        term = term @ small / k
        result = result + term
    for _ in range(doublings):
        result = result @ result
        # Only the direction is used, so the growth is taken out before it overflows.
        result = result / np.abs(result).max()
    p = result @ (np.asarray(p0, float) / np.linalg.norm(p0))
    return p / np.linalg.norm(p)


def hermite_root(time: float, dt: float, f0: float, s0: float, f1: float, s1: float) -> float:
    """Zero of the cubic through values f and slopes s at `time` and `time + dt`, by bisection."""

    def cubic(u: float) -> float:
        return (
            f0 * (1 + 2 * u) * (1 - u) ** 2
            + dt * s0 * u * (1 - u) ** 2
            + f1 * u * u * (3 - 2 * u)
            + dt * s1 * u * u * (u - 1)
        )

    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if cubic(low) * cubic(middle) <= 0.0:
            high = middle
        else:
            low = middle
    return time + dt * 0.5 * (low + high)


def half_turns(
    moment: float,
    torques: float,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
    density: float = 0.1,
    rate: float = 1.0,
    count: int = 2,
    dt: float,
) -> list[float]:
    """Times t_k at which theta passes -k pi, from theta = 0 at rest (RK4).

    m a^2 S theta'' = 6 pi eta a^3 S (-rate sin^2 theta - theta')
                      + 8 pi eta a^3 N_t (-rate/2 - theta')
    """
    relax = 9.0 * viscosity / (2.0 * density * radius**2)  # zeta/m
    couple = 4.0 * torques / (3.0 * moment)

    def law(theta: float, omega: float) -> float:
        drag = -rate * math.sin(theta) ** 2 - omega
        return relax * (drag + couple * (-0.5 * rate - omega))

    theta = omega = 0.0
    step = 0
    passages: list[float] = []
    while len(passages) < count:
        a1 = law(theta, omega)
        w2 = omega + 0.5 * dt * a1
        a2 = law(theta + 0.5 * dt * omega, w2)
        w3 = omega + 0.5 * dt * a2
        a3 = law(theta + 0.5 * dt * w2, w3)
        w4 = omega + dt * a3
        a4 = law(theta + dt * w3, w4)
        new_theta = theta + dt / 6.0 * (omega + 2.0 * (w2 + w3) + w4)
        new_omega = omega + dt / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)
        target = -math.pi * (len(passages) + 1)
        if new_theta <= target < theta:
            passages.append(
                hermite_root(step * dt, dt, theta - target, omega, new_theta - target, new_omega)
            )
        theta, omega = new_theta, new_omega
        step += 1
    return passages


def cross(a: Array, b: Array) -> Array:
    """Vector product (3,)."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def spin_rate(
    axis: Array,
    omega: Array,
    gradient: Array,
    moment: float,
    torques: float,
    radius: float = 1.0,
    viscosity: float = 1.0,
    density: float = 0.1,
) -> Array:
    """domega/dt of the rigid fiber, omega across its axis; (3,).

    m a^2 S omega' = 6 pi eta a^3 S (p x Lp - omega)
                     + 8 pi eta a^3 N_t (Omega - (Omega.p) p - omega)
    """
    relax = 9.0 * viscosity / (2.0 * density * radius**2)  # zeta/m
    curl = gradient - gradient.T
    vorticity = 0.5 * np.array([curl[2, 1], curl[0, 2], curl[1, 0]])
    across = vorticity - (vorticity @ axis) * axis
    drag = cross(axis, gradient @ axis) - omega
    return relax * (drag + 4.0 * torques / (3.0 * moment) * (across - omega))


def inertial_orbit(
    p0: Sequence[float],
    gradient: Array,
    moment: float,
    torques: float,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
    density: float = 0.1,
    time_end: float,
    dt: float,
    every: int = 1,
) -> tuple[Array, Array]:
    """Orientation of the rigid fiber with inertia (RK4), started with omega = p x Lp (v = u).

    Returns times (K,) and p (K, 3) of every `every`-th step.
    """

    def law(y: Array) -> Array:
        p, omega = y
        rate = spin_rate(p, omega, gradient, moment, torques, radius, viscosity, density)
        return np.array([cross(omega, p), rate])

    p = np.asarray(p0, float) / np.linalg.norm(p0)
    y = np.array([p, cross(p, gradient @ p)])
    times, path = [0.0], [p]
    for k in range(round(time_end / dt)):
        k1 = law(y)
        k2 = law(y + 0.5 * dt * k1)
        k3 = law(y + 0.5 * dt * k2)
        k4 = law(y + dt * k3)
        y = y + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        if (k + 1) % every == 0:
            times.append((k + 1) * dt)
            path.append(y[0] / np.linalg.norm(y[0]))
    return np.array(times), np.array(path)
