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


def end_rates(rods: Rods, first: Array, last: Array) -> tuple[Array, Array]:
    """What forces (F, 3) on the two ends add to dx_c/dt and, before the projection, to dp/dt."""
    lever = rods.half_length / rods.turning_drag
    return (first + last) / rods.drag[:, None], lever[:, None] * (last - first)


def align_rods(axis: Array, couple: Array, time: float) -> Array:
    """Directions (F, 3) after `time` under dp/dt = (I - p p^T) c.

    In the plane of p and c the angle between them obeys d(theta)/dt = -|c| sin(theta), hence
    tan(theta/2) shrinks by e^{-|c| t}.
    """
    size = np.linalg.norm(couple, axis=1)[:, None]
    along = couple / size
    cosine = (axis * along).sum(axis=1)[:, None]
    across = axis - cosine * along
    sine = np.linalg.norm(across, axis=1)[:, None]
    angle = 2.0 * np.arctan(np.tan(0.5 * np.arctan2(sine, cosine)) * np.exp(-size * time))
    return np.cos(angle) * along + np.sin(angle) * across / sine


def drag_rods(rods: Rods, gradient: Array, pull: Array, couple: Array, time: float) -> Rods:
    """Rods after `time` in u = G x with these added rates of the ends, by RK4 of small steps."""
    steps = max(20, math.ceil(400.0 * time))
    h = time / steps

    def rate(now: Rods) -> tuple[Array, Array]:
        move, turn = flow_rate(now, gradient)
        along = (couple * now.axis).sum(axis=1)[:, None]
        return move + pull, turn + couple - along * now.axis

    for _ in range(steps):
        slopes = [rate(rods)]
        for share in (0.5, 0.5, 1.0):
            move, turn = slopes[-1]
            there = rods._replace(
                center=rods.center + share * h * move, axis=rods.axis + share * h * turn
            )
            slopes.append(rate(there))
        move, turn = (
            (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0 for k1, k2, k3, k4 in zip(*slopes, strict=True)
        )
        axis = rods.axis + h * turn
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        rods = rods._replace(center=rods.center + h * move, axis=axis)
    return rods


def bead_positions(rods: Rods, rod: int) -> Array:
    """Arc positions of the beads of a rod with a whole number of them; (N,)."""
    count = round(float(rods.beads[rod]))
    return (np.arange(count) - (count - 1) / 2.0) * 2.0 * rods.radius
