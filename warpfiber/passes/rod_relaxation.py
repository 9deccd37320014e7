"""Contact forces of rigid rods on the CPU: rows relaxed one after the other.

Source: `native_relaxation`; the response of `rod_response`: a force f along n at the fraction s of
    a rod moves its ends 0 and 1 by m - d and m + d,
        m = dt f n/xi,  d = dt H^2 (2 s - 1) f (I - p p^T) n/K_r
    with friction also about its axis, by dt tau/(8 pi eta a^3 w) of the torque tau.
Symbols: as in `rod_response`.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.native_relaxation import BEGIN, relaxation_text
from warpfiber.passes.native_rod_sweeps import sweeps_text
from warpfiber.passes.relaxation_work import make_relaxation_begin, relaxation_struct

ROD_NUMBERS = 6  # of every rod, with friction one more
MOTION = 8  # numbers of two nodes

RODS = """
    struct Rod { Q axis; T push, twist ROLL; };
    static_assert(sizeof(Rod) == ROD_NUMBERS * sizeof(T), "");
    Rod* const rods = (Rod*)rod_numbers.data;
    auto size_of = [](int) -> int { return MOTION; };
    auto dot = [](Q a, Q b) -> T { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
    auto axis_of = [&](int f) -> Q {
        const auto& x0 = d.node_start.data[2 * f];
        const auto& x1 = d.node_start.data[2 * f + 1];
        const Q axis = {x1[0] - x0[0], x1[1] - x0[1], x1[2] - x0[2], T(0)};
        return axis * (T(1) / wp::sqrt(dot(axis, axis)));
    };
    auto ready = [&](int f) {
        const auto& g = d.groups.data[d.fiber_group.data[f]];
        const T beads = g.spacing + T(1), reach = T(0.5) * g.rest, dt = T(step_size.data[0]);
        const T weight = g.weight + T(2) * g.weight_excess;
        const T turning = g.torque * (T(0.25) * beads * (beads * beads - T(1)) + weight);
        rods[f].axis = axis_of(f);
        rods[f].push = dt / (g.drag * beads);
        rods[f].twist = dt * reach * reach / turning;
SET_FRICTION    };
    // m and d by a unit force of row r on the rod at its side
    struct Move { Q middle, turn; };
    auto move_by = [&](int f, int r, int side) -> Move {
        const Row& row = rows[r];
        const Rod& rod = rods[f];
        Q n = side == 0 ? -row.normal : row.normal;
        n[3] = T(0);
        const T lever = T(2) * (side == 0 ? row.s : row.t) - T(1);
        return Move{rod.push * n, (rod.twist * lever) * (n - dot(rod.axis, n) * rod.axis)};
    };
    auto push = [&](int f, int r, int side, T change) {
        const Move move = move_by(f, r, side);
        Q* const mine = (Q*)(motion + d.fiber_at.data[f]);
        mine[0] += change * (move.middle - move.turn);
        mine[1] += change * (move.middle + move.turn);
    };
    auto reply_of = move_by;
    // along the normal of row q
    auto felt = [&](const Move& move, int, int q, int end) -> T {
        const T lever = T(2) * (end == 0 ? rows[q].s : rows[q].t) - T(1);
        return dot(rows[q].normal, move.middle + lever * move.turn);
    };
    auto diagonal_of = [&](int r) -> T {
        const int on[2] = {states[r].fiber_i, states[r].fiber_j};
        const int at[2] = {rows[r].at_i, rows[r].at_j};
        T diagonal = T(0);
        for (int side = 0; side < 2; ++side) {
            if (at[side] == still) continue;
            const Move move = move_by(on[side], r, side);
            for (int end = 0; end < 2; ++end) {  // a rod may meet its own image
                if (on[end] != on[side]) continue;
                const T e = felt(move, on[side], r, end);
                diagonal += end == 0 ? -e : e;
            }
        }
        return diagonal;
    };
    auto leave = [](int, const T*) {};
"""

FRICTION = """
    T reply[MOTION];
    auto rub_column = [&](int f, int r, int side, int c) -> const T* {
        const Rod& rod = rods[f];
        const Pull pull = pull_of(r, side, c == 0 ? rubs[r].first : rubs[r].second);
        const T lever = T(2) * (side == 0 ? rows[r].s : rows[r].t) - T(1);
        const Q across = lever * pull.whole + T(2) * pull.couple;
        const Q turn = rod.twist * (across - dot(rod.axis, across) * rod.axis);
        const Q middle = rod.push * pull.whole;
        ((Q*)reply)[0] = middle - turn;
        ((Q*)reply)[1] = middle + turn;
        reply[3] = rod.roll * pull.torque;
        return reply;
    };
"""


@cache
def make_rod_relaxation(name: str, law: str, module: str = "unique", friction: bool = False) -> Any:
    """Kernel `rod_relax` (see `native_relaxation` for its stages): forces of all rows, shifts."""
    Relaxation = relaxation_struct(name)
    begin_solve = make_relaxation_begin(name)
    parts = {
        "ROD_NUMBERS": str(ROD_NUMBERS + friction),
        "MOTION": str(MOTION),
        "ROLL": ", roll" if friction else "",
        "SET_FRICTION": "rods[f].roll = dt / (g.torque * weight);\n" if friction else "",
    }
    rods, rubs = RODS, FRICTION.replace("MOTION", str(MOTION)) if friction else None
    hard = sweeps_text() if law == "hard" and not friction else ""
    for key, value in parts.items():
        rods = rods.replace(key, value)

    @wp.func_native(relaxation_text(name, law, rods, friction=rubs, hard=hard))
    def relax_rods(
        stage: wp.int32,
        part: wp.int32,
        d: Relaxation,
        step_size: wp.array(dtype=wp.float64),
        rod_numbers: wp.array(dtype=precision(name).real),
        row_sweeps: wp.array(dtype=precision(name).real),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def rod_relax(
        offset: wp.int32,
        stage: wp.int32,
        d: Relaxation,
        step_size: wp.array(dtype=wp.float64),
        rod_numbers: wp.array(dtype=precision(name).real),
        row_sweeps: wp.array(dtype=precision(name).real),
    ):
        if stage == wp.static(BEGIN):
            begin_solve(d)
        if d.status[wp.static(HALT)] != 0:
            return
        if d.row_count[0] == 0 or d.row_count[0] > d.row_i.shape[0]:
            return
        relax_rods(stage, wp.tid() + offset, d, step_size, rod_numbers, row_sweeps)

    return rod_relax
