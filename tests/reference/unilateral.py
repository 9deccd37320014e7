"""Steps of rods and of flexible fibers that do not pass through each other or through walls.

Source: predictor without contact forces, rows at the start of the step, dual problem, applied
    forces. Rods: x_c += h U + h^2/2 G (U - U_flow), p normalized. Fibers: the same rows in
    displacements, delta = delta_free + A_h^-1 J^T (h f) with A_h the matrix of the step.
Symbols: rows, gaps and w_0 of contact_rows.py; h step; k stiffness of a linear penalty, C = 1/(hk).
Limits: one radius; walls do not move along their normal; first order in h.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from .contact_rows import (
    SAME_ARC,
    WALL,
    Line,
    Row,
    line_rows,
    lubrication_coefficient,
    lubrication_rows,
    rod_jacobian,
    rod_mobility,
    rod_rows,
    wall_rows,
)
from .dual import Dual, Solution, make_dual, solve_sweeps
from .interactions import segment_beads
from .overdamped import Fiber, Shape, StepProblem, linearize, solve_step, step_response
from .rigid_rod import Array, Rods, map_rods
from .segments import Segments, list_segments, own_fiber_excluded

Solver = Callable[[Dual], Solution]


def sweep_tightly(dual: Dual) -> Solution:
    """Projected Gauss-Seidel to 1e-12 of a length."""
    return solve_sweeps(dual, 1e-12)


@dataclass(frozen=True)
class Obstacles:
    """What stands in the way and how hard it is."""

    reach: float = 0.5  # rows with a smaller predicted gap are kept
    search: float = 4.0  # and only those with a smaller gap are looked at
    walls: tuple[tuple[Sequence[float], Sequence[float]], ...] = ()  # (point, inward normal)
    lattice: Array | None = None  # columns are box vectors
    stiffness: float | None = None  # k of a linear penalty; None: hard
    lubricated: bool = False
    solver: Solver = field(default=sweep_tightly)


class RodStep(NamedTuple):
    """Rods after a step, the rows that were kept and their forces."""

    rods: Rods
    rows: list[Row]
    force: Array


def rod_candidates(rods: Rods, gradient: Array, obstacles: Obstacles) -> list[Row]:
    """Contact rows with rods and walls, then lubrication rows."""
    rows = rod_rows(rods, obstacles.search, gradient, obstacles.lattice)
    for point, inward in obstacles.walls:
        rows += wall_rows(rods, point, inward, obstacles.search)
    if obstacles.lubricated:
        rows += lubrication_rows(rods, gradient, obstacles.lattice)
    return rows


def keep_near(rows: list[Row], approach: Array, reach: float) -> list[Row]:
    """Lubrication rows and contact rows with gap + `approach` (R,) below `reach`."""
    return [
        row
        for row, moved in zip(rows, approach, strict=True)
        if row.coefficient > 0.0 or row.gap + moved < reach
    ]


def drifts(rows: list[Row]) -> Array:
    """w_0 of the rows; (R,)."""
    return np.array([row.drift for row in rows])


def row_dual(
    rows: list[Row], delassus: Array, free: Array, h: float, stiffness: float | None
) -> Dual:
    """Dual of rows whose relative velocity without row forces is `free`."""
    return make_dual(
        delassus,
        free,
        np.array([row.gap for row in rows]),
        h,
        0.0 if stiffness is None else 1.0 / (h * stiffness),
        np.array([row.coefficient for row in rows]),
    )


def advance(rods: Rods, velocity: Array, flow: Array, gradient: Array, h: float) -> Rods:
    """Centers and directions after h at `velocity` (6F,), of which `flow` (6F,) is the map's."""
    count = len(rods.center)
    move, own = velocity.reshape(2, count, 3), flow.reshape(2, count, 3)
    center = rods.center + h * move[0] + 0.5 * h * h * (move[0] - own[0]) @ gradient.T
    axis = rods.axis + h * move[1]
    return rods._replace(center=center, axis=axis / np.linalg.norm(axis, axis=1)[:, None])


def step_rods(
    rods: Rods,
    gradient: Array,
    h: float,
    obstacles: Obstacles,
    load: Array | None = None,
    repeat: bool = False,
) -> RodStep:
    """One step in u = L x; `load` (F, 3) acts at the centers.

    `repeat`: rows are built again at the new state and push once more against what is left.
    """
    mobility = rod_mobility(rods)
    carried = map_rods(rods, gradient, h)
    parts = [carried.center - rods.center, carried.axis - rods.axis]
    flow = np.concatenate(parts).ravel() / h
    free = flow.copy()
    if load is not None:
        free[: load.size] += (load / rods.drag[:, None]).ravel()
    rows = rod_candidates(rods, gradient, obstacles)
    if rows:
        approach = h * (rod_jacobian(rods, rows) @ free + drifts(rows))
        rows = keep_near(rows, approach, obstacles.reach)
    jacobian = rod_jacobian(rods, rows)
    relative = jacobian @ free + drifts(rows)
    delassus = jacobian @ mobility @ jacobian.T
    force = obstacles.solver(row_dual(rows, delassus, relative, h, obstacles.stiffness)).force
    new = advance(rods, free + mobility @ jacobian.T @ force, flow, gradient, h)
    if repeat:
        again = [r for r in rod_candidates(new, gradient, obstacles) if r.coefficient == 0.0]
        again = keep_near(again, np.zeros(len(again)), obstacles.reach)
        jacobian, mobility = rod_jacobian(new, again), rod_mobility(new)
        delassus = jacobian @ mobility @ jacobian.T
        push = row_dual(again, delassus, np.zeros(len(again)), h, obstacles.stiffness)
        extra = mobility @ jacobian.T @ obstacles.solver(push).force
        new = advance(new, extra, np.zeros_like(extra), np.zeros((3, 3)), h)
    return RodStep(new, rows, force)


class FiberStep(NamedTuple):
    """Shapes of the fibers after a step, the rows that were kept and their forces."""

    shapes: list[Shape]
    rows: list[Row]
    force: Array


def segment_line(node_pos: Array, node: int) -> Line:
    """Center line of the segment from `node` to `node` + 1."""
    span = node_pos[node + 1] - node_pos[node]
    length = float(np.linalg.norm(span))
    return Line(0.5 * (node_pos[node] + node_pos[node + 1]), span / length, 0.5 * length)


def list_problems(problems: Sequence[StepProblem]) -> tuple[Array, Segments]:
    """Nodes x* (N, 3) and segments of all fibers."""
    starts = np.concatenate([[0], np.cumsum([len(p.guess) for p in problems])])
    return np.concatenate([p.guess for p in problems]), list_segments([int(k) for k in starts])


def count_once(rows: list[Row], seg: Segments, rest_length: Array, radius: float) -> list[Row]:
    """Contact rows without those near a row of a smaller gap, along both fibers.

    A contact at a joint belongs to up to four pairs of segments; it is one row.
    """
    kept: list[tuple[Row, int, int, float, float]] = []
    for row in sorted(rows, key=lambda r: r.gap):
        arcs = [
            seg.local[k] * rest_length[k] + arc
            for k, arc in ((row.i, row.arc_i), (row.j, row.arc_j))
        ]
        fibers = int(seg.fiber[row.i]), int(seg.fiber[row.j])
        if not any(
            (f, g) == fibers and max(abs(s - arcs[0]), abs(t - arcs[1])) < SAME_ARC * radius
            for _, f, g, s, t in kept
        ):
            kept.append((row, *fibers, *arcs))
    return [entry[0] for entry in kept]


def fiber_rows(problems: Sequence[StepProblem], obstacles: Obstacles) -> list[Row]:
    """Rows at x*; i and j are segments of the whole list. No periodic images."""
    x, seg = list_problems(problems)
    chain = problems[0].fiber.chain
    a = chain.radius
    lines = [segment_line(x, int(node)) for node in seg.node]
    beads = [
        segment_beads(problems[f].fiber.chain.spacing, bool(last))
        for f, last in zip(seg.fiber, seg.last, strict=True)
    ]
    rows: list[Row] = []
    wet: list[Row] = []
    for i in range(len(lines)):
        for j in range(i + 1, len(lines)):
            if seg.fiber[i] == seg.fiber[j]:
                p, q = int(seg.local[i]), int(seg.local[j])
                rest = problems[seg.fiber[i]].fiber.chain.rest_length
                if own_fiber_excluded(p, q, rest, a):
                    continue
            for s, t, normal, gap in line_rows(lines[i], lines[j], a):
                if gap < obstacles.search:
                    rows.append(Row(i, j, s, t, normal, gap))
            if obstacles.lubricated:
                wet += bead_rows(i, j, lines[i], lines[j], beads[i], beads[j], chain.viscosity, a)
    rests = np.array([problems[f].fiber.chain.rest_length for f in seg.fiber])
    rows = count_once(rows, seg, rests, a) + wet
    for point, inward in obstacles.walls:
        m = np.asarray(inward, float) / np.linalg.norm(inward)
        for i, line in enumerate(lines):
            ends = (-line.half, line.half) if seg.last[i] else (-line.half,)
            for s in ends:
                gap = float((line.middle + s * line.axis - np.asarray(point)) @ m) - a
                if gap < obstacles.search:
                    rows.append(Row(i, WALL, s, 0.0, -m, gap))
    return rows


def bead_rows(
    i: int,
    j: int,
    line_i: Line,
    line_j: Line,
    beads_i: tuple[Array, Array],
    beads_j: tuple[Array, Array],
    viscosity: float,
    radius: float,
) -> list[Row]:
    """Lubrication rows of the beads that two segments own, c times the weights of both."""
    rows = []
    for fraction_i, weight_i in zip(*beads_i, strict=True):
        for fraction_j, weight_j in zip(*beads_j, strict=True):
            s = float((2.0 * fraction_i - 1.0) * line_i.half)
            t = float((2.0 * fraction_j - 1.0) * line_j.half)
            apart = line_j.middle + t * line_j.axis - line_i.middle - s * line_i.axis
            distance = float(np.linalg.norm(apart))
            c = lubrication_coefficient(distance, radius, viscosity) * weight_i * weight_j
            if c > 0.0:
                rows.append(Row(i, j, s, t, apart / distance, 0.0, 0.0, float(c)))
    return rows


def node_jacobian(problems: Sequence[StepProblem], rows: Sequence[Row]) -> Array:
    """J (R, 3N): force f at fraction sigma goes to the nodes as (1 - sigma) f and sigma f."""
    x, seg = list_problems(problems)
    jacobian = np.zeros((len(rows), len(x), 3))
    for k, row in enumerate(rows):
        for segment, arc, sign in ((row.i, row.arc_i, -1.0), (row.j, row.arc_j, 1.0)):
            if segment != WALL:
                node = int(seg.node[segment])
                sigma = 0.5 + arc / np.linalg.norm(x[node + 1] - x[node])
                jacobian[k, node] += sign * (1.0 - sigma) * row.normal
                jacobian[k, node + 1] += sign * sigma * row.normal
    return jacobian.reshape(len(rows), 3 * len(x))


def solve_fibers(problems: Sequence[StepProblem], obstacles: Obstacles) -> FiberStep:
    """Steps of all fibers, one linear problem each with the same h, with row forces."""
    h = problems[0].h
    free = [solve_step(p) for p in problems]
    motion = np.concatenate(
        [(s.node_pos - p.guess).ravel() for s, p in zip(free, problems, strict=True)]
    )
    rows = fiber_rows(problems, obstacles)
    rows = keep_near(rows, node_jacobian(problems, rows) @ motion, obstacles.reach)
    jacobian = node_jacobian(problems, rows)
    edges = np.concatenate([[0], np.cumsum([p.guess.size for p in problems])])
    delassus = np.zeros((len(rows), len(rows)))
    for p, low, high in zip(problems, edges[:-1], edges[1:], strict=True):
        own = jacobian[:, low:high]
        delassus += own @ step_response(p, own.T)
    dual = row_dual(rows, delassus, jacobian @ motion / h, h, obstacles.stiffness)
    force = obstacles.solver(dual).force
    nodal = (jacobian.T @ force).reshape(-1, 3)
    shapes = [
        solve_step(p, nodal[low // 3 : high // 3])
        for p, low, high in zip(problems, edges[:-1], edges[1:], strict=True)
    ]
    return FiberStep(shapes, rows, force)


def step_fibers(
    fibers: Sequence[Fiber],
    shapes: Sequence[Shape],
    h: float,
    obstacles: Obstacles,
    loads: Sequence[Array] | None = None,
) -> FiberStep:
    """One LI-Euler step of flexible fibers; `loads` (n, 3) per fiber act at the nodes."""
    pushes = [None] * len(fibers) if loads is None else list(loads)
    problems = [
        linearize(f, h, s.node_pos, s.node_pos, s.tension, push)
        for f, s, push in zip(fibers, shapes, pushes, strict=True)
    ]
    return solve_fibers(problems, obstacles)
