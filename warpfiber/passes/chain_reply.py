"""Motion of one flexible fiber by forces on its nodes, with the factors of the step.

Source: the linear response of SDIRK2 to forces that are constant over the step, linearized where
    its second stage is (`chain_solve`, block LDL^T factors in `rows`):
        A y = h F,   A shift = h F + c (R + T) y,   h = chi dt,  c = (1 - chi)/chi
    Soft modes move by dt F/R, stiff ones by F/K; a fiber of given length keeps it. The impulse of
    the second solve over h is the tension that the forces cause.
Symbols: F node forces, R drag, T resistance to turning, A = R + T + h (...) with the tension as an
    unknown; v = D^-1 L^-1 (right side) of a node, vt of its impulse.
Limits: T here takes segments at their rest length, which leaves the response symmetric.
"""

from functools import cache

import warp as wp

from warpfiber.laws.chain_terms import make_chain_terms
from warpfiber.model import precision
from warpfiber.passes.chain_solve import CHI
from warpfiber.passes.elimination import elimination_row, make_sym_algebra
from warpfiber.passes.precision import group_struct


@cache
def make_reply_numbers(name: str):
    """`reply_numbers(group, dt, segments)`: what a step multiplies the terms of a fiber by."""
    real = precision(name).real
    Group = group_struct(name)
    drag_diagonal, _, _ = make_chain_terms(name)
    chi, again = real(CHI), real((1.0 - CHI) / CHI)

    @wp.struct
    class Numbers:
        h: real
        kappa: real  # of bending
        drag_end: real
        drag_inner: real
        drag_off: real
        strength: real  # of turning

    @wp.func
    def reply_numbers(g: Group, dt: real, segments: wp.int32) -> Numbers:
        n = Numbers()
        n.h = chi * dt
        n.kappa = n.h * g.bending / (g.rest * g.rest)
        n.drag_end = again * g.drag * drag_diagonal(g.spacing, 0, segments)
        n.drag_inner = again * g.drag * drag_diagonal(g.spacing, 1, 2)
        n.drag_off = again * g.drag * g.coupling
        n.strength = again * g.torque / (g.rest * g.rest)
        return n

    return reply_numbers


@cache
def make_chain_reply(name: str):
    """`chain_reply`: `node_shift` and `segment_impulse` of one fiber by its `node_push`."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    Row = elimination_row(name)
    reply_numbers = make_reply_numbers(name)
    sym_mul, _ = make_sym_algebra(name)
    zero = real(0.0)

    @wp.func
    def chain_reply(
        fiber: wp.int32,
        first: wp.int32,
        segments: wp.int32,
        base: wp.int32,
        dt: real,
        g: Group,
        rows: wp.array(dtype=Row),
        node_push: wp.array(dtype=vec3),
        node_reply: wp.array(dtype=vec3),
        reply_impulse: wp.array(dtype=real),
        segment_impulse: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
    ):
        n = reply_numbers(g, dt, segments)
        h = n.h
        kappa = n.kappa
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
                    drag = n.drag_inner
                    if k == 0 or k == segments:
                        drag = n.drag_end
                    r += drag * z1 + n.drag_off * z0 + couple
                    if k < segments:
                        z2 = node_reply[i + 1]
                        weight = g.weight
                        if k == 0:
                            weight += g.weight_excess
                        if k == segments - 1:
                            weight += g.weight_excess
                        turn = z2 - z1
                        couple = (n.strength * weight) * (turn - wp.dot(row.axis, turn) * row.axis)
                        r += n.drag_off * z2 - couple
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

    return chain_reply


@cache
def make_gather_push(name: str):
    """`gather_push`: forces of its rows on the nodes of one fiber; whether there are any."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    zero, one = real(0.0), real(1.0)

    @wp.func
    def gather_push(
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

    return gather_push
