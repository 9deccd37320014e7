"""One fiber without inertia: drag, torque, stretching, bending, the linear problem of a step.

Source: balance of bead drag 6 pi eta a and bead torque 8 pi eta a^3 on the unreduced chain,
    projected on hat functions; stretching k_s (L - l)^2/2 with the tension as a state variable;
    bending k_b/(2 l^2) sum |x_{i+1} - 2 x_i + x_{i-1}|^2 (straight rest shape), or k_b theta^2/2.
Symbols: R = zeta A (x) I_3 drag, T(x) = sum tau_s P_s (x) G_s torque, P = I - n n^T,
    G_s = [[1, -1], [-1, 1]] on the nodes of segment s, B bending matrix; lambda tension of a
    segment; h effective step, x* guess (`guess`), delta = x_new - x*; Lambda = h lambda;
    C = 1/(h k_s) compliance, 0 for segments that keep their length.
        (R + T) v = R u + F_Omega - B x + F_lambda + F
Limits: open fibers, u = L x, `consistent` drag only; twist is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .bead_chain import Array, Chain, segment_geometry
from .bead_chain import bending_force as angle_bending_force

FORMS = ("primal", "compliant", "inextensible")
BENDINGS = ("difference", "angle")


class Fiber(NamedTuple):
    """Constants of the motion of one fiber: chain, L of the flow, how tension is solved for."""

    chain: Chain
    gradient: Array  # (3, 3), u = L x
    form: str = "primal"
    bending: str = "difference"  # or "angle": k_b theta^2/2


class Shape(NamedTuple):
    """Positions (n, 3) and tensions (N_seg,) of one fiber."""

    node_pos: Array
    tension: Array


def segment_sum(blocks: Array) -> Array:
    """sum_s block_s (x) G_s for blocks (N_seg, 3, 3); (3n, 3n)."""
    count = len(blocks) + 1
    s = np.arange(count - 1)
    total = np.zeros((count, count, 3, 3))
    total[s, s] += blocks
    total[s + 1, s + 1] += blocks
    total[s, s + 1] -= blocks
    total[s + 1, s] -= blocks
    return total.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)


def outer(axis: Array) -> Array:
    """n n^T of unit vectors; (N_seg, 3, 3)."""
    return axis[:, :, None] * axis[:, None, :]


@lru_cache(maxsize=16)
def drag_matrix(chain: Chain) -> Array:
    """R = zeta A (x) I_3; (3n, 3n)."""
    return np.kron(chain.drag * chain.matrix, np.eye(3))


def torque_strength(chain: Chain, length: Array) -> Array:
    """tau_s = 8 pi eta a^3 c_s/L_s^2 with c_s beads of torque; (N_seg,)."""
    return 8.0 * np.pi * chain.viscosity * chain.radius**3 * chain.weights / length**2


def torque_matrix(chain: Chain, node_pos: Array) -> Array:
    """T = sum tau_s P_s (x) G_s, the damping of the turning of segments; (3n, 3n)."""
    axis, length = segment_geometry(node_pos)
    strength = torque_strength(chain, length)
    return segment_sum(strength[:, None, None] * (np.eye(3) - outer(axis)))


def torque_couple(chain: Chain, node_pos: Array, gradient: Array) -> Array:
    """F_Omega: tau_s Omega x d_s on node s + 1, the opposite on node s; (n, 3)."""
    _, length = segment_geometry(node_pos)
    spin = 0.5 * (gradient - gradient.T)
    couple = torque_strength(chain, length)[:, None] * ((node_pos[1:] - node_pos[:-1]) @ spin.T)
    force = np.zeros_like(node_pos)
    force[1:] += couple
    force[:-1] -= couple
    return force


def tension_force(axis: Array, tension: Array) -> Array:
    """lambda n on node s, the opposite on node s + 1; (n, 3)."""
    pull = tension[:, None] * axis
    force = np.zeros((len(axis) + 1, 3))
    force[:-1] += pull
    force[1:] -= pull
    return force


def second_difference(count: int) -> Array:
    """D_2, rows (1, -2, 1); (n - 2, n)."""
    rows = np.zeros((max(count - 2, 0), count))
    for i in range(count - 2):
        rows[i, i : i + 3] = 1.0, -2.0, 1.0
    return rows


@lru_cache(maxsize=16)
def bending_matrix(chain: Chain) -> Array:
    """B = k_b/l^2 D_2^T D_2 (x) I_3; (3n, 3n)."""
    d2 = second_difference(chain.segments + 1)
    return np.kron(chain.bending_stiffness / chain.rest_length**2 * (d2.T @ d2), np.eye(3))


def bending_energy(chain: Chain, node_pos: Array) -> float:
    """k_b/(2 l^2) sum |x_{i+1} - 2 x_i + x_{i-1}|^2."""
    bend = node_pos[2:] - 2.0 * node_pos[1:-1] + node_pos[:-2]
    return float(0.5 * chain.bending_stiffness / chain.rest_length**2 * np.sum(bend**2))


def bending_force(fiber: Fiber, node_pos: Array) -> Array:
    """-B x, or the gradient of k_b theta^2/2 of every joint; (n, 3)."""
    if fiber.bending == "angle":
        return angle_bending_force(fiber.chain, *segment_geometry(node_pos))
    return -(bending_matrix(fiber.chain) @ node_pos.ravel()).reshape(-1, 3)


def elastic_tension(chain: Chain, node_pos: Array) -> Array:
    """k_s (L_s - l); (N_seg,)."""
    _, length = segment_geometry(node_pos)
    return chain.stretching_stiffness * (length - chain.rest_length)


def elastic_matrix(chain: Chain, node_pos: Array, tension: Array) -> Array:
    """B + sum (lambda/L P + k_s n n^T) (x) G, minus the derivative of the elastic force."""
    axis, length = segment_geometry(node_pos)
    along = outer(axis)
    across = (tension / length)[:, None, None] * (np.eye(3) - along)
    return bending_matrix(chain) + segment_sum(across + chain.stretching_stiffness * along)


def velocity(fiber: Fiber, shape: Shape, force: Array | None = None) -> Array:
    """v (n, 3) of the balance of forces; `force` (n, 3) acts at the nodes."""
    chain, x = fiber.chain, shape.node_pos
    axis, _ = segment_geometry(x)
    drag = drag_matrix(chain)
    right = torque_couple(chain, x, fiber.gradient) + tension_force(axis, shape.tension)
    right = right if force is None else right + force
    right = right + bending_force(fiber, x)
    total = drag @ (x @ fiber.gradient.T).ravel() + right.ravel()
    return np.linalg.solve(drag + torque_matrix(chain, x), total).reshape(-1, 3)


@dataclass(frozen=True)
class StepProblem:
    """The linear problem of one step: K_0 delta + h sum lambda-terms = r_0."""

    fiber: Fiber
    h: float
    guess: Array  # x* (n, 3)
    axis: Array  # n_s at x*
    length: Array  # L_s at x*
    matrix: Array  # K_0 (3n, 3n), symmetric, without k_s n n^T
    right: Array  # r_0 (3n,), without the tension


def linearize(
    fiber: Fiber,
    h: float,
    base: Array,
    guess: Array,
    tension: Array,
    force: Array | None = None,
) -> StepProblem:
    """Linearization at x* = `guess` with carried `tension` of x = base + h v(x).

    Both bending laws keep B in the matrix, so it stays constant.
    """
    chain = fiber.chain
    axis, length = segment_geometry(guess)
    drag, bending = drag_matrix(chain), bending_matrix(chain)
    resist = drag + torque_matrix(chain, guess)
    across = (tension / length)[:, None, None] * (np.eye(3) - outer(axis))
    nodal = torque_couple(chain, guess, fiber.gradient) + bending_force(fiber, guess)
    nodal = nodal if force is None else nodal + force
    rate = drag @ (guess @ fiber.gradient.T).ravel() + nodal.ravel()
    return StepProblem(
        fiber,
        h,
        guess,
        axis,
        length,
        resist + h * (bending + segment_sum(across)),
        h * rate - resist @ (guess - base).ravel(),
    )


def stretch_rows(axis: Array) -> Array:
    """G, (G delta)_s = n_s.(delta_{s+1} - delta_s); (N_seg, 3n)."""
    count = len(axis)
    rows = np.zeros((count, count + 1, 3))
    s = np.arange(count)
    rows[s, s + 1] = axis
    rows[s, s] = -axis
    return rows.reshape(count, -1)


def compliance(problem: StepProblem) -> float:
    """C = 1/(h k_s), 0 for segments that keep their length."""
    if problem.fiber.form == "inextensible":
        return 0.0
    return 1.0 / (problem.h * problem.fiber.chain.stretching_stiffness)


def primal_system(problem: StepProblem) -> tuple[Array, Array]:
    """Matrix (3n, 3n) and right side (3n,) of the form without multipliers."""
    chain, h = problem.fiber.chain, problem.h
    matrix = problem.matrix + h * chain.stretching_stiffness * segment_sum(outer(problem.axis))
    stretch = chain.stretching_stiffness * (problem.length - chain.rest_length)
    return matrix, problem.right + h * tension_force(problem.axis, stretch).ravel()


def multiplier_system(problem: StepProblem) -> tuple[Array, Array]:
    """[[K_0, G^T], [G, -C]] and its right side, unknowns (delta, Lambda)."""
    chain = problem.fiber.chain
    rows = stretch_rows(problem.axis)
    corner = -compliance(problem) * np.eye(len(rows))
    matrix = np.block([[problem.matrix, rows.T], [rows, corner]])
    return matrix, np.concatenate([problem.right, chain.rest_length - problem.length])


def node_order(segments: int) -> Array:
    """Order x_0, x_1, Lambda_0, x_2, Lambda_1, ...: a multiplier comes after both its nodes."""
    nodes = segments + 1
    order = [0, 1, 2]
    for i in range(1, nodes):
        order += [3 * i, 3 * i + 1, 3 * i + 2, 3 * nodes + i - 1]
    return np.array(order)


def solve_step(problem: StepProblem, force: Array | None = None) -> Shape:
    """New shape; `force` (n, 3) acts at the nodes during the step, beside the one linearized."""
    chain, h = problem.fiber.chain, problem.h
    count = problem.guess.size
    extra = np.zeros(count) if force is None else h * force.ravel()
    if problem.fiber.form == "primal":
        matrix, right = primal_system(problem)
        delta = np.linalg.solve(matrix, right + extra)
        stretch = problem.length - chain.rest_length + stretch_rows(problem.axis) @ delta
        tension = chain.stretching_stiffness * stretch
    else:
        matrix, right = multiplier_system(problem)
        right[:count] += extra
        unknowns = np.linalg.solve(matrix, right)
        delta, tension = unknowns[:count], unknowns[count:] / h
    return Shape(problem.guess + delta.reshape(-1, 3), tension)


def step_response(problem: StepProblem, forces: Array) -> Array:
    """A_h^-1 F: displacement per effective step by nodal forces F (3n, K); (3n, K)."""
    count = problem.guess.size
    if problem.fiber.form == "primal":
        return np.linalg.solve(primal_system(problem)[0], forces)
    matrix, _ = multiplier_system(problem)
    padded = np.concatenate([forces, np.zeros((len(matrix) - count, forces.shape[1]))])
    return np.linalg.solve(matrix, padded)[:count]
