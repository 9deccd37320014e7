"""How far a periodic box may deform: its heights must hold a segment and its reach.

Source: a cell list over a lattice needs every height of the box >= longest segment + reach + skin.
    Simple shear along two box axes resets the lattice at half a box of shear; any other linear flow
    deforms the box for good, so the run ends at the strain where the smallest height reaches that
    limit.
"""

from __future__ import annotations

import math

import numpy as np


def box_heights(lattice: np.ndarray) -> np.ndarray:
    """(3,) distances of opposite faces of the box with the columns of `lattice` as edges."""
    heights: np.ndarray = 1.0 / np.linalg.norm(np.linalg.inv(lattice), axis=1)
    return heights


def smallest_sheared_height(size: np.ndarray, axes: tuple[int, int]) -> float:
    """Smallest height of a box that is reset at half a box of shear."""
    lattice = np.diag(size)
    lattice[axes[0], axes[1]] = 0.5 * size[axes[0]]
    return float(box_heights(lattice).min())


def strain_limit(size: np.ndarray, gradient: np.ndarray, rate: float, width: float) -> float:
    """Strain at which the smallest height falls to `width`; inf if that does not happen by 1000.

    `gradient` (3, 3) 1/s and `rate` 1/s at factor 1; the lattice follows exp(gradient t).
    """
    step = 1e-3
    push = _exponential(gradient * (step / rate))
    lattice = np.diag(size).astype(float)
    for k in range(1_000_000):
        if box_heights(lattice).min() < width:
            return max(0.0, (k - 1) * step)
        lattice = push @ lattice
        if not np.isfinite(lattice).all() or np.abs(lattice).max() > 1e12 * size.max():
            break
    return math.inf


def _exponential(matrix: np.ndarray) -> np.ndarray:
    """exp of a small matrix by its series."""
    term = total = np.eye(3)
    for k in range(1, 12):
        term = term @ matrix / k
        total = total + term
    return total
