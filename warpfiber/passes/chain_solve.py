"""One implicit step of every fiber: assemble, eliminate and substitute, one thread per fiber.

Source: linearly implicit steps of (R + T) v = R u + F_Omega - B x + F_lambda with the tension as a
    state variable. Unknowns of node i: displacement delta_i and the impulse Lambda = h lambda of
    the segment before it, C = 1/(h k_s) (0: inextensible):
        K_0 delta + G^T Lambda = r_0,  G delta - C Lambda = l - L*
    Block LDL^T of 4x4 blocks in this order; the second lower block is kappa I on the displacements.
    SDIRK2 (chi = 1 - 1/sqrt 2) takes two solves. Guess x* = x + a m, base x* - b m, a motion m:
        BDF2      h = 2/3 dt   a = 1      b = 2/3  m = last displacement    lambda* extrapolated
        SDIRK2 1  h = chi dt   a = h      b = h    m = last velocity        lambda* of the start
        SDIRK2 2  h = chi dt   a = 1/chi  b = 1    m = X_1 - x              lambda* of stage 1
Symbols: W lower block of a row as rows w0, w1, w2 and column wt of the impulse; L = W D^-1 alike;
    D^-1 = [[P, q], [q^T, s]], P symmetric as diagonal (xx, yy, zz) and off (xy, xz, yz).
    A held node has delta_i = h V - w: its inverse block keeps the impulse alone.
Limits: a pivot that is not positive (compression buckles within a step) repeats the solve without
    the negative tensions in the matrix: the same order, damped. `clips`: always without them.
"""

import math
from functools import cache

import warp as wp

from warpfiber.laws.chain_terms import make_chain_terms
from warpfiber.laws.flow import make_flow
from warpfiber.laws.torque import make_torque
from warpfiber.model import BAD_FIBER, HALT, TORN, precision
from warpfiber.passes.elimination import elimination_row, make_sym_algebra
from warpfiber.passes.held_nodes import FREE, FROZEN, make_held
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.passes.precision import group_struct

CHI = 1.0 - 1.0 / math.sqrt(2.0)
# LLVM's own limits of inlining and vectorizing; with those that Warp sets a solve takes 1/3 longer
OPTIONS = {"cpu_compiler_flags": "-march=native"}


@cache
def make_chain_step(name: str, loaded: bool = False, sheared: bool = False):
    """Kernel `chain_step`: one step of BDF2 (`stages` 1) or SDIRK2 (2) of every fiber.

    `loaded`: nodes have a force or, as `node_hold` says, a velocity in `node_load`, and frozen
    fibers are left to `carry_fibers`; `sheared`: stored images move with the flow.
    `keeps`: the state of the start is kept (1, 2); a tear is left to the error (2).
    `fiber_pace`: see `chain_pace`; `again`: only fibers of less than 1; `clips`: see Limits.
    `row_stride`: rows per fiber in `rows`; negative if all fibers of a launch share the first's.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    Row = elimination_row(name)
    flow_velocity, flow_spin = make_flow(name)
    torque_couple = make_torque(name)
    drag_diagonal, bending_entries, turning_resistance = make_chain_terms(name)
    sym_mul, block_inverse = make_sym_algebra(name)
    held_velocity, held_impulse = make_held(name, sheared)
    zero, one, two = real(0.0), real(1.0), real(2.0)
    tear, endless = real(TEAR_STRETCH), real(1.0e30)
    chi, inverse_chi, two_thirds = real(CHI), real(1.0 / CHI), real(2.0 / 3.0)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False, grid_stride=False)
    def chain_step(
        offset: wp.int32,
        stages: wp.int32,
        keeps: wp.int32,
        again: wp.int32,
        clips: wp.int32,
        row_stride: wp.int32,
        flow_origin: vec3,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        stage_gradient: wp.array(dtype=mat33),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=Row),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_motion: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
        tension_back: wp.array(dtype=real),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        fiber_error: wp.array(dtype=real),
        node_hold: wp.array(dtype=wp.uint8),
        node_load: wp.array(dtype=vec3),
        fiber_image: wp.array(dtype=wp.vec3i),
        lattice: wp.array(dtype=wp.mat33d),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        g = groups[fiber_group[fiber]]
        first = fiber_node_start[fiber]
        segments = g.segments
        dt = real(step_size[0])
        pace = fiber_pace[fiber]
        if again != 0 and pace == one:
            return
        # Rows of this fiber; where the fibers of a launch run one after the other they share them.
        base = wp.abs(row_stride) * offset
        if row_stride > 0:
            base = row_stride * fiber
        if wp.static(loaded):
            if wp.int32(node_hold[first]) == wp.static(FROZEN):
                return
        drag_end = g.drag * drag_diagonal(g.spacing, 0, segments)
        drag_inner = g.drag * drag_diagonal(g.spacing, 1, 2)
        drag_off = g.drag * g.coupling
        nothing = vec3(zero, zero, zero)
        stage = wp.int32(0)
        clipped = clips
        while stage < stages:
            from_velocity = stages == 2 and stage == 0
            h = two_thirds * dt
            a = one
            b = two_thirds
            if stages == 2:
                h = chi * dt
                a = h
                b = h
                if stage == 1:
                    a = inverse_chi
                    b = one
            gradient = stage_gradient[stage + 2 - stages]
            spin = h * flow_spin(gradient)
            settling = (h / g.drag) * g.body_force
            h_force = pace * h
            kappa = h_force * g.bending / (g.rest * g.rest)
            compliance = g.compliance / h_force
            # Forward. x0, x1, x2: guess of the nodes k, k + 1, k + 2; w: the guess minus the base;
            # e = h (u + settling) - w, edge = x1 - x0, c the second difference of the guess.
            m0 = node_motion[first]
            m1 = node_motion[first + 1]
            if from_velocity:
                m0 = node_velocity[first]
                m1 = node_velocity[first + 1]
            x0 = node_pos[first] + a * m0
            x1 = node_pos[first + 1] + a * m1
            w0 = b * m0
            w1 = b * m1
            e0 = h * flow_velocity(gradient, flow_origin, x0) + settling - w0
            e1 = h * flow_velocity(gradient, flow_origin, x1) + settling - w1
            edge = x1 - x0
            e_before = vec3(zero, zero, zero)
            c_before = vec3(zero, zero, zero)
            c_here = vec3(zero, zero, zero)
            n_before = vec3(zero, zero, zero)
            couple_before = vec3(zero, zero, zero)
            rho_before = zero
            gap_before = zero
            # Blocks of node k - 1 (1) and k - 2 (2), and rows of L of node k - 1.
            pd1 = vec3(zero, zero, zero)
            po1 = vec3(zero, zero, zero)
            q1 = vec3(zero, zero, zero)
            s1 = zero
            v1 = vec3(zero, zero, zero)
            vt1 = zero
            pd2 = vec3(zero, zero, zero)
            po2 = vec3(zero, zero, zero)
            v2 = vec3(zero, zero, zero)
            l0 = vec3(zero, zero, zero)
            l1 = vec3(zero, zero, zero)
            l2 = vec3(zero, zero, zero)
            t1 = vec3(zero, zero, zero)
            least = one
            for k in range(segments + 1):
                i = first + k
                n = vec3(zero, zero, zero)
                couple = vec3(zero, zero, zero)
                c_after = vec3(zero, zero, zero)
                e_after = vec3(zero, zero, zero)
                edge_after = vec3(zero, zero, zero)
                x2 = vec3(zero, zero, zero)
                w2 = vec3(zero, zero, zero)
                e2 = vec3(zero, zero, zero)
                rho = zero
                gap = zero
                if k < segments:
                    d = wp.length(edge)
                    inverse = one / d
                    n = inverse * edge
                    weight = g.weight
                    if k == 0:
                        weight += g.weight_excess
                    if k == segments - 1:
                        weight += g.weight_excess
                    pull = tension[i - fiber]
                    if stages == 1:
                        pull = two * pull - tension_back[i - fiber]
                    if clipped != 0:
                        pull = wp.max(pull, zero)
                    strength = g.torque * weight
                    rho = turning_resistance(strength, inverse, pull, h_force)
                    couple = torque_couple(strength, n, inverse, w1 - w0, spin)
                    gap = g.rest - d
                    e_after = e1
                    if k + 1 < segments:
                        m2 = node_motion[i + 2]
                        if from_velocity:
                            m2 = node_velocity[i + 2]
                        x2 = node_pos[i + 2] + a * m2
                        w2 = b * m2
                        e2 = h * flow_velocity(gradient, flow_origin, x2) + settling - w2
                        edge_after = x2 - x1
                        c_after = edge_after - edge

                drag = wp.where(k == 0 or k == segments, drag_end, drag_inner)
                bend = bending_entries(k, segments)
                r = drag * e0 + drag_off * (e_before + e_after)
                r += couple_before - couple
                r -= kappa * (c_before - two * c_here + c_after)
                if wp.static(loaded):
                    if wp.int32(node_hold[i]) == wp.static(FREE):
                        r += h_force * node_load[i]

                # W and L
                off = drag_off + kappa * bend[1] - rho_before
                u = rho_before * n_before
                w_0 = vec3(
                    off + u[0] * n_before[0] - kappa * l0[0],
                    u[0] * n_before[1] - kappa * l1[0],
                    u[0] * n_before[2] - kappa * l2[0],
                )
                w_1 = vec3(
                    u[1] * n_before[0] - kappa * l0[1],
                    off + u[1] * n_before[1] - kappa * l1[1],
                    u[1] * n_before[2] - kappa * l2[1],
                )
                w_2 = vec3(
                    u[2] * n_before[0] - kappa * l0[2],
                    u[2] * n_before[1] - kappa * l1[2],
                    off + u[2] * n_before[2] - kappa * l2[2],
                )
                wt = kappa * t1
                t = sym_mul(pd1, po1, n_before)
                l0 = sym_mul(pd1, po1, w_0) + wt[0] * q1
                l1 = sym_mul(pd1, po1, w_1) + wt[1] * q1
                l2 = sym_mul(pd1, po1, w_2) + wt[2] * q1
                lt = vec3(wp.dot(w_0, q1), wp.dot(w_1, q1), wp.dot(w_2, q1)) + s1 * wt

                # D and its inverse
                alpha = drag + kappa * bend[0] + rho_before + rho
                kappa2 = kappa * kappa
                diagonal = vec3(
                    alpha
                    - u[0] * n_before[0]
                    - rho * n[0] * n[0]
                    - wp.dot(l0, w_0)
                    - lt[0] * wt[0],
                    alpha
                    - u[1] * n_before[1]
                    - rho * n[1] * n[1]
                    - wp.dot(l1, w_1)
                    - lt[1] * wt[1],
                    alpha
                    - u[2] * n_before[2]
                    - rho * n[2] * n[2]
                    - wp.dot(l2, w_2)
                    - lt[2] * wt[2],
                )
                diagonal -= kappa2 * pd2
                cross = vec3(
                    -u[0] * n_before[1] - rho * n[0] * n[1] - wp.dot(l0, w_1) - lt[0] * wt[1],
                    -u[0] * n_before[2] - rho * n[0] * n[2] - wp.dot(l0, w_2) - lt[0] * wt[2],
                    -u[1] * n_before[2] - rho * n[1] * n[2] - wp.dot(l1, w_2) - lt[1] * wt[2],
                )
                cross -= kappa2 * po2
                along = n_before + vec3(
                    wp.dot(l0, n_before), wp.dot(l1, n_before), wp.dot(l2, n_before)
                )
                slack = one
                if k > 0:
                    slack = compliance + wp.dot(n_before, t)
                pd, po, q, s, sign = block_inverse(diagonal, cross, along, slack)
                if not (sign >= least):
                    least = sign

                # y, and v = D^-1 y
                y = r - vec3(wp.dot(w_0, v1), wp.dot(w_1, v1), wp.dot(w_2, v1))
                y -= vt1 * wt + kappa * v2
                yt = gap_before + wp.dot(n_before, v1)
                v = sym_mul(pd, po, y) + yt * q
                vt = wp.dot(q, y) + yt * s
                if wp.static(loaded):
                    if wp.int32(node_hold[i]) != wp.static(FREE):
                        time, image = wp.where(from_velocity, h, dt), fiber_image[fiber]
                        V = held_velocity(node_load[i], gradient, lattice[0], image, time)
                        v = h * V - w0
                        pd, po, q = nothing, nothing, nothing
                        s = held_impulse(slack)
                        vt = s * (yt - wp.dot(along, v))

                row = Row()
                row.diagonal = pd
                row.off = po
                row.q = q
                row.s = s
                row.l0 = l0
                row.l1 = l1
                row.l2 = l2
                row.lt = lt
                row.move = v
                row.impulse = vt
                row.axis = n
                rows[base + k] = row

                pd2 = pd1
                po2 = po1
                v2 = v1
                pd1 = pd
                po1 = po
                q1 = q
                s1 = s
                v1 = v
                vt1 = vt
                t1 = t
                e_before = e0
                e0 = e1
                e1 = e2
                w0 = w1
                w1 = w2
                x1 = x2
                edge = edge_after
                c_before = c_here
                c_here = c_after
                n_before = n
                couple_before = couple
                rho_before = rho
                gap_before = gap

            if not (least > zero) and clipped == 0:
                clipped = 1
            else:
                # Backward: displacements z1, z2 of the nodes k + 1, k + 2.
                final = stage + 1 == stages
                z1 = vec3(zero, zero, zero)
                z2 = vec3(zero, zero, zero)
                l0 = nothing
                l1 = nothing
                l2 = nothing
                lt = nothing
                impulse = zero
                x_after = vec3(zero, zero, zero)
                longest = zero
                furthest = zero
                for at in range(segments + 1):
                    k = segments - at
                    i = first + k
                    row = rows[base + k]
                    push = impulse * row.axis - kappa * z2
                    z = row.move + sym_mul(row.diagonal, row.off, push)
                    z -= z1[0] * l0 + z1[1] * l1 + z1[2] * l2
                    impulse = row.impulse + wp.dot(row.q, push) - wp.dot(lt, z1)
                    l0 = row.l0
                    l1 = row.l1
                    l2 = row.l2
                    lt = row.lt
                    z2 = z1
                    z1 = z
                    if k > 0:
                        segment = i - fiber - 1
                        if stage == 0:
                            tension_back[segment] = tension[segment]
                        tension[segment] = impulse / h_force
                    m = node_motion[i]
                    if from_velocity:
                        m = node_velocity[i]
                    move = a * m + z
                    if final:
                        x = node_pos[i]
                        if keeps != 0:
                            node_back[i] = x
                            velocity_back[i] = node_velocity[i]
                        x = x + move
                        node_pos[i] = x
                        node_velocity[i] = (b * m + z) / h
                        if at > 0:
                            d2 = wp.length_sq(x_after - x)
                            if not (d2 <= longest):
                                longest = d2
                        x_after = x
                        z_sq = wp.length_sq(z)
                        if not (z_sq <= furthest):
                            furthest = z_sq
                    node_motion[i] = move
                if final:
                    error = wp.sqrt(furthest) / (real(segments) * g.rest)
                    if not (longest < tear * tear * g.rest * g.rest):
                        error = endless
                        if keeps < 2:
                            status[wp.static(TORN)] = 1
                            status[wp.static(BAD_FIBER)] = fiber
                    fiber_error[fiber] = error
                stage += 1
                clipped = clips

    return chain_step
