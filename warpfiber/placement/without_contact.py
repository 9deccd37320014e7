"""Orientation of rigid fibers that never touch, exact at any strain of a linear flow.

A direction goes p -> F p / |F p|, F = exp(strain (W + lambda D)). An angular central Gaussian (ACG)
population of covariance C stays one, of covariance F C F^T: its moments are known without a
closure. Fibers of several lengths are mixed with their weights.

Source: Jeffery, Proc. R. Soc. A 102 (1922) 161, in Bretherton's form, J. Fluid Mech. 14 (1962) 284:
    p' = W p + lambda (D p - (p.D p) p). ACG and its moments as in `orientations`.
Symbols: D, W symmetric and antisymmetric part of the gradient L_ij = du_i/dx_j per unit of strain,
    lambda = (r_e^2 - 1) / (r_e^2 + 1) shape factor, A orientation tensor.
Limits: no walls, no bending, no contact. Moments to 1e-8: where the covariance spans more than
    double precision holds, its smallest eigenvalue counts as zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from warpfiber.placement.capsules import Floats
from warpfiber.placement.orientations import acg_covariance, acg_moments

TERMS = 18
"""Of the series of the exponential of a matrix of norm 1/2: the next one is below 1e-22."""
GROUP = 200_000
"""Directions that are mapped at once."""


def shape_factor(equivalent_aspect_ratio: ArrayLike) -> Floats:
    """lambda of ellipsoids (...) of these aspect ratios r_e."""
    square = np.asarray(equivalent_aspect_ratio, dtype=np.float64) ** 2
    return np.asarray((square - 1.0) / (square + 1.0))


def split_gradient(gradient: ArrayLike) -> tuple[Floats, Floats]:
    """W and D (3, 3) of a gradient L_ij = du_i/dx_j."""
    rate = np.asarray(gradient, dtype=np.float64)
    return 0.5 * (rate - rate.T), 0.5 * (rate + rate.T)


def deformations(gradient: ArrayLike, factor: ArrayLike, strain: ArrayLike) -> Floats:
    """F (T, K, 3, 3) of shape factors (K,) at strains (T,), gradient (3, 3) per unit of strain."""
    spin, stretch = split_gradient(gradient)
    generator = spin + np.atleast_1d(factor)[:, None, None] * stretch
    return _exponential(np.atleast_1d(strain)[:, None, None, None] * generator)


def population_tensors(
    tensor: ArrayLike,
    gradient: ArrayLike,
    factor: ArrayLike,
    weight: ArrayLike,
    strain: ArrayLike,
) -> Floats:
    """A (T, 3, 3) at strains (T,) of ACG fibers that start with A `tensor` (3, 3).

    Classes of shape factor (K,) and weight (K,) all start alike; weights need not add up to 1.
    """
    eigen, axes = np.linalg.eigh(np.asarray(tensor, dtype=np.float64))
    start = (axes * acg_covariance(np.maximum(eigen, 0.0))) @ axes.T
    f = deformations(gradient, factor, strain)
    covariance = f @ start @ np.swapaxes(f, -1, -2)
    covariance /= np.trace(covariance, axis1=-2, axis2=-1)[..., None, None]
    spread, axes = np.linalg.eigh(covariance)
    moments = acg_moments(np.maximum(spread, 0.0))
    share = np.asarray(weight, dtype=np.float64) / np.sum(weight)
    return np.asarray(np.einsum("k,tkia,tka,tkja->tij", share, axes, moments, axes))


def direction_tensors(
    direction: Floats,
    gradient: ArrayLike,
    factor: Floats,
    weight: Floats,
    strain: ArrayLike,
) -> Floats:
    """A (T, 3, 3) at strains (T,) of start directions (n, 3) with lambda and weight (n,)."""
    classes, member = np.unique(factor, return_inverse=True)
    strains = np.atleast_1d(np.asarray(strain, dtype=np.float64))
    total = np.zeros((len(strains), 3, 3))
    for t, f in enumerate(deformations(gradient, classes, strains)):
        for first in range(0, len(direction), GROUP):
            part = slice(first, first + GROUP)
            p = np.einsum("nij,nj->ni", f[member[part]], direction[part])
            p /= np.linalg.norm(p, axis=1)[:, None]
            total[t] += (p * weight[part, None]).T @ p
    return total / np.sum(weight)


def _exponential(matrix: Floats) -> Floats:
    """exp of matrices (..., 3, 3): Taylor series of M / 2^s, norm below 1/2, squared s times."""
    norm = float(np.max(np.sum(np.abs(matrix), axis=-1), initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300)))) + 1)
    small = matrix / 2.0**squarings
    result = term = np.broadcast_to(np.eye(3), matrix.shape)
    for k in range(1, TERMS):
        term = term @ small / k
        result = result + term
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result)
