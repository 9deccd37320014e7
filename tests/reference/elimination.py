"""Elimination of the matrix of one step: blocks of a fiber, and scalar without pivoting.

Source: LDL^T of a symmetric block-pentadiagonal matrix whose second lower block is kappa I.
Symbols: A0_i, A1_i diagonal and lower 3x3 block of row i, D_i pivots, L1_i lower factor.
"""

from __future__ import annotations

import numpy as np

from .bead_chain import Array


def blocks_of(matrix: Array) -> tuple[Array, Array, float]:
    """A0 (n, 3, 3), A1 (n, 3, 3) with A1[0] = 0, and kappa of a step matrix (3n, 3n)."""
    count = len(matrix) // 3
    block = matrix.reshape(count, 3, count, 3).transpose(0, 2, 1, 3)
    i = np.arange(count)
    lower = np.zeros((count, 3, 3))
    lower[1:] = block[i[1:], i[:-1]]
    return block[i, i], lower, float(block[2, 0, 0, 0]) if count > 2 else 0.0


def symmetric_inverse(matrix: Array) -> Array:
    """Inverse of a symmetric 3x3 matrix by its LDL^T factors."""
    a, b, c = matrix[0, 0], matrix[1, 0], matrix[2, 0]
    l10, l20 = b / a, c / a
    d1 = matrix[1, 1] - l10 * b
    l21 = (matrix[2, 1] - l20 * b) / d1
    d2 = matrix[2, 2] - l20 * c - l21 * l21 * d1
    back = np.array([[1.0, 0, 0], [-l10, 1.0, 0], [l10 * l21 - l20, -l21, 1.0]])
    return back.T @ np.diag([1.0 / a, 1.0 / d1, 1.0 / d2]) @ back


def solve_blocks(diagonal: Array, lower: Array, kappa: float, right: Array) -> Array:
    """Solution (n, 3) of the block-pentadiagonal system; lower[0] is not read."""
    count = len(diagonal)
    zero = np.zeros((3, 3))
    inverse, factor, y = [zero] * (count + 2), [zero] * (count + 2), [np.zeros(3)] * (count + 2)
    # Entry i + 2 belongs to node i; the first two stay zero.
    for i in range(count):
        pivot, reduced = diagonal[i], right[i]
        if i > 0:
            w = lower[i] - kappa * factor[i + 1].T
            factor[i + 2] = w @ inverse[i + 1]
            pivot = pivot - factor[i + 2] @ w.T
            reduced = reduced - factor[i + 2] @ y[i + 1]
        if i > 1:
            pivot = pivot - kappa**2 * inverse[i]
            reduced = reduced - kappa * inverse[i] @ y[i]
        inverse[i + 2] = symmetric_inverse(pivot)
        y[i + 2] = reduced
    z = np.zeros((count + 2, 3))
    for i in reversed(range(count)):
        next_factor = factor[i + 3] if i + 1 < count else zero
        z[i] = inverse[i + 2] @ (y[i + 2] - kappa * z[i + 2]) - next_factor.T @ z[i + 1]
    return z[:count]


def half_bandwidth(matrix: Array) -> int:
    """Largest distance of a nonzero entry from the diagonal."""
    rows, columns = np.nonzero(matrix)
    return int(np.abs(rows - columns).max())


def solve_in_order(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Solution and pivots of LDL^T without pivoting, unknowns taken as they stand."""
    work = np.array(matrix, float)
    y = np.array(right, float)
    size, reach = len(y), half_bandwidth(matrix)
    pivots = np.zeros(size)
    factor = np.eye(size)
    for k in range(size):
        pivots[k] = work[k, k]
        below = slice(k + 1, min(size, k + 1 + reach))
        factor[below, k] = work[below, k] / pivots[k]
        work[below, below] -= np.outer(factor[below, k], work[k, below])
        y[below] -= factor[below, k] * y[k]
    x = y / pivots
    for k in reversed(range(size)):
        below = slice(k + 1, min(size, k + 1 + reach))
        x[k] -= factor[below, k] @ x[below]
    return x, pivots
