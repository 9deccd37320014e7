"""Rigid straight rods without inertia: exact map of a linear flow, response to forces.

Source: Jeffery 1922 and the balance of bead drag 6 pi eta a and bead torque 8 pi eta a^3 along a
    rigid line of N touching beads.
Symbols: xi = 6 pi eta a N; K_r = 2 pi eta a^3 N (N^2 + 3); Bretherton factor lambda_J
    = (N^2 - 1)/(N^2 + 3); r_e = sqrt((N^2 + 1)/2); H = (N - 1) a; W, S antisymmetric and symmetric
    part of G; p(t) = e^{(W + lambda_J S) t} p_0/|.|; center: dx/dt = G x + u_0.
Limits: constant G and u_0; rods keep their shape.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

Array = np.ndarray


class Rods(NamedTuple):
    """Rods of one radius: centers (F, 3), unit directions (F, 3), beads N (F,)."""

    center: Array
    axis: Array
    beads: Array
    radius: float = 1.0
    viscosity: float = 1.0

    @property
    def half_length(self) -> Array:
        """H = (N - 1) a; (F,)."""
        return (self.beads - 1.0) * self.radius

    @property
    def drag(self) -> Array:
        """xi of the translation; (F,)."""
        return 6.0 * math.pi * self.viscosity * self.radius * self.beads

    @property
    def turning_drag(self) -> Array:
        """K_r, torque per rate of turning; (F,)."""
        n = self.beads
        return 2.0 * math.pi * self.viscosity * self.radius**3 * n * (n**2 + 3.0)

    @property
    def bretherton(self) -> Array:
        """lambda_J; (F,)."""
        return (self.beads**2 - 1.0) / (self.beads**2 + 3.0)


def make_rods(center: object, axis: object, beads: object, **keys: float) -> Rods:
    """Rods with directions made unit and one or many bead counts."""
    p = np.atleast_2d(np.asarray(axis, float))
    p = p / np.linalg.norm(p, axis=1)[:, None]
    x = np.broadcast_to(np.asarray(center, float), p.shape).copy()
    return Rods(x, p, np.broadcast_to(np.asarray(beads, float), (len(p),)).copy(), **keys)


def exponential(matrix: Array) -> Array:
    """e^matrix by the series of matrix/2^k, squared k times."""
    size = float(np.abs(matrix).sum(axis=0).max())
    doublings = max(0, math.ceil(math.log2(max(size, 1e-300))) + 3)
    small = matrix / 2.0**doublings
    term = result = np.eye(len(matrix))
    for k in range(1, 18):
        term = term @ small / k
        result = result + term
    for _ in range(doublings):
        result = result @ result
    return result


def flow_exponential(gradient: Array, mean: Array, time: float) -> tuple[Array, Array]:
    """e^{G t} (3, 3) and the shift (3,) of x -> e^{G t} x + shift under dx/dt = G x + u_0."""
    whole = np.zeros((4, 4))
    whole[:3, :3], whole[:3, 3] = gradient, mean
    result = exponential(time * whole)
    return result[:3, :3], result[:3, 3]


def map_rods(
    rods: Rods, gradient: Array, time: float, mean: Array | tuple[float, ...] = (0.0, 0.0, 0.0)
) -> Rods:
    """Rods carried by u = G x + u_0 for `time`, by one matrix exponential per bead count."""
    factor, shift = flow_exponential(gradient, np.asarray(mean, float), time)
    center = rods.center @ factor.T + shift
    spin, strain = 0.5 * (gradient - gradient.T), 0.5 * (gradient + gradient.T)
    axis = np.empty_like(rods.axis)
    for lam in np.unique(rods.bretherton):
        same = rods.bretherton == lam
        axis[same] = rods.axis[same] @ exponential(time * (spin + lam * strain)).T
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    return rods._replace(center=center, axis=axis)


def map_rods_in_shear(rods: Rods, rate: float, time: float) -> Rods:
    """The same in u = (rate z, 0, 0), closed form."""
    lam = rods.bretherton
    omega = 0.5 * rate * np.sqrt(1.0 - lam**2)
    b, c = 0.5 * rate * (1.0 + lam), 0.5 * rate * (1.0 - lam)
    cosine, sine = np.cos(omega * time), np.sin(omega * time)
    px, py, pz = rods.axis.T
    axis = np.stack(
        [px * cosine + pz * b / omega * sine, py, pz * cosine - px * c / omega * sine], axis=1
    )
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    center = rods.center.copy()
    center[:, 0] += rate * rods.center[:, 2] * time
    return rods._replace(center=center, axis=axis)


def flow_rate(
    rods: Rods, gradient: Array, mean: Array | tuple[float, ...] = (0.0, 0.0, 0.0)
) -> tuple[Array, Array]:
    """dx_c/dt and dp/dt of free rods; (F, 3) each."""
    spin, strain = 0.5 * (gradient - gradient.T), 0.5 * (gradient + gradient.T)
    turn = rods.axis @ spin.T + rods.bretherton[:, None] * (rods.axis @ strain.T)
    along = np.einsum("ij,ij->i", turn, rods.axis)
    return rods.center @ gradient.T + np.asarray(mean, float), turn - along[:, None] * rods.axis


def force_rate(rods: Rods, rod: int, force: Array, arm: float) -> tuple[Array, Array]:
    """What `force` (3,) at arc position `arm` adds to dx_c/dt and dp/dt of one rod; (3,) each."""
    p = rods.axis[rod]
    across = force - (force @ p) * p
    return force / rods.drag[rod], arm * across / rods.turning_drag[rod]


def bead_positions(rods: Rods, rod: int) -> Array:
    """Arc positions of the beads of a rod with a whole number of them; (N,)."""
    count = round(float(rods.beads[rod]))
    return (np.arange(count) - (count - 1) / 2.0) * 2.0 * rods.radius
