"""Dual problem of contact and lubrication rows: two solvers, and the exponential law row by row.

Source: projected Gauss-Seidel; projected gradients with the two Barzilai-Borwein steps in turn.
Symbols: w = w_free + D f relative velocity with row forces f, D = J Y J^T; g gap; h step;
    C compliance; c coefficient of a lubrication row.
        contact:      0 <= f  and  g/h + w(f) + C f >= 0, one of them an equality
        lubrication:  w(f) + f/c = 0
    m = (D_rr + C_r)^(-1/2) row scale, C_r = 1/c for lubrication; f = m x.
Limits: dense D; h > 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

Array = np.ndarray
FIRST_STEP = 0.3


class Dual(NamedTuple):
    """The problem of R rows."""

    delassus: Array  # D (R, R)
    free: Array  # w_free + w_0 (R,)
    gap: Array  # g (R,)
    h: float
    compliance: Array  # C (R,)
    coefficient: Array  # c (R,), 0 for contact rows


class Solution(NamedTuple):
    """Row forces, number of sweeps or iterations, last residual in gap units."""

    force: Array
    iterations: int
    residual: float


def make_dual(
    delassus: Array,
    free: Array,
    gap: Array,
    h: float,
    compliance: Array | float = 0.0,
    coefficient: Array | float = 0.0,
) -> Dual:
    """Dual with single numbers spread over the rows."""
    shape = np.shape(gap)
    return Dual(
        np.asarray(delassus, float),
        np.asarray(free, float),
        np.asarray(gap, float),
        h,
        np.broadcast_to(np.asarray(compliance, float), shape),
        np.broadcast_to(np.asarray(coefficient, float), shape),
    )


def softness(dual: Dual) -> tuple[Array, Array]:
    """C_r and b_r of w + C_r f + b_r: (1/c, 0) for lubrication, (C, g/h) for contact."""
    lubricated = dual.coefficient > 0.0
    safe = np.where(lubricated, dual.coefficient, 1.0)
    soft = np.where(lubricated, 1.0 / safe, dual.compliance)
    return soft, np.where(lubricated, 0.0, dual.gap / dual.h)


def row_balance(dual: Dual, force: Array) -> Array:
    """g/h + w + C f (contact) or w + f/c (lubrication); (R,)."""
    soft, bias = softness(dual)
    return dual.free + dual.delassus @ force + soft * force + bias


def residual(dual: Dual, force: Array) -> float:
    """Largest fault of a row, as a length."""
    if len(force) == 0:
        return 0.0
    balance = row_balance(dual, force)
    lubricated = dual.coefficient > 0.0
    fault = np.where((force > 0.0) | lubricated, balance, np.minimum(balance, 0.0))
    diagonal = np.diag(dual.delassus)
    soft, _ = softness(dual)
    share = np.where(lubricated, diagonal / (diagonal + soft), 1.0)
    return float(dual.h * np.abs(fault * share).max())


def solve_sweeps(
    dual: Dual, tolerance: float, limit: int = 100000, start: Array | None = None
) -> Solution:
    """Projected Gauss-Seidel: stops when max |change of f| D h < tolerance."""
    force = np.zeros(len(dual.gap)) if start is None else np.array(start, float)
    w = dual.free + dual.delassus @ force
    diagonal = np.diag(dual.delassus)
    sweep, worst = 0, 0.0
    while sweep < limit:
        sweep += 1
        worst = 0.0
        for r in range(len(force)):
            d, c, soft = diagonal[r], dual.coefficient[r], dual.compliance[r]
            if c > 0.0:
                new = force[r] - (force[r] + c * w[r]) / (1.0 + c * d)
            else:
                balance = w[r] + dual.gap[r] / dual.h + soft * force[r]
                new = max(0.0, force[r] - balance / (d + soft))
            change = new - force[r]
            force[r] = new
            w = w + dual.delassus[:, r] * change
            worst = max(worst, abs(change) * d * dual.h)
        if worst < tolerance:
            break
    return Solution(force, sweep, residual(dual, force))


def solve_gradients(
    dual: Dual, tolerance: float, limit: int = 100000, start: Array | None = None
) -> Solution:
    """Projected gradients (BBPGD); the best iterate is kept."""
    soft, bias = softness(dual)
    scale = (np.diag(dual.delassus) + soft) ** -0.5
    contact = dual.coefficient == 0.0
    x = np.zeros(len(dual.gap)) if start is None else np.asarray(start, float) / scale

    def slope(at: Array) -> Array:
        force = scale * at
        return scale * (dual.free + dual.delassus @ force + soft * force + bias)

    grad, alpha = slope(x), FIRST_STEP
    best = Solution(scale * x, 0, residual(dual, scale * x))
    for k in range(limit):
        if best.residual < tolerance:
            break
        x_old, grad_old = x, grad
        x = x - alpha * grad
        x = np.where(contact, np.maximum(x, 0.0), x)
        grad = slope(x)
        dx, dg = x - x_old, grad - grad_old
        top, bottom = (dx @ dx, dx @ dg) if k % 2 == 0 else (dx @ dg, dg @ dg)
        alpha = float(top / bottom) if bottom > 0.0 and top > 0.0 else FIRST_STEP
        found = residual(dual, scale * x)
        if found < best.residual:
            best = Solution(scale * x, k + 1, found)
    return best


def exponential_force(
    base: float, slope: float, strength: float, decay: float, radius: float
) -> float:
    """f = D_0 exp(-G_0 g/2a) with g = base + slope f; 0 where base >= 0.001 a.

    Newton in y = ln f; no larger than what opens the gap to the end of the range.
    """
    reach = 0.001 * radius
    if base >= reach:
        return 0.0
    y = math.log(strength) - decay * base / (2.0 * radius)
    y = min(y, math.log((reach - base) / slope))
    rate = decay / (2.0 * radius)
    for _ in range(20):
        f = math.exp(y)
        value = y - math.log(strength) + rate * (base + slope * f)
        change = min(max(-value / (1.0 + rate * slope * f), -3.0), 3.0)
        y += change
        if abs(change) < 1e-14:
            break
    return min(math.exp(y), (reach - base) / slope)


def solve_exponential(
    dual: Dual,
    strength: float,
    decay: float,
    radius: float,
    tolerance: float,
    limit: int = 10000,
) -> Solution:
    """Gauss-Seidel with the exponential law implicit in each contact row."""
    force = np.zeros(len(dual.gap))
    w = dual.free.copy()
    diagonal = np.diag(dual.delassus)
    sweep, worst = 0, 0.0
    while sweep < limit:
        sweep += 1
        worst = 0.0
        for r in range(len(force)):
            slope = dual.h * diagonal[r]
            base = dual.gap[r] + dual.h * w[r] - slope * force[r]
            change = exponential_force(base, slope, strength, decay, radius) - force[r]
            force[r] += change
            w = w + dual.delassus[:, r] * change
            worst = max(worst, abs(change) * slope)
        if worst < tolerance:
            break
    return Solution(force, sweep, worst)
