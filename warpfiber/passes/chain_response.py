"""Motion of flexible fibers by forces on their contact rows, with the factors of the step.

Source: the linear response of SDIRK2 to forces that are constant over the step, linearized where
    its second stage is (`chain_solve`, block LDL^T factors in `rows`):
        A y = h F,   A shift = h F + c (R + T) y,   h = chi dt,  c = (1 - chi)/chi
    Soft modes move by dt F/R, stiff ones by F/K; a fiber of given length keeps it. The impulse of
    the second solve over h is the tension that the forces cause.
Symbols: F node forces, R drag, T resistance to turning, A = R + T + h (...) with the tension as an
    unknown; v = D^-1 L^-1 (right side) of a node, vt of its impulse.
Limits: T here takes segments at their rest length, which leaves the response symmetric.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from warpfiber.laws.chain_terms import make_chain_terms
from warpfiber.model import HALT, Model, precision
from warpfiber.passes.chain_solve import CHI
from warpfiber.passes.dual_rows import DONE, NEXT_PHASE
from warpfiber.passes.elimination import elimination_row, make_sym_algebra
from warpfiber.passes.executor import Launch
from warpfiber.passes.precision import group_struct
from warpfiber.passes.unilateral import ContactDual


@cache
def make_chain_response(name: str, has_frozen: bool) -> Any:
    """Kernel `chain_response`, one thread per fiber: forces gathered, two solves, shift."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    Row = elimination_row(name)
    drag_diagonal, _, _ = make_chain_terms(name)
    sym_mul, _ = make_sym_algebra(name)
    zero, one = real(0.0), real(1.0)
    chi, again = real(CHI), real((1.0 - CHI) / CHI)

    @wp.func
    def gather(
        fiber: wp.int32,
        first: wp.int32,
        segments: wp.int32,
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        node_push: wp.array(dtype=vec3),
    ) -> wp.bool:
        """Forces of the rows on the nodes; whether there are any."""
        r = fiber_in[fiber]
        pushed = wp.bool(False)
        behind = vec3()
        for k in range(segments):
            segment = first - fiber + k
            here = behind
            behind = vec3()
            for own in range(row_out_start[segment], row_out_start[segment + 1]):
                force = row_force[own]
                if force != zero:
                    pushed = True
                    push = force * row_normal[own]
                    here -= (one - row_s[own]) * push
                    behind -= row_s[own] * push
            while r >= 0 and row_j[wp.max(r, 0)] == segment:
                force = row_force[r]
                if force != zero:
                    pushed = True
                    push = force * row_normal[r]
                    here += (one - row_t[r]) * push
                    behind += row_t[r] * push
                r = row_next[r]
            node_push[first + k] = here
        node_push[first + segments] = behind
        return pushed

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def chain_response(
        offset: wp.int32,
        row_stride: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        rows: wp.array(dtype=Row),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        control: wp.array(dtype=wp.int32),
        node_push: wp.array(dtype=vec3),
        node_reply: wp.array(dtype=vec3),
        reply_impulse: wp.array(dtype=real),
        segment_impulse: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
    ):
        if control[wp.static(NEXT_PHASE)] == wp.static(DONE):
            return
        fiber = wp.tid() + offset
        first = fiber_node_start[fiber]
        segments = fiber_node_start[fiber + 1] - first - 1
        begin = row_out_start[first - fiber]
        if begin == row_out_start[first - fiber + segments] and fiber_in[fiber] < 0:
            return
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                return
        pushed = gather(
            fiber,
            first,
            segments,
            row_out_start,
            fiber_in,
            row_next,
            row_j,
            row_s,
            row_t,
            row_normal,
            row_force,
            node_push,
        )
        if not pushed:
            for i in range(first, first + segments + 1):
                node_shift[i] = vec3()
            for segment in range(first - fiber, first - fiber + segments):
                segment_impulse[segment] = zero
            return
        g = groups[fiber_group[fiber]]
        h = chi * real(step_size[0])
        base = row_stride * fiber
        kappa = h * g.bending / (g.rest * g.rest)
        drag_end = again * g.drag * drag_diagonal(g.spacing, 0, segments)
        drag_inner = again * g.drag * drag_diagonal(g.spacing, 1, 2)
        drag_off = again * g.drag * g.coupling
        strength = again * g.torque / (g.rest * g.rest)
        for stage in range(2):
            # Forward: r, then v = D^-1 L^-1 r; z0, z1, z2 are the displacements of stage 0 of the
            # nodes k - 1, k, k + 1, couple that of the segment before node k on it.
            y1 = vec3()
            yt1 = zero
            v1 = vec3()
            v2 = vec3()
            n_before = vec3()
            couple = vec3()
            z0 = vec3()
            z1 = vec3()
            if stage == 1:
                z1 = node_reply[first]
            for k in range(segments + 1):
                i = first + k
                row = rows[base + k]
                r = h * node_push[i]
                if stage == 1:
                    drag = drag_inner
                    if k == 0 or k == segments:
                        drag = drag_end
                    r += drag * z1 + drag_off * z0 + couple
                    if k < segments:
                        z2 = node_reply[i + 1]
                        weight = g.weight
                        if k == 0:
                            weight += g.weight_excess
                        if k == segments - 1:
                            weight += g.weight_excess
                        turn = z2 - z1
                        couple = (strength * weight) * (turn - wp.dot(row.axis, turn) * row.axis)
                        r += drag_off * z2 - couple
                        z0 = z1
                        z1 = z2
                y = r - vec3(wp.dot(row.l0, y1), wp.dot(row.l1, y1), wp.dot(row.l2, y1))
                y -= yt1 * row.lt + kappa * v2
                yt = wp.dot(n_before, v1)
                v2 = v1
                v1 = sym_mul(row.diagonal, row.off, y) + yt * row.q
                node_reply[i] = v1
                reply_impulse[i] = wp.dot(row.q, y) + yt * row.s
                y1 = y
                yt1 = yt
                n_before = row.axis
            # Backward, as in the step itself.
            z1 = vec3()
            z2 = vec3()
            l0 = vec3()
            l1 = vec3()
            l2 = vec3()
            lt = vec3()
            impulse = zero
            for at in range(segments + 1):
                i = first + segments - at
                row = rows[base + segments - at]
                push = impulse * row.axis - kappa * z2
                z = node_reply[i] + sym_mul(row.diagonal, row.off, push)
                z -= z1[0] * l0 + z1[1] * l1 + z1[2] * l2
                impulse = reply_impulse[i] + wp.dot(row.q, push) - wp.dot(lt, z1)
                l0 = row.l0
                l1 = row.l1
                l2 = row.l2
                lt = row.lt
                z2 = z1
                z1 = z
                if stage == 0:
                    node_reply[i] = z
                else:
                    node_shift[i] = z
                    if at < segments:
                        segment_impulse[i - fiber - 1] = impulse

    return chain_response


@cache
def make_chain_apply(name: str) -> Any:
    """Kernel `chain_apply`, one thread per fiber: moved by its shift, tensions added.

    `carried`: share of the shift's velocity that `node_velocity` takes up.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    chi = real(CHI)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def chain_apply(
        offset: wp.int32,
        carried: real,
        step_size: wp.array(dtype=wp.float64),
        fiber_node_start: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_count: wp.array(dtype=wp.int32),
        node_shift: wp.array(dtype=vec3),
        segment_impulse: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0 or row_count[0] == 0:
            return
        fiber = wp.tid() + offset
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        begin = row_out_start[first - fiber]
        if begin == row_out_start[last - fiber] and fiber_in[fiber] < 0:
            return
        dt = real(step_size[0])
        for i in range(first, last + 1):
            node_pos[i] = node_pos[i] + node_shift[i]
            node_velocity[i] = node_velocity[i] + (carried / dt) * node_shift[i]
            if i < last:
                tension[i - fiber] = tension[i - fiber] + segment_impulse[i - fiber] / (chi * dt)

    return chain_apply


@dataclass
class ChainResponse:
    """The response of a cell of flexible fibers; `ContactDual` takes an instance.

    rows, row_stride: factors of every fiber, as `chain_solve` left them (row_stride > 0).
    """

    model: Model
    rows: Any
    row_stride: int
    tension: Any

    def __post_init__(self) -> None:
        model, p, device = self.model, self.model.precision, self.model.device
        self.node_push = wp.zeros(model.node_count, dtype=p.vec3, device=device)
        self.node_reply = wp.zeros(model.node_count, dtype=p.vec3, device=device)
        self.reply_impulse = wp.zeros(model.node_count, dtype=p.real, device=device)
        self.segment_impulse = wp.zeros(model.segment_count, dtype=p.real, device=device)

    def __call__(self, dual: ContactDual) -> Launch:
        """The launch that makes `node_shift` of the row forces."""
        model, rows = dual.model, dual.rows
        inputs = [
            self.row_stride,
            dual.step_size,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            dual.fiber_frozen,
            self.rows,
            rows.row_out_start,
            dual.fiber_in,
            dual.row_next,
            rows.row_j,
            rows.row_s,
            rows.row_t,
            rows.row_normal,
            rows.row_force,
            dual.control,
            self.node_push,
            self.node_reply,
            self.reply_impulse,
            self.segment_impulse,
            dual.node_shift,
        ]
        kernel = make_chain_response(model.precision.name, dual.has_frozen)
        return Launch("chain_response", kernel, model.fiber_count, inputs, split=True)

    def apply(self, dual: ContactDual, carried: float = 0.0) -> Launch:
        """Moves the fibers by the solution."""
        model, state = dual.model, dual.state
        inputs = [
            carried,
            dual.step_size,
            model.fiber_node_start,
            dual.rows.row_out_start,
            dual.fiber_in,
            dual.rows.row_count,
            dual.node_shift,
            self.segment_impulse,
            state.status,
            state.node_pos,
            state.node_velocity,
            self.tension,
        ]
        kernel = make_chain_apply(model.precision.name)
        return Launch("chain_apply", kernel, model.fiber_count, inputs, split=True)


def bytes_per_node(real: int) -> int:
    """Bytes per node of the arrays of `ChainResponse`, for reals of `real` bytes."""
    return 8 * real
