"""Time steps of one fiber without inertia and runs of a tumble: LI-Euler, BDF2, SDIRK2.

Source: linearly implicit backward Euler, two-step backward differentiation, and the L-stable
    two-stage diagonally implicit Runge-Kutta method with chi = 1 - 1/sqrt(2); one linear solve per
    stage, no Newton iteration.
Symbols: k_j = (X_j - base_j)/h stage velocities; error = h max |k_2 - k_1|/L_fiber, the distance
    to the embedded first-order result x + dt k_1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from .bead_chain import Array, shear_gradient, straight_nodes
from .overdamped import Fiber, Shape, linearize, solve_step

CHI = 1.0 - 1.0 / math.sqrt(2.0)
START_STEPS = 20  # LI-Euler steps that replace the first BDF2 step


def step_euler(fiber: Fiber, now: Shape, dt: float, force: Array | None = None) -> Shape:
    """Linearly implicit Euler: h = dt, base = guess = x_n, carried tension lambda_n."""
    problem = linearize(fiber, dt, now.node_pos, now.node_pos, now.tension, force)
    return solve_step(problem)


def start_bdf2(fiber: Fiber, now: Shape, dt: float, force: Array | None = None) -> Shape:
    """The first step of BDF2: 20 LI-Euler steps of dt/20."""
    for _ in range(START_STEPS):
        now = step_euler(fiber, now, dt / START_STEPS, force)
    return now


def step_bdf2(
    fiber: Fiber, now: Shape, before: Shape, dt: float, force: Array | None = None
) -> Shape:
    """h = 2 dt/3, base (4 x_n - x_{n-1})/3, guess and tension extrapolated."""
    base = (4.0 * now.node_pos - before.node_pos) / 3.0
    guess = 2.0 * now.node_pos - before.node_pos
    tension = 2.0 * now.tension - before.tension
    return solve_step(linearize(fiber, 2.0 * dt / 3.0, base, guess, tension, force))


class Sdirk2Step(NamedTuple):
    """New shape, k_2 (n, 3) for the next guess, error estimate in fiber lengths."""

    shape: Shape
    velocity: Array
    error: float


def step_sdirk2(
    fiber: Fiber, now: Shape, dt: float, drift: Array | None = None, force: Array | None = None
) -> Sdirk2Step:
    """Both stages; `drift` (n, 3) is the velocity of the first guess, k_2 of the step before."""
    h = CHI * dt
    x = now.node_pos
    guess = x if drift is None else x + h * drift
    first = solve_step(linearize(fiber, h, x, guess, now.tension, force))
    moved = first.node_pos - x
    base = x + (1.0 - CHI) / CHI * moved
    guess = x + moved / CHI
    second = solve_step(linearize(fiber, h, base, guess, first.tension, force))
    k1, k2 = moved / h, (second.node_pos - base) / h
    error = h * np.linalg.norm(k2 - k1, axis=1).max() / fiber.chain.length
    return Sdirk2Step(second, k2, float(error))


def fixed_steps(fiber: Fiber, start: Shape, scheme: str, dt: float) -> Iterator[Shape]:
    """Shapes after 1, 2, ... steps of scheme `euler`, `bdf2`, `sdirk2` or `sdirk2_history`.

    `sdirk2` guesses with k_2 of the step before, `sdirk2_history` with (x_n - x_{n-1})/dt.
    """
    before, now = start, start
    drift: Array | None = None
    count = 0
    while True:
        if scheme == "euler":
            new = step_euler(fiber, now, dt)
        elif scheme == "bdf2":
            started = count > 0
            new = step_bdf2(fiber, now, before, dt) if started else start_bdf2(fiber, now, dt)
        else:
            new, drift, _ = step_sdirk2(fiber, now, dt, drift)
            if scheme == "sdirk2_history":
                drift = (new.node_pos - now.node_pos) / dt
        before, now = now, new
        count += 1
        yield now


def next_step(dt: float, error: float, tolerance: float, accepted: bool) -> float:
    """dt after a step of the given error: clip(0.85 sqrt(tol/e), 0.3, 2), less when rejected."""
    ratio = math.sqrt(tolerance / error) if error > 0.0 else math.inf
    return dt * (min(max(0.85 * ratio, 0.3), 2.0) if accepted else max(0.2, 0.8 * ratio))


class AdaptiveRun(NamedTuple):
    """Times (K,), shapes (K, n, 3) after accepted steps, number of rejected steps."""

    time: Array
    node_pos: Array
    rejected: int


def run_adaptive(
    fiber: Fiber, start: Shape, tolerance: float, dt: float, time_end: float, cap: float = math.inf
) -> AdaptiveRun:
    """SDIRK2 that accepts a step when error <= 1.5 tol; ends at `time_end` exactly."""
    now, time, rejected = start, 0.0, 0
    drift: Array | None = None
    times, path = [0.0], [start.node_pos]
    while time < time_end * (1.0 - 1e-12):
        dt = min(dt, cap)
        used = min(dt, time_end - time)
        new, k2, error = step_sdirk2(fiber, now, used, drift)
        accepted = error <= 1.5 * tolerance
        if accepted:
            now, drift, time = new, k2, time + used
            times.append(time)
            path.append(now.node_pos)
        else:
            rejected += 1
        dt = next_step(used, error, tolerance, accepted)
    return AdaptiveRun(np.array(times), np.array(path), rejected)


def start_along_x(fiber: Fiber) -> Shape:
    """Straight fiber on the x axis about the origin, without tension."""
    return Shape(straight_nodes(fiber.chain, (1, 0, 0), (0, 0, 0)), np.zeros(fiber.chain.segments))


def shear_fiber(chain: object, form: str = "primal") -> Fiber:
    """Fiber in u = (z, 0, 0)."""
    return Fiber(chain, shear_gradient(1.0), form)  # type: ignore[arg-type]


def half_turn(
    fiber: Fiber,
    scheme: str,
    dt: float,
    time_end: float,
    watch: Callable[[float, Shape], None] | None = None,
) -> float:
    """Time at which the end-to-end vector crosses -x, started along x; nan if it does not.

    Inside the step by the parabola through the last three values of z. `watch` sees every shape.
    """
    start = start_along_x(fiber)
    values = [0.0]
    for k, shape in enumerate(fixed_steps(fiber, start, scheme, dt), start=1):
        if watch is not None:
            watch(k * dt, shape)
        span = shape.node_pos[-1] - shape.node_pos[0]
        values.append(span[2])
        if span[0] < 0.0 and values[-2] < 0.0 <= values[-1]:
            return (k - 1) * dt + dt * parabola_root(*values[-3:])
        if not np.isfinite(span[2]) or k * dt >= time_end:
            break
    return math.nan


def parabola_root(f0: float, f1: float, f2: float) -> float:
    """Zero in [0, 1] of the parabola with f(-1), f(0) < 0, f(1) >= 0, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(60):
        u = 0.5 * (low + high)
        if f1 + 0.5 * u * (f2 - f0) + 0.5 * u * u * (f2 - 2.0 * f1 + f0) < 0.0:
            low = u
        else:
            high = u
    return 0.5 * (low + high)
