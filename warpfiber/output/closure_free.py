"""Folgar-Tucker diffusion of directions without a closure, in spherical harmonics.

The averages m of all harmonics of even degree up to DEGREE follow a linear system: the flow couples
a degree l with l - 2, l and l + 2, diffusion damps each by C_I l (l + 1). Steps of the trapezoidal
rule; the orientation tensor is in the averages of degree 0 and 2.

Source: Folgar & Tucker, J. Reinf. Plast. Compos. 3 (1984) 98: rotary diffusivity C_I per unit of
    strain on Jeffery's motion. Expansion as in Bird, Armstrong & Hassager, Dynamics of Polymeric
    Liquids II (1987), sect. 14.
Symbols: Y real orthonormal harmonics, p direction, lambda shape factor, m = <Y>.
Limits: C_I of LEAST_DIFFUSION and more (A then is exact to 2e-4): with less the peak is sharper
    than DEGREE resolves. The start is an angular central Gaussian distribution of the given tensor.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.orientations import acg_covariance
from warpfiber.placement.without_contact import split_gradient

Floats = NDArray[np.float64]
DEGREE = 40
LEAST_DIFFUSION = 1e-3
STEP = 0.05
"""Strain of a step: its error in A is 1e-5."""
DIRECTIONS = 20_000
"""Evenly spread directions that stand for the start."""


class Diffusion:
    """Directions in one linear flow: start and flow are expanded once, for any C_I."""

    def __init__(self, start: Floats, gradient: Floats, factor: float) -> None:
        """Start with the tensor (3, 3); gradient per unit of strain (3, 3), shape factor."""
        self.flow = _flow_matrix(gradient, factor).T
        self.start = harmonics(_spread(start))[0].mean(axis=0)

    def tensors(self, diffusion: float, strain: Floats) -> Floats:
        """A (T, 3, 3) at rising strains (T,), the first of them that of the start."""
        from scipy.sparse import csc_matrix, diags, identity
        from scipy.sparse.linalg import splu

        degree = _degrees()
        system = csc_matrix(self.flow) - diags(diffusion * degree * (degree + 1.0))
        steps = max(1, int(np.ceil((strain[-1] - strain[0]) / STEP)))
        half = 0.5 * (strain[-1] - strain[0]) / steps * system
        one = identity(len(degree), format="csc")
        forward, backward = one + half, splu((one - half).tocsc())
        m = self.start
        made = [m]
        for _ in range(steps):
            m = backward.solve(forward @ m)
            made.append(m)
        tensor = np.array(made) @ _tensor_harmonics()
        at = np.linspace(strain[0], strain[-1], steps + 1)
        columns = [np.interp(strain, at, tensor[:, k]) for k in range(9)]
        return np.stack(columns, axis=1).reshape(-1, 3, 3)


def harmonics(p: Floats) -> tuple[Floats, Floats, Floats]:
    """Y (n, B) of even degree of directions (n, 3), and their slopes along e_theta and e_phi.

    The polar axis is y, the vorticity of the shear in x and z: it leaves m with m and m +- 2 alone.
    """
    cos = p[:, 1]
    sin = np.sqrt(np.maximum(1.0 - cos**2, 1e-300))
    phi = np.arctan2(p[:, 0], p[:, 2])
    value, slope, around = [], [], []
    for m in range(DEGREE + 1):
        legendre = _legendre(cos, sin, m)
        for turn, other, sign in ((np.cos, np.sin, -1.0), (np.sin, np.cos, 1.0)):
            if m == 0 and sign > 0.0:
                continue
            scale = 1.0 if m == 0 else np.sqrt(2.0)
            c, s = scale * turn(m * phi), scale * sign * m * other(m * phi)
            for degree in range(m + m % 2, DEGREE + 1, 2):
                here = legendre[degree - m]
                below = legendre[degree - m - 1] if degree > m else 0.0 * here
                ratio = (degree**2 - m**2) * (2 * degree + 1) / max(1, 2 * degree - 1)
                value.append(here * c)
                slope.append((degree * cos * here - np.sqrt(ratio) * below) / sin * c)
                around.append(here / sin * s)
    return np.stack(value, axis=1), np.stack(slope, axis=1), np.stack(around, axis=1)


def _legendre(cos: Floats, sin: Floats, m: int) -> list[Floats]:
    """Normalized associated Legendre functions of order m, degrees m ... DEGREE."""
    first = np.full_like(cos, 1.0 / np.sqrt(4.0 * np.pi))
    for k in range(1, m + 1):
        first = np.sqrt((2 * k + 1) / (2 * k)) * sin * first
    found = [first, np.sqrt(2 * m + 3) * cos * first]
    for degree in range(m + 2, DEGREE + 1):
        a = np.sqrt((4 * degree**2 - 1) / (degree**2 - m**2))
        b = np.sqrt(((degree - 1) ** 2 - m**2) / (4 * (degree - 1) ** 2 - 1))
        found.append(a * (cos * found[-1] - b * found[-2]))
    return found


@cache
def _degrees() -> Floats:
    """Degree of every harmonic, in the order of `harmonics`, (B,)."""
    found: list[int] = []
    for m in range(DEGREE + 1):
        found += list(range(m + m % 2, DEGREE + 1, 2)) * (1 if m == 0 else 2)
    return np.array(found, dtype=np.float64)


@cache
def _sphere() -> tuple[Floats, Floats]:
    """Directions (n, 3) and weights (n,) that integrate products of two harmonics and p p."""
    node, weight = np.polynomial.legendre.leggauss(DEGREE + 3)
    count = 2 * DEGREE + 6
    phi = 2.0 * np.pi * np.arange(count) / count
    ring = np.sqrt(1.0 - node**2)[:, None]
    p = np.stack([ring * np.sin(phi), node[:, None] + 0.0 * phi, ring * np.cos(phi)], axis=-1)
    return p.reshape(-1, 3), np.repeat(weight * 2.0 * np.pi / count, count)


@cache
def _tensor_harmonics() -> Floats:
    """Coefficients (B, 9) of p_i p_j in the harmonics."""
    p, weight = _sphere()
    value = harmonics(p)[0]
    both = np.einsum("ni,nj->nij", p, p).reshape(-1, 9)
    return np.asarray((value * weight[:, None]).T @ both)


def _flow_matrix(gradient: Floats, factor: float) -> Floats:
    """Coefficients (B, B) of p'.grad Y_b in Y_a, with Jeffery's p'; rounding set to zero."""
    p, weight = _sphere()
    value, slope, around = harmonics(p)
    spin, stretch = split_gradient(gradient)
    pulled = p @ stretch
    along = np.sum(pulled * p, axis=1)[:, None]
    rate = p @ spin.T + factor * (pulled - along * p)
    sin = np.sqrt(1.0 - p[:, 1] ** 2)
    e_phi = np.stack([p[:, 2], 0.0 * sin, -p[:, 0]], axis=1) / sin[:, None]
    e_theta = np.cross(e_phi, p)
    turned = np.sum(rate * e_theta, axis=1)[:, None] * slope
    turned += np.sum(rate * e_phi, axis=1)[:, None] * around
    matrix = (value * weight[:, None]).T @ turned
    return np.where(np.abs(matrix) < 1e-11, 0.0, matrix)


def _spread(tensor: Floats) -> Floats:
    """Directions (DIRECTIONS, 3) of the angular central Gaussian distribution of A, evenly spread.

    Evenly spread directions (a Fibonacci spiral) take the place of the normal ones.
    """
    eigen, axes = np.linalg.eigh(tensor)
    k = np.arange(DIRECTIONS)
    height = (2.0 * k + 1.0) / DIRECTIONS - 1.0
    ring, phi = np.sqrt(1.0 - height**2), k * np.pi * (3.0 - np.sqrt(5.0))
    even = np.stack([ring * np.cos(phi), ring * np.sin(phi), height], axis=1)
    p = (even * np.sqrt(acg_covariance(np.maximum(eigen, 0.0)))) @ axes.T
    return np.asarray(p / np.linalg.norm(p, axis=1)[:, None])
