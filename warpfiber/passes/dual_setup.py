"""Before a solve of the dual problem: weights of the rows, warm start, lists by fiber.

Symbols: w = 1/(D + C) weight of a row, D estimate of the diagonal of J S J^T: what a rigid straight
    fiber of the same length would do. Rows in `chunks` runs.
Limits: a bent or soft fiber moves more than that; it only costs updates.
"""

from functools import cache

import warp as wp

from warpfiber.laws.contact_compliance import make_contact_compliance
from warpfiber.laws.rod_mobility import make_rod_mobility
from warpfiber.laws.surface_slip import make_coulomb
from warpfiber.model import HALT, precision
from warpfiber.passes.dual_rows import (
    BROKEN,
    DONE,
    NEXT_PHASE,
    NEXT_UPDATES,
    PHASE,
    START,
    UPDATES,
    rows_begin,
)
from warpfiber.passes.precision import group_struct


@cache
def make_dual_begin(
    name: str, law: str, has_frozen: bool, module: str = "unique", has_friction: bool = False
):
    """Kernel `dual_begin` (rows in chunks): nodes and weight of every row, warm start, control.

    With friction also its coefficient and the weight of slip, of which the estimate is the most
    that a force of any direction in the plane does.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    _, point_mobility = make_rod_mobility(name)
    _, softness = make_contact_compliance(name, law)
    coulomb_force = make_coulomb(name)
    zero, one, two = real(0.0), real(1.0), real(2.0)

    @wp.func
    def slip_mobility(
        segment: wp.int32,
        fraction: real,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
    ) -> real:
        fiber = segment_fiber[segment]
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                return zero
        g = groups[fiber_group[fiber]]
        segments = real(g.segments)
        arc = real(segment_node[segment] - fiber_node_start[fiber]) + fraction
        arm = wp.abs(arc - real(0.5) * segments) * g.rest + g.radius
        beads = segments * g.spacing + one
        weight = segments * g.weight + two * g.weight_excess
        moved = point_mobility(g.drag, g.torque, beads, weight, arm, zero)
        return moved + g.radius * g.radius / (g.torque * weight)

    @wp.func
    def row_mobility(
        segment: wp.int32,
        fraction: real,
        normal: vec3,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_start: wp.array(dtype=vec3),
    ) -> real:
        fiber = segment_fiber[segment]
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                return zero
        g = groups[fiber_group[fiber]]
        node = segment_node[segment]
        segments = real(g.segments)
        arc = real(node - fiber_node_start[fiber]) + fraction - real(0.5) * segments
        axis = wp.normalize(node_start[node + 1] - node_start[node])
        beads = segments * g.spacing + one
        along = wp.dot(axis, normal)
        weight = segments * g.weight + two * g.weight_excess
        return point_mobility(g.drag, g.torque, beads, weight, g.rest * arc, along)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def dual_begin(
        offset: wp.int32,
        chunks: wp.int32,
        stiffness: real,
        decay: real,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_start: wp.array(dtype=vec3),
        row_count: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_compliance: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        row_force: wp.array(dtype=real),
        row_node: wp.array(dtype=wp.vec2i),
        row_contact: wp.array(dtype=real),
        row_weight: wp.array(dtype=real),
        row_best: wp.array(dtype=real),
        row_balance: wp.array(dtype=real),
        row_change: wp.array(dtype=real),
        best: wp.array(dtype=wp.float64),
        control: wp.array(dtype=wp.int32),
        going: wp.array(dtype=wp.int32),
        friction: real,
        wall_friction: real,
        row_friction: wp.array(dtype=vec3),
        row_mu: wp.array(dtype=real),
        row_slip_weight: wp.array(dtype=real),
        row_slip_now: wp.array(dtype=vec3),
        row_friction_best: wp.array(dtype=vec3),
        row_friction_change: wp.array(dtype=vec3),
    ):
        chunk = wp.tid() + offset
        count = row_count[0]
        idle = status[wp.static(HALT)] != 0 or count == 0 or count > row_i.shape[0]
        if chunk == 0:
            phase = wp.static(START)
            if idle:
                phase = wp.static(DONE)
            control[wp.static(PHASE)] = phase
            control[wp.static(NEXT_PHASE)] = phase
            control[wp.static(UPDATES)] = 0
            control[wp.static(NEXT_UPDATES)] = 0
            best[0] = wp.float64(wp.static(BROKEN))
            if idle:
                best[0] = wp.float64(0.0)
            best[1] = best[0]
            going[0] = wp.where(idle, 0, 1)
        if idle:
            return
        dt = real(step_size[0])
        for r in range(rows_begin(count, chunk, chunks), rows_begin(count, chunk + 1, chunks)):
            i = row_i[r]
            j = row_j[r]
            n = row_normal[r]
            diagonal = row_mobility(
                i,
                row_s[r],
                n,
                groups,
                fiber_node_start,
                fiber_group,
                segment_node,
                segment_fiber,
                fiber_frozen,
                node_start,
            )
            contact = groups[fiber_group[segment_fiber[i]]].radius
            node_j = -1
            if j >= 0:
                node_j = segment_node[j]
                contact += groups[fiber_group[segment_fiber[j]]].radius
                diagonal += row_mobility(
                    j,
                    row_t[r],
                    n,
                    groups,
                    fiber_node_start,
                    fiber_group,
                    segment_node,
                    segment_fiber,
                    fiber_frozen,
                    node_start,
                )
            else:
                contact = two * contact
            row_node[r] = wp.vec2i(segment_node[i], node_j)
            if wp.static(law == "exponential"):
                row_contact[r] = contact
            soft = row_compliance[r]
            force = row_force[r]
            if soft == zero:
                soft = softness(stiffness, decay, contact)
                force = wp.max(force, zero)
            whole = dt * diagonal + soft
            weight = zero
            if whole > zero:
                weight = one / whole
            row_weight[r] = weight
            row_force[r] = force
            row_best[r] = force
            row_balance[r] = zero
            row_change[r] = zero
            if wp.static(has_friction):
                mu = friction
                moved = slip_mobility(
                    i,
                    row_s[r],
                    groups,
                    fiber_node_start,
                    fiber_group,
                    segment_node,
                    segment_fiber,
                    fiber_frozen,
                )
                if j < 0:
                    mu = wall_friction
                else:
                    moved += slip_mobility(
                        j,
                        row_t[r],
                        groups,
                        fiber_node_start,
                        fiber_group,
                        segment_node,
                        segment_fiber,
                        fiber_frozen,
                    )
                if row_compliance[r] > zero or moved == zero:
                    mu = zero
                flat = coulomb_force(row_friction[r], n, mu * force)
                row_mu[r] = mu
                row_slip_weight[r] = one
                if moved > zero:
                    row_slip_weight[r] = one / (dt * moved)
                row_friction[r] = flat
                row_friction_best[r] = flat
                row_slip_now[r] = vec3()
                row_friction_change[r] = vec3()

    return dual_begin


@cache
def make_dual_lists(name: str, module: str = "unique"):
    """Kernel `dual_lists`, one thread per fiber: its rows as a partner, its shift cleared.

    `fiber_in` is the first such row, `row_next` the next of each, -1 at the end; in the order of
    the segments, as are the rows that the fiber owns.
    """
    vec3 = precision(name).vec3

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def dual_lists(
        offset: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        row_count: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_row: wp.array(dtype=wp.int32),
        pair_row_count: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        node_shift: wp.array(dtype=vec3),
    ):
        fiber = wp.tid() + offset
        fiber_in[fiber] = -1  # also of a halted step: rows that grew hold no lists yet
        if status[wp.static(HALT)] != 0:
            return
        first = fiber_node_start[fiber]
        end = fiber_node_start[fiber + 1]
        for i in range(first, end):
            node_shift[i] = vec3()
        if row_count[0] == 0 or row_count[0] > row_next.shape[0]:
            return
        last = wp.int32(-1)
        segment = first - fiber
        for k in range(in_start[segment], in_start[segment + end - first - 1]):
            pair = in_pair[k]
            begin = pair_row[pair]
            for r in range(begin, begin + pair_row_count[pair]):
                if last < 0:
                    fiber_in[fiber] = r
                else:
                    row_next[last] = r
                row_next[r] = -1
                last = r

    return dual_lists
