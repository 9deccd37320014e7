"""One fiber without inertia under forces on nodes and with nodes of given velocity.

Source: of x = base + h v a held node is known, delta = base + h V - x*; the rest of the linear
    problem is solved for the others. A multiplier between two held nodes of a segment that keeps
    its length has no equation left and is 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .bead_chain import Array
from .overdamped import Fiber, Shape, compliance, linearize, multiplier_system
from .overdamped_step import CHI


class Loads(NamedTuple):
    """Force (n, 3) on free nodes, `held` (n,), V (n, 3) of the held ones."""

    force: Array
    held: Array
    velocity: Array


def solve_loaded(
    fiber: Fiber, h: float, base: Array, guess: Array, tension: Array, loads: Loads
) -> Shape:
    """x = base + h v with the loads, linearized at the guess."""
    problem = linearize(fiber, h, base, guess, tension, np.where(loads.held[:, None], 0, loads[0]))
    matrix, right = multiplier_system(problem)
    count = guess.size
    known = np.zeros(len(right), dtype=bool)
    known[:count] = np.repeat(loads.held, 3)
    if compliance(problem) == 0.0:
        known[count:] = loads.held[1:] & loads.held[:-1]
    unknowns = np.zeros(len(right))
    given = (base + h * loads.velocity - guess).ravel()
    unknowns[:count] = np.where(known[:count], given, 0.0)
    free = ~known
    rest = right[free] - matrix[np.ix_(free, known)] @ unknowns[known]
    unknowns[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest)
    return Shape(guess + unknowns[:count].reshape(-1, 3), unknowns[count:] / h)


def step_bdf2(fiber: Fiber, now: Shape, before: Shape, dt: float, loads: Loads) -> Shape:
    """h = 2 dt/3, base (4 x_n - x_{n-1})/3, guess and tension extrapolated."""
    x, last = now.node_pos, before.node_pos
    tension = 2.0 * now.tension - before.tension
    base = (4.0 * x - last) / 3.0
    return solve_loaded(fiber, 2.0 * dt / 3.0, base, 2.0 * x - last, tension, loads)


def step_sdirk2(
    fiber: Fiber, now: Shape, dt: float, drift: Array, loads: Loads
) -> tuple[Shape, Array]:
    """New shape and velocity of its end; `drift` (n, 3) is the velocity of the first guess."""
    h, x = CHI * dt, now.node_pos
    first = solve_loaded(fiber, h, x, x + h * drift, now.tension, loads)
    moved = first.node_pos - x
    base = x + (1.0 - CHI) / CHI * moved
    second = solve_loaded(fiber, h, base, x + moved / CHI, first.tension, loads)
    return second, (second.node_pos - base) / h
