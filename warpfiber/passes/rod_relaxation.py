"""Contact forces of rigid rods on one thread of the CPU: rows relaxed one after the other.

Source: `native_relaxation`; the response of `rod_response`: a force f along n at the fraction s of
    a rod moves its middle by m += dt f n/xi and its end 1 against that by
    d += dt H^2 lever f (I - p p^T) n/K_r, which are kept; a row has
        e = b + n.(m_j + lever_j d_j - m_i - lever_i d_i)
Symbols: as in `rod_response`; lever = 2 s - 1. Vectors of four numbers, the last of a normal and
    of a motion 0. A wall is one more rod that nothing moves.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.dual_rows import DONE, NEXT_PHASE, NEXT_UPDATES, PHASE, UPDATES
from warpfiber.passes.native_relaxation import relaxation_texts
from warpfiber.passes.precision import group_struct

ROD_NUMBERS, PLACE_NUMBERS = 16, 8  # of every rod, of every row

BEGIN = """
    typedef T Q __attribute__((ext_vector_type(4), aligned(sizeof(T))));
    struct Rod { Q middle, turn, axis; T push, twist, spare[2]; };
    struct Place { Q normal; T base, lever_i, lever_j, spare; };
    static_assert(sizeof(Rod) == ROD_NUMBERS * sizeof(T), "");
    static_assert(sizeof(Place) == PLACE_NUMBERS * sizeof(T), "");
    Rod* const rods = (Rod*)rod_numbers.data;
    Place* const places = (Place*)place_numbers.data;
    auto dot = [](Q a, Q b) -> T {
        const Q c = a * b;
        return c[0] + c[1] + c[2];
    };
    const T dt = T(step_size.data[0]);
    for (int f = 0; f <= fibers; ++f) {
        Rod& rod = rods[f];
        rod.middle = rod.turn = rod.axis = Q(T(0));
        rod.push = rod.twist = T(0);
        if (f == fibers || (fiber_frozen.shape[0] > 0 && fiber_frozen.data[f])) continue;
        const auto& g = groups.data[fiber_group.data[f]];
        const auto& x0 = node_start.data[2 * f];
        const auto& x1 = node_start.data[2 * f + 1];
        const Q axis = {x1[0] - x0[0], x1[1] - x0[1], x1[2] - x0[2], T(0)};
        rod.axis = axis * (T(1) / wp::sqrt(dot(axis, axis)));
        const T beads = g.spacing + T(1), reach = T(0.5) * g.rest;
        const T weight = g.weight + T(2) * g.weight_excess;
        const T turning = g.torque * (T(0.25) * beads * (beads * beads - T(1)) + weight);
        rod.push = dt / (g.drag * beads);
        rod.twist = dt * reach * reach / turning;
    }
    auto rod_of = [&](int r, int side) -> Rod& {
        const int f = side == 0 ? row_i.data[r] : row_j.data[r];
        return rods[f < 0 ? fibers : f];
    };
    auto balance_of = [&](int r) -> T {
        const Place& at = places[r];
        const Rod& i = rod_of(r, 0);
        const Rod& j = rod_of(r, 1);
        const Q moved = j.middle - i.middle + at.lever_j * j.turn - at.lever_i * i.turn;
        return at.base + dot(at.normal, moved);
    };
    auto move = [&](int r, T change) {
        const Place& at = places[r];
        for (int side = 0; side < 2; ++side) {
            Rod& rod = rod_of(r, side);
            const Q push = at.normal * (side == 0 ? -change : change);
            const T lever = side == 0 ? at.lever_i : at.lever_j;
            rod.middle += rod.push * push;
            rod.turn += (rod.twist * lever) * (push - dot(rod.axis, push) * rod.axis);
        }
    };
    for (int r = 0; r < count; ++r) {
        start_force(r);
        Place& at = places[r];
        const auto& n = row_normal.data[r];
        at.normal = Q{n[0], n[1], n[2], T(0)};
        at.base = row_base.data[r];
        at.lever_i = T(2) * row_s.data[r] - T(1);
        at.lever_j = T(2) * row_t.data[r] - T(1);
        const Rod& i = rod_of(r, 0);
        const Rod& j = rod_of(r, 1);
        const T along_i = dot(i.axis, at.normal), along_j = dot(j.axis, at.normal);
        const T across_i = T(1) - along_i * along_i, across_j = T(1) - along_j * along_j;
        T diagonal = i.push + j.push + at.lever_i * at.lever_i * i.twist * across_i
            + at.lever_j * at.lever_j * j.twist * across_j;
        if (row_j.data[r] == row_i.data[r])  // a rod and its own image
            diagonal -= T(2) * (i.push + at.lever_i * at.lever_j * i.twist * across_i);
        prepare(r, diagonal);
        move(r, state[r].force);
    }
    auto diagonal_of = [](int) -> T { return T(0); };  // all rows are prepared
    auto row_fiber = [&](int r, int side) -> int {
        return side == 0 ? row_i.data[r] : row_j.data[r];
    };
    auto partner = [&](int r) -> int { return row_j.data[r]; };
    auto row_first = [&](int f) -> int { return row_out_start.data[f]; };
    auto row_last = [&](int f) -> int { return row_out_start.data[f + 1]; };
"""

# summed anew: what was added and taken away along the way leaves rounding
SHIFTS = """
    for (int f = 0; f <= fibers; ++f) rods[f].middle = rods[f].turn = Q(T(0));
    for (int r = 0; r < count; ++r) move(r, state[r].force);
    for (int f = 0; f < fibers; ++f)
        for (int c = 0; c < 3; ++c) {
            node_shift.data[2 * f][c] = rods[f].middle[c] - rods[f].turn[c];
            node_shift.data[2 * f + 1][c] = rods[f].middle[c] + rods[f].turn[c];
        }
"""


@cache
def make_rod_relaxation(name: str, law: str, module: str = "unique") -> Any:
    """Kernel `rod_relax` (one thread): forces of all rows and the shifts that they cause."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    rows, incoming, solve = relaxation_texts(name, law)
    sizes = {"ROD_NUMBERS": ROD_NUMBERS, "PLACE_NUMBERS": PLACE_NUMBERS}
    begin = BEGIN
    for key, value in sizes.items():
        begin = begin.replace(key, str(value))

    @wp.func_native(rows + begin + incoming + solve + SHIFTS)
    def relax_rods(
        fibers: wp.int32,
        count: wp.int32,
        most: wp.int32,
        tolerance: wp.float64,
        stiffness: real,
        decay: real,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_start: wp.array(dtype=vec3),
        row_out_start: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_base: wp.array(dtype=real),
        row_compliance: wp.array(dtype=real),
        rod_numbers: wp.array(dtype=real),
        place_numbers: wp.array(dtype=real),
        row_state: wp.array(dtype=real),
        in_start: wp.array(dtype=wp.int32),
        in_row: wp.array(dtype=wp.int32),
        fiber_queued: wp.array(dtype=wp.uint8),
        queue: wp.array(dtype=wp.int32),
        row_force: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        best: wp.array(dtype=wp.float64),
        control: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rod_relax(
        fibers: wp.int32,
        most: wp.int32,
        tolerance: wp.float64,
        stiffness: real,
        decay: real,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_start: wp.array(dtype=vec3),
        row_count: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_base: wp.array(dtype=real),
        row_compliance: wp.array(dtype=real),
        rod_numbers: wp.array(dtype=real),
        place_numbers: wp.array(dtype=real),
        row_state: wp.array(dtype=real),
        in_start: wp.array(dtype=wp.int32),
        in_row: wp.array(dtype=wp.int32),
        fiber_queued: wp.array(dtype=wp.uint8),
        queue: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        row_force: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        best: wp.array(dtype=wp.float64),
        control: wp.array(dtype=wp.int32),
    ):
        control[wp.static(PHASE)] = wp.static(DONE)
        control[wp.static(NEXT_PHASE)] = wp.static(DONE)
        control[wp.static(UPDATES)] = 0
        control[wp.static(NEXT_UPDATES)] = 0
        best[1] = wp.float64(0.0)
        if status[wp.static(HALT)] != 0:
            return
        count = row_count[0]
        if count == 0 or count > row_i.shape[0]:
            for node in range(2 * fibers):
                node_shift[node] = vec3()
            return
        relax_rods(
            fibers,
            count,
            most,
            tolerance,
            stiffness,
            decay,
            step_size,
            groups,
            fiber_group,
            segment_fiber,
            fiber_frozen,
            node_start,
            row_out_start,
            row_i,
            row_j,
            row_s,
            row_t,
            row_normal,
            row_base,
            row_compliance,
            rod_numbers,
            place_numbers,
            row_state,
            in_start,
            in_row,
            fiber_queued,
            queue,
            row_force,
            node_shift,
            best,
            control,
        )

    return rod_relax
