"""Rows of the dual problem of contact: projected gradients and balance.

Source: projected gradients with the two Barzilai-Borwein steps in turn (BBPGD) for
        contact:      0 <= f  and  e = b + J delta(f) + y(f) >= 0, one of them an equality
        lubrication:  e = b + J delta(f) + C f = 0, any sign of f
    in the scaled unknowns x = f/m, m = (D + C)^(-1/2), of gradient m e:
        f <- max(0, f - alpha m^2 e);  alpha = dx.dx/dx.dg and dx.dg/dg.dg in turn, first 0.3
Symbols: w = m^2 weight of a row; dx.dx = sum df^2/w, dx.dg = sum df de, dg.dg = sum w de^2; D
    estimate of the diagonal of J S J^T, S response of the fibers; fault of a row, a length: |e|
    where f > 0 or lubrication (times D/(D + C)), else |min(e, 0)|.
    control: phase and number of updates as all threads read them, then what the next pass reads.
    Friction: F <- the part of F - alpha w_t S within |F| <= mu f, S slip in the plane of the row,
    w_t its weight; fault |F - F(alpha = 1)|/w_t. Coulomb's law is no gradient of anything: the
    steps are those of the same sums over f and F together.
Limits: rows in `chunks` runs whose sums are added in order, so the result does not depend on the
    number of workers. The forces of the smallest fault are kept.
"""

from functools import cache

import warp as wp

from warpfiber.laws.contact_compliance import make_contact_compliance
from warpfiber.laws.surface_slip import make_coulomb, make_surface_slip
from warpfiber.model import precision
from warpfiber.passes.precision import group_struct

FIRST_STEP = 0.3
START, GO, RESTORE, DONE = range(4)  # phases of the solve
# slots of `control`; UNSOLVED: solves so far that stopped at their limit
PHASE, UPDATES, NEXT_PHASE, NEXT_UPDATES, UNSOLVED = range(5)
CONTROL_SIZE = 5
SUMS = 4  # dx.dx, dx.dg, dg.dg, largest fault
BROKEN = 1e30  # the fault of a row that is not a number


@wp.func
def rows_begin(count: wp.int32, chunk: wp.int32, chunks: wp.int32) -> wp.int32:
    """First row of a chunk."""
    return wp.int32(wp.int64(count) * wp.int64(chunk) / wp.int64(chunks))


@cache
def make_dual_step(name: str, module: str = "unique", has_friction: bool = False):
    """Kernel `dual_step` (rows in chunks): the next forces, or the end of the solve."""
    real, vec3 = precision(name).real, precision(name).vec3
    coulomb_force = make_coulomb(name)
    zero, first_step = real(0.0), wp.constant(FIRST_STEP)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def dual_step(
        offset: wp.int32,
        chunks: wp.int32,
        most: wp.int32,
        tolerance: wp.float64,
        row_count: wp.array(dtype=wp.int32),
        row_compliance: wp.array(dtype=real),
        row_weight: wp.array(dtype=real),
        row_balance: wp.array(dtype=real),
        sums: wp.array(dtype=wp.float64),
        row_force: wp.array(dtype=real),
        row_best: wp.array(dtype=real),
        row_change: wp.array(dtype=real),
        best: wp.array(dtype=wp.float64),
        control: wp.array(dtype=wp.int32),
        row_normal: wp.array(dtype=vec3),
        row_friction: wp.array(dtype=vec3),
        row_mu: wp.array(dtype=real),
        row_slip_weight: wp.array(dtype=real),
        row_slip_now: wp.array(dtype=vec3),
        row_friction_best: wp.array(dtype=vec3),
        row_friction_change: wp.array(dtype=vec3),
    ):
        phase = control[wp.static(PHASE)]
        if phase == wp.static(DONE):
            return
        chunk = wp.tid() + offset
        updates = control[wp.static(UPDATES)]
        moved = wp.float64(0.0)  # dx.dx
        mixed = wp.float64(0.0)  # dx.dg
        turned = wp.float64(0.0)  # dg.dg
        fault = wp.float64(0.0)
        alpha = wp.float64(first_step)
        least = best[0]
        following = wp.int32(wp.static(GO))
        keeps = wp.bool(False)
        if phase == wp.static(RESTORE):
            following = wp.static(DONE)
        if phase == wp.static(GO):
            for k in range(sums.shape[0] // wp.static(SUMS)):
                moved += sums[wp.static(SUMS) * k]
                mixed += sums[wp.static(SUMS) * k + 1]
                turned += sums[wp.static(SUMS) * k + 2]
                fault = wp.max(fault, sums[wp.static(SUMS) * k + 3])
            keeps = fault < least
            least = wp.min(fault, least)
            if fault < tolerance:
                following = wp.static(DONE)
            elif updates == most:
                following = wp.static(RESTORE)
                if keeps:
                    following = wp.static(DONE)
            if updates % 2 == 0:
                moved = mixed
                mixed = turned
            if moved > wp.float64(0.0) and mixed > wp.float64(0.0):
                alpha = moved / mixed
        runs = phase == wp.static(GO) and following == wp.static(GO)
        if chunk == 0:
            control[wp.static(NEXT_PHASE)] = following
            if runs:
                control[wp.static(NEXT_UPDATES)] = updates + 1
            elif phase == wp.static(GO) and not (fault < tolerance):
                control[wp.static(UNSOLVED)] = control[wp.static(UNSOLVED)] + 1
            best[1] = least
        if not runs and following != wp.static(RESTORE):
            return
        count = row_count[0]
        scale = real(alpha)
        for r in range(rows_begin(count, chunk, chunks), rows_begin(count, chunk + 1, chunks)):
            if runs:
                force = row_force[r]
                if keeps:
                    row_best[r] = force
                new = force - scale * row_weight[r] * row_balance[r]
                if row_compliance[r] == zero:
                    new = wp.max(new, zero)
                row_change[r] = new - force
                row_force[r] = new
                if wp.static(has_friction):
                    flat = row_friction[r]
                    if keeps:
                        row_friction_best[r] = flat
                    tried = flat - (scale * row_slip_weight[r]) * row_slip_now[r]
                    tried = coulomb_force(tried, row_normal[r], row_mu[r] * new)
                    row_friction_change[r] = tried - flat
                    row_friction[r] = tried
            else:
                row_force[r] = row_best[r]
                if wp.static(has_friction):
                    row_friction[r] = row_friction_best[r]

    return dual_step


@cache
def make_dual_balance(
    name: str, law: str, by_ends: bool, module: str = "unique", has_friction: bool = False
):
    """Kernel `dual_balance` (rows in chunks): e of every row and the sums for the next step.

    `by_ends`: how far the two ends of a row moved along it is in `end_move`, not in `node_shift`,
    and what they move by a unit force of their own in `end_diagonal` where that is known (else 0);
    it is taken for D before the first update if it is more than the estimate.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    opening, _ = make_contact_compliance(name, law)
    surface_turn, surface_roll, _ = make_surface_slip(name)
    coulomb_force = make_coulomb(name)
    zero, one = real(0.0), real(1.0)
    broken = real(BROKEN)

    @wp.func
    def surface_motion(
        n: vec3,
        node: wp.int32,
        fraction: real,
        sign: real,
        radius: real,
        turned: real,
        node_start: wp.array(dtype=vec3),
        node_shift: wp.array(dtype=vec3),
    ) -> vec3:
        """What the motion of a fiber adds to the slip at a row."""
        edge = node_start[node + 1] - node_start[node]
        length = wp.length(edge)
        axis = edge / length
        turn = node_shift[node + 1] - node_shift[node]
        slip = sign * (node_shift[node] + fraction * turn)
        slip += surface_turn(n, axis, radius / length, turn)
        return slip + turned * surface_roll(n, axis, radius)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def dual_balance(
        offset: wp.int32,
        chunks: wp.int32,
        stiffness: real,
        decay: real,
        row_count: wp.array(dtype=wp.int32),
        row_node: wp.array(dtype=wp.vec2i),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_base: wp.array(dtype=real),
        row_compliance: wp.array(dtype=real),
        row_contact: wp.array(dtype=real),
        row_weight: wp.array(dtype=real),
        row_force: wp.array(dtype=real),
        row_change: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        row_end: wp.array(dtype=wp.int32),
        end_move: wp.array(dtype=real),
        end_diagonal: wp.array(dtype=real),
        row_balance: wp.array(dtype=real),
        sums: wp.array(dtype=wp.float64),
        best: wp.array(dtype=wp.float64),
        control: wp.array(dtype=wp.int32),
        going: wp.array(dtype=wp.int32),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        node_start: wp.array(dtype=vec3),
        fiber_turn: wp.array(dtype=real),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_slip: wp.array(dtype=vec3),
        row_friction: wp.array(dtype=vec3),
        row_mu: wp.array(dtype=real),
        row_slip_weight: wp.array(dtype=real),
        row_slip_now: wp.array(dtype=vec3),
        row_friction_change: wp.array(dtype=vec3),
    ):
        chunk = wp.tid() + offset
        phase = control[wp.static(NEXT_PHASE)]
        if chunk == 0:
            control[wp.static(PHASE)] = phase
            control[wp.static(UPDATES)] = control[wp.static(NEXT_UPDATES)]
            best[0] = best[1]
            if phase == wp.static(DONE):
                going[0] = 0
        if phase != wp.static(GO):
            return
        count = row_count[0]
        first = control[wp.static(NEXT_UPDATES)] == 0
        moved = wp.float64(0.0)
        mixed = wp.float64(0.0)
        turned = wp.float64(0.0)
        worst = real(0.0)
        for r in range(rows_begin(count, chunk, chunks), rows_begin(count, chunk + 1, chunks)):
            e = row_base[r]
            if wp.static(by_ends):
                e += end_move[row_end[2 * r]]
                if row_end[2 * r + 1] >= 0:
                    e += end_move[row_end[2 * r + 1]]
            else:
                node = row_node[r]
                s = row_s[r]
                move = -(one - s) * node_shift[node[0]] - s * node_shift[node[0] + 1]
                if node[1] >= 0:
                    t = row_t[r]
                    move += (one - t) * node_shift[node[1]] + t * node_shift[node[1] + 1]
                e += wp.dot(row_normal[r], move)
            force = row_force[r]
            soft = row_compliance[r]
            weight = row_weight[r]
            if wp.static(by_ends):
                if first and weight > zero:
                    known = end_diagonal[row_end[2 * r]]
                    if row_end[2 * r + 1] >= 0:
                        known += end_diagonal[row_end[2 * r + 1]]
                    weight = one / wp.max(one / weight, known)
                    row_weight[r] = weight
            fault = zero
            if soft > zero:
                e += soft * force
                fault = wp.abs(e) * (one - soft * weight)
            else:
                contact = zero
                if wp.static(law == "exponential"):
                    contact = row_contact[r]
                e += opening(stiffness, decay, contact, force)
                fault = wp.abs(e)
                if force == zero:
                    fault = -wp.min(e, zero)
            if not (fault < broken) or wp.isnan(e):
                fault = broken
            de = wp.float64(e - row_balance[r])
            df = wp.float64(row_change[r])
            row_balance[r] = e
            if weight > zero:  # else nothing that the row touches can move
                worst = wp.max(worst, fault)
                moved += df * df / wp.float64(weight)
                mixed += df * de
                turned += wp.float64(weight) * de * de
            if wp.static(has_friction):
                mu = row_mu[r]
                if mu > zero:
                    n = row_normal[r]
                    both = row_node[r]
                    fiber = segment_fiber[row_i[r]]
                    radius = groups[fiber_group[fiber]].radius
                    slip = row_slip[r]
                    slip += surface_motion(
                        n,
                        both[0],
                        row_s[r],
                        -one,
                        radius,
                        fiber_turn[fiber],
                        node_start,
                        node_shift,
                    )
                    if both[1] >= 0:
                        fiber = segment_fiber[row_j[r]]
                        radius = groups[fiber_group[fiber]].radius
                        slip += surface_motion(
                            n,
                            both[1],
                            row_t[r],
                            one,
                            radius,
                            fiber_turn[fiber],
                            node_start,
                            node_shift,
                        )
                    slip -= wp.dot(n, slip) * n
                    grip = row_slip_weight[r]
                    flat = row_friction[r]
                    wanted = coulomb_force(flat - grip * slip, n, mu * force)
                    missed = wp.length(wanted - flat) / grip
                    if not (missed < broken):
                        missed = broken
                    worst = wp.max(worst, missed)
                    more = wp.vec3d(row_friction_change[r])
                    slid = wp.vec3d(slip - row_slip_now[r])
                    moved += wp.dot(more, more) / wp.float64(grip)
                    mixed += wp.dot(more, slid)
                    turned += wp.float64(grip) * wp.dot(slid, slid)
                    row_slip_now[r] = slip
        sums[wp.static(SUMS) * chunk] = moved
        sums[wp.static(SUMS) * chunk + 1] = mixed
        sums[wp.static(SUMS) * chunk + 2] = turned
        sums[wp.static(SUMS) * chunk + 3] = wp.float64(worst)

    return dual_balance


@cache
def make_fold_sums(module: str = "unique"):
    """Kernel `fold_sums`: the sums of many chunks as those of `folds` runs of them."""

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def fold_sums(
        chunks: wp.int32,
        folds: wp.int32,
        sums: wp.array(dtype=wp.float64),
        control: wp.array(dtype=wp.int32),
        folded: wp.array(dtype=wp.float64),
    ):
        if control[wp.static(PHASE)] != wp.static(GO):
            return
        fold = wp.tid()
        total = wp.vec3d()
        worst = wp.float64(0.0)
        for k in range(rows_begin(chunks, fold, folds), rows_begin(chunks, fold + 1, folds)):
            at = wp.static(SUMS) * k
            total += wp.vec3d(sums[at], sums[at + 1], sums[at + 2])
            worst = wp.max(worst, sums[at + 3])
        at = wp.static(SUMS) * fold
        folded[at] = total[0]
        folded[at + 1] = total[1]
        folded[at + 2] = total[2]
        folded[at + 3] = worst

    return fold_sums
