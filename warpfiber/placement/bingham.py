"""The Bingham distribution of directions: its moments, its exponents from them, exact draws.

Density exp(sum b_i p_i^2) / Z on the sphere: of all axial distributions with one orientation tensor
the one of largest entropy. Against the angular central Gaussian its tails are thin.

Source: Bingham, Ann. Stat. 2 (1974) 1201. Draws: Kent, Ganeiber & Mardia, J. Comput. Graph. Stat.
    27 (2018) 291, rejection from an angular central Gaussian envelope, about half are taken.
Symbols: a eigenvalues of the orientation tensor (sum 1), b exponents (largest 0), alpha = -b,
    q number of directions that occur (3, or 2 in a plane).
Limits: eigenvalues are 0 or at least FLATTEST: the quadrature resolves no thinner layer of
    directions. Moments to 1e-12.
"""

from __future__ import annotations

import numpy as np

from warpfiber.placement.capsules import Floats
from warpfiber.scene.statistics import FLATTEST

POINTS = 128
"""Gauss points along each edge of the octant; they crowd at its edges, where peaks are."""
CLOSE = 1e-13
"""Largest error of a moment."""
UPDATES = 200


def bingham_moments(b: Floats) -> tuple[Floats, Floats]:
    """a_i = <p_i^2> (3,) and <p_i^2 p_j^2> (3, 3) of exponents b (3,)."""
    square, weight = _octant()
    exponent = square @ b
    density = weight * np.exp(exponent - exponent.max())
    density /= density.sum()
    return density @ square, (square * density[:, None]).T @ square


def bingham_exponents(eigen: Floats) -> Floats:
    """b (q,), largest 0, with second moments `eigen` (q,), q = 2 or 3, all positive, sum 1.

    Newton's method for the maximum of a.b - ln Z, which is concave: halved steps always lead there.
    """
    a = np.maximum(np.asarray(eigen, dtype=np.float64), FLATTEST)
    a /= a.sum()
    if len(a) == 2:  # in the plane of both
        return _plane_exponents(a)
    b: Floats = np.asarray(np.zeros(3))
    move, value = b, -np.inf
    for _ in range(UPDATES):
        trial: Floats = np.asarray(b + move - np.max(b + move), dtype=np.float64)
        reached = float(a @ trial) - _log_weight(trial)
        if reached < value:
            move = np.asarray(0.5 * move, dtype=np.float64)
            continue
        b, value = trial, reached
        got, fourth = bingham_moments(b)
        if np.max(np.abs(got - a)) < CLOSE:
            break
        slope = fourth - np.outer(got, got)
        move = np.asarray(np.linalg.lstsq(slope, a - got, rcond=1e-14)[0], dtype=np.float64)
    return b


def draw_bingham(eigen: Floats, count: int, rng: np.random.Generator) -> Floats:
    """`count` random unit vectors (n, q) along the axes of `eigen` (q,), q = 2 or 3."""
    alpha = -bingham_exponents(eigen)
    q = len(alpha)
    # beta in (0, q] with sum 1 / (beta + 2 alpha) = 1 takes the most directions
    low, high = 0.0, float(q)
    for _ in range(100):
        beta = 0.5 * (low + high)
        low, high = (beta, high) if np.sum(1.0 / (beta + 2.0 * alpha)) > 1.0 else (low, beta)
    inverse = 1.0 + 2.0 * alpha / beta
    most = 0.5 * q * np.log(q / beta) - 0.5 * (q - beta)
    drawn = np.zeros((0, q))
    while len(drawn) < count:
        p = rng.standard_normal((2 * (count - len(drawn)) + 16, q)) / np.sqrt(inverse)
        p /= np.linalg.norm(p, axis=1)[:, None]
        chance = 0.5 * q * np.log(p**2 @ inverse) - p**2 @ alpha - most
        drawn = np.concatenate([drawn, p[np.log(rng.random(len(p))) < chance]])
    return drawn[:count]


def _octant() -> tuple[Floats, Floats]:
    """p_i^2 (n, 3) and weights (n,) of a quadrature of the sphere: even functions, one octant."""
    node, weight = np.polynomial.legendre.leggauss(POINTS)
    angle = 0.25 * np.pi * (node + 1.0)
    cos, sin = np.cos(angle) ** 2, np.sin(angle) ** 2
    square = [np.outer(cos, cos), np.outer(cos, sin), np.outer(sin, np.ones(POINTS))]
    area = np.outer(weight * np.cos(angle), weight)  # latitude, longitude
    return np.stack(square, axis=-1).reshape(-1, 3), area.ravel()


def _log_weight(b: Floats) -> float:
    """ln Z up to a constant."""
    square, weight = _octant()
    exponent = square @ b
    return float(np.log(weight @ np.exp(exponent - exponent.max())) + exponent.max())


def _plane_exponents(a: Floats) -> Floats:
    """b (2,) of directions in a plane, by bisection of their difference."""
    node, weight = np.polynomial.legendre.leggauss(POINTS)
    square = np.cos(0.25 * np.pi * (node + 1.0)) ** 2
    low, high = -1.0 / FLATTEST, 1.0 / FLATTEST
    for _ in range(200):
        middle = 0.5 * (low + high)
        exponent = middle * square
        density = weight * np.exp(exponent - exponent.max())
        more = density @ square / density.sum() < a[0]
        low, high = (middle, high) if more else (low, middle)
    b = np.array([middle, 0.0])
    return np.asarray(b - b.max())
