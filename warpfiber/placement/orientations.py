"""Directions of straight fibers from a second-order orientation tensor.

Law `acg` (default) or `bingham` (see `bingham`).
Source: angular central Gaussian (ACG) distribution, p = C^(1/2) z / |C^(1/2) z| with z normal
    (Tyler, Biometrika 74 (1987) 579): what random directions become in a linear flow. Its second
    moments are Carlson's R_D (Carlson, Numer. Algorithms 10 (1995) 13, duplication).
Symbols: A orientation tensor (mean of p p, trace 1), C covariance of the Gaussian (trace 1), a, c
    their eigenvalues.
Limits: A fixes C uniquely; a zero eigenvalue of A gives directions in a plane or along a line.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from warpfiber.placement.bingham import draw_bingham
from warpfiber.placement.capsules import Floats

FLAT = 1e-9
"""Eigenvalues of A below this are taken as zero."""
LEAST = 1e-32
"""Smallest covariance over the largest: what is less is zero, its moment below rounding."""
FEWEST = 10
"""Samples with fewer fibers are left as drawn: six moments cannot be set with them."""


def tensor_from_values(values: Sequence[float]) -> Floats:
    """A (3, 3) from [a11, a22, a33, a12, a13, a23]; ValueError says what is wrong with it.

    Values rounded to three digits pass: trace set to 1, eigenvalues down to -2e-3 set to zero.
    """
    if len(values) != 6 or not np.all(np.isfinite(values)):
        raise ValueError("an orientation tensor has six numbers [a11, a22, a33, a12, a13, a23]")
    a11, a22, a33, a12, a13, a23 = (float(v) for v in values)
    tensor = np.array([[a11, a12, a13], [a12, a22, a23], [a13, a23, a33]])
    trace = a11 + a22 + a33
    if abs(trace - 1.0) > 2e-3:
        raise ValueError(f"a11 + a22 + a33 is {trace:.6g}; it must be 1")
    eigen, axes = np.linalg.eigh(tensor)
    if eigen[0] < -2e-3:
        raise ValueError(f"its smallest eigenvalue is {eigen[0]:.3g}; none may be negative")
    eigen = np.maximum(eigen, 0.0)
    return np.asarray((axes * (eigen / eigen.sum())) @ axes.T)


def values_from_tensor(tensor: Floats) -> list[float]:
    """[a11, a22, a33, a12, a13, a23] of A (3, 3)."""
    index = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return [float(tensor[i, j]) for i, j in index]


def orientation_tensor(directions: Floats) -> Floats:
    """A (3, 3) of unit vectors (n, 3), one vote per fiber."""
    return np.asarray(directions.T @ directions / max(len(directions), 1))


def carlson_rd(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Floats:
    """R_D = 3/2 int_0^inf dt / [sqrt((t + x)(t + y)) (t + z)^(3/2)]; x, y >= 0, z > 0; (...)."""
    x, y, z = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (x, y, z)))
    total, power = np.zeros(x.shape), 1.0
    mean = start = (x + y + 3.0 * z) / 5.0
    x0, y0 = x, y
    spread = np.max(np.abs(start - np.stack([x, y, z])), axis=0) * 10.0
    rounds = 0
    # Two more halvings than converged make the series below exact to rounding.
    while rounds < 4 or np.any(spread * power * 256.0 > np.abs(mean)):
        root_x, root_y, root_z = np.sqrt(x), np.sqrt(y), np.sqrt(z)
        step = root_x * root_y + root_x * root_z + root_y * root_z
        total = total + power / (root_z * (z + step))
        power *= 0.25
        rounds += 1
        x, y, z = (x + step) / 4.0, (y + step) / 4.0, (z + step) / 4.0
        mean = (mean + step) / 4.0
    dx, dy = (start - x0) * power / mean, (start - y0) * power / mean
    dz = -(dx + dy) / 3.0
    e2 = dx * dy - 6.0 * dz * dz
    e3 = (3.0 * dx * dy - 8.0 * dz * dz) * dz
    e4 = 3.0 * (dx * dy - dz * dz) * dz * dz
    e5 = dx * dy * dz**3
    series = 1.0 - 3.0 * e2 / 14.0 + e3 / 6.0 + 9.0 * e2 * e2 / 88.0 - 3.0 * e4 / 22.0
    series = series - 9.0 * e2 * e3 / 52.0 + 3.0 * e5 / 26.0
    return np.asarray(power * mean**-1.5 * series + 3.0 * total)


def acg_moments(c: Floats) -> Floats:
    """Eigenvalues of A of covariances c (..., 3), zeros allowed: a_i = R_D / (3 sqrt(c1 c2 c3))."""
    c = np.asarray(c, dtype=np.float64)
    c = np.maximum(c / c.max(axis=-1, keepdims=True), LEAST)
    r = 1.0 / c
    a = carlson_rd(np.roll(r, -1, axis=-1), np.roll(r, -2, axis=-1), r)
    a = a / np.sqrt(c.prod(axis=-1, keepdims=True))
    return np.asarray(a / a.sum(axis=-1, keepdims=True))


def acg_covariance(eigen: Floats) -> Floats:
    """Covariance c (3,), sum 1, whose second moments are the eigenvalues of A (3,), sum 1."""
    a = np.where(eigen < FLAT, 0.0, eigen)
    a = a / a.sum()
    live = a > 0.0
    c = a**2
    for _ in range(200):
        now = acg_moments(c)
        ratio = np.ones(3)
        ratio[live] = a[live] / now[live]
        if np.max(np.abs(ratio - 1.0)) < 1e-13:
            break
        # d ln a / d ln c lies between 2/5 (isotropic) and 1: a power of 3/2 always contracts.
        c = c * ratio**1.5
        c /= c.sum()
    return np.asarray(c / c.sum())


def draw_directions(
    tensor: Floats, count: int, rng: np.random.Generator, law: str = "acg"
) -> Floats:
    """`count` random unit vectors (n, 3) with second moment A, by law `acg` or `bingham`."""
    eigen, axes = np.linalg.eigh(tensor)
    live = eigen > FLAT
    if law == "bingham" and np.count_nonzero(live) > 1:
        return np.asarray(draw_bingham(eigen[live], count, rng) @ axes[:, live].T)
    spread = np.sqrt(acg_covariance(np.maximum(eigen, 0.0)))
    raw = rng.standard_normal((count, 3)) * spread
    length = np.linalg.norm(raw, axis=1)
    raw[length == 0.0] = spread
    return np.asarray(_unit(raw) @ axes.T)


def match_moments(directions: Floats, tensor: Floats) -> Floats:
    """The sample bent by one linear map, p -> T p / |T p|, such that its second moment is A.

    Returns the sample as it is if it is too small, or if the map does not settle.
    """
    eigen, axes = np.linalg.eigh(tensor)
    live = eigen > FLAT
    if len(directions) < FEWEST or np.count_nonzero(live) < 2:
        return directions
    frame = axes[:, live]
    p = directions @ frame
    root = np.sqrt(eigen[live])
    for _ in range(100):
        now = orientation_tensor(p)
        if np.max(np.abs(now - np.diag(eigen[live]))) < 1e-13:
            break
        # Map between Gaussians of covariance `now` and A; the power makes up for normalizing.
        inner = _power(root[:, None] * now * root, -0.5)
        p = _unit(p @ _power(root[:, None] * inner * root, 1.5))
    matched = np.asarray(_unit(p @ frame.T))
    error = np.max(np.abs(orientation_tensor(matched) - tensor))
    turn = np.einsum("nk,nk->n", matched, directions)
    settled = np.isfinite(error) and error < 1e-9 and float(np.mean(turn)) > 0.8
    return matched if settled else directions


def _power(symmetric: Floats, exponent: float) -> Floats:
    eigen, axes = np.linalg.eigh(symmetric)
    return np.asarray((axes * np.maximum(eigen, 1e-300) ** exponent) @ axes.T)


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.linalg.norm(v, axis=1)[:, None])
