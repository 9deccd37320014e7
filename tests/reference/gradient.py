"""Gradient of a scalar by finite differences, for forces that derive from an energy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def central_gradient(
    function: Callable[[np.ndarray], float], x: np.ndarray, h: float
) -> np.ndarray:
    """Fourth-order central differences of a scalar function of x."""
    gradient = np.zeros_like(x)
    for index in np.ndindex(x.shape):
        values = []
        for k in (-2, -1, 1, 2):
            moved = x.copy()
            moved[index] += k * h
            values.append(function(moved))
        gradient[index] = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    return gradient
