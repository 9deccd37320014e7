"""Contact forces of flexible fibers on the CPU: rows relaxed one after the other.

Source: `native_relaxation`; what a fiber does by a unit force at an end of a row (`native_blocks`),
    a column. Those of ends that are likely to have a force are computed first, of fibers all over
    a part in vectors; others when the row first has a force. What does not fit `columns` is
    computed again whenever it is needed.
Symbols: `column_at` of an end (2 r + side), with friction also of its two directions in the plane
    (4 r + 2 side + c, behind those): where its column is, in vectors.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.chain_reply import make_reply_numbers
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.native import LANES, lane_types
from warpfiber.passes.native_blocks import fill_text
from warpfiber.passes.native_relaxation import BEGIN, PARTS, relaxation_text
from warpfiber.passes.relaxation_work import make_relaxation_begin, relaxation_struct

REPLY_NUMBERS = 6  # of every group, see `chain_reply.make_reply_numbers`

SIZES = """
    auto size_of = [&](int f) -> int {
        const int nodes = d.fiber_node_start.data[f + 1] - d.fiber_node_start.data[f];
        return (4 * nodes + W - 1) / W * W;
    };
    auto ready = [&](int f) {
        for (int r = row_first(f); r < row_last(f); ++r)
            column_at.data[2 * r] = column_at.data[2 * r + 1] = -1;
RESET_FRICTION    };
    if (stage == ROWS_STAGE) part_used.data[part] = 0;
"""

# Fibers of one group with as many wanted ends wait for each other.
COLUMNS = """
    const long long room = columns.shape[0] / d.parts / W * W;
    auto is_wanted = [&](int r, int side) -> bool {
        const Row& row = rows[r];
        return (row.force != T(0) || row.normal[3] < T(0)) && column_at.data[2 * r + side] < 0;
    };
    // a place for a column, if there is room
    auto place_of = [&](int f, int r, int side) -> T* {
        const int of = d.fiber_part.data[f], size = size_of(f);
        if (part_used.data[of] + size > room) return nullptr;
        const long long at = of * room + part_used.data[of];
        column_at.data[2 * r + side] = (int)(at / W);
        part_used.data[of] += size;
        return columns.data + at;
    };
    auto column_of = [&](int f, int r, int side) -> const T* {
        int& at = column_at.data[2 * r + side];
        if (at >= 0) return columns.data + (long long)W * at;
        int lane_fiber[W] = {f}, lane_row[W] = {r}, lane_side[W] = {side}, lanes = 1;
        T* column[W] = {place_of(f, r, side)};
        const bool fits = column[0] != nullptr;
        if (!fits) column[0] = spare.data + d.fiber_part.data[f] * (spare.shape[0] / d.parts);
        each_end(f, [&](int other, int at_side) {
            if (!fits || lanes == W || !is_wanted(other, at_side)) return;
            column[lanes] = place_of(f, other, at_side);
            if (column[lanes] == nullptr) return;
            lane_fiber[lanes] = f;
            lane_row[lanes] = other;
            lane_side[lanes++] = at_side;
        });
        ready_factors(lanes, lane_fiber);
        fill(lanes, lane_fiber, lane_row, lane_side, columnAT_KIND);
        return column[0];
    };
    // of some fibers, as many as `ends` (2 r + side) of each: one of each at a time
    struct Waiting { int held, fiber[W], ends[W], end[W][W]; };
    static_assert(sizeof(Waiting) == WAITING * sizeof(int), "");
    auto find_columns = [&](const Waiting& list) {
        const int lanes = list.held;
        if (lanes == 0) return;
        int row[W], side[W], most = 0;
        for (int l = 0; l < lanes; ++l) most = list.ends[l] > most ? list.ends[l] : most;
        ready_factors(lanes, list.fiber);
        for (int n = 0; n < most; ++n) {
            T* column[W];
            for (int l = 0; l < lanes; ++l) {
                const bool there = n < list.ends[l];
                const int end = list.end[l][there ? n : 0];
                row[l] = end / 2;
                side[l] = end % 2;
                column[l] = there ? place_of(list.fiber[l], row[l], side[l]) : nullptr;
            }
            fill(lanes, list.fiber, row, side, columnAT_KIND);
        }
    };
    // those that are likely to have a force; at most W of a fiber
    if (stage == PARTS_STAGE) {
        const int groups = (int)d.groups.shape[0];
        Waiting* const waiting_of = (Waiting*)waiting.data + (long long)part * groups * W;
        for (int of = 0; of < groups * W; ++of) waiting_of[of].held = 0;
        for (int q = d.part_start.data[part]; q < d.part_start.data[part + 1]; ++q) {
            const int f = d.fiber_order.data[q];
            if (is_fixed(f)) continue;
            int ends = 0, end[W];
            each_end(f, [&](int r, int side) {
                if (ends < W && is_wanted(r, side)) end[ends++] = 2 * r + side;
            });
            if (ends == 0) continue;
            Waiting& list = waiting_of[d.fiber_group.data[f] * W + ends - 1];
            list.fiber[list.held] = f;
            list.ends[list.held] = ends;
            for (int n = 0; n < ends; ++n) list.end[list.held][n] = end[n];
            if (++list.held < W) continue;
            find_columns(list);
            list.held = 0;
        }
        // what is left of the lists of a group together, most ends first
        for (int of = 0; of < groups; ++of) {
            Waiting rest;
            rest.held = 0;
            for (int n = W - 1; n >= 0; --n) {
                const Waiting& list = waiting_of[of * W + n];
                for (int k = 0; k < list.held; ++k) {
                    rest.fiber[rest.held] = list.fiber[k];
                    rest.ends[rest.held] = list.ends[k];
                    for (int e = 0; e < list.ends[k]; ++e) rest.end[rest.held][e] = list.end[k][e];
                    if (++rest.held < W) continue;
                    find_columns(rest);
                    rest.held = 0;
                }
            }
            find_columns(rest);
        }
    }
    auto push = [&](int f, int r, int side, T change) {
        const T* const column = column_of(f, r, side);
        T* const mine = motion + d.fiber_at.data[f];
        const int size = size_of(f);
        for (int c = 0; c < size; c += W) *(U*)(mine + c) += change * *(const U*)(column + c);
    };
    auto reply_of = column_of;
    // along the normal of row q
    auto felt = [&](const T* column, int f, int q, int end) -> T {
        const Row& row = rows[q];
        const int at = (end == 0 ? row.at_i : row.at_j) - d.fiber_at.data[f];
        const Q* const z = (const Q*)(column + at);
        const Q v = z[0] + (end == 0 ? row.s : row.t) * (z[1] - z[0]);
        return row.normal[0] * v[0] + row.normal[1] * v[1] + row.normal[2] * v[2];
    };
    auto diagonal_of = [&](int r) -> T {
        const int on[2] = {states[r].fiber_i, states[r].fiber_j};
        const int at[2] = {rows[r].at_i, rows[r].at_j};
        T diagonal = T(0);
        for (int side = 0; side < 2; ++side) {
            if (at[side] == still) continue;
            const T* const column = column_of(on[side], r, side);
            for (int end = 0; end < 2; ++end) {  // a fiber may meet itself, or its own image
                if (on[end] != on[side]) continue;
                const T e = felt(column, on[side], r, end);
                diagonal += end == 0 ? -e : e;
            }
        }
        return diagonal;
    };
    auto leave = [&](int f, const T* mine) {
        const int node = d.fiber_node_start.data[f];
        const int nodes = d.fiber_node_start.data[f + 1] - node;
        for (int k = 1; k < nodes; ++k) segment_impulse.data[node - f + k - 1] = mine[4 * k + 3];
    };
"""

NORMALS = """
    const int along_normal[W] = {0};
"""
RESET = """
        const int from = 2 * (int)d.row_i.shape[0];
        for (int k = 4 * row_first(f); k < 4 * row_last(f); ++k) column_at.data[from + k] = -1;
"""

# Columns along the two directions in the plane of a contact, behind those along the normals.
FRICTION = """
    const int rub_from = 2 * (int)d.row_i.shape[0];
    auto rub_column = [&](int f, int r, int side, int c) -> const T* {
        auto place = [&](int at_row, int at_side, int at_c) -> int& {
            return column_at.data[rub_from + 4 * at_row + 2 * at_side + at_c];
        };
        int& at = place(r, side, c);
        if (at >= 0) return columns.data + (long long)W * at;
        const int size = size_of(f), of = d.fiber_part.data[f];
        const long long used = part_used.data[of], left = (room - used) / size;
        int lane_row[W] = {r}, lane_side[W] = {side}, lane_kind[W] = {1 + c}, lanes = 1;
        int lane_fiber[W];
        for (int l = 0; l < W; ++l) lane_fiber[l] = f;
        if (left < 1) {
            T* const own = spare.data + (long long)of * (spare.shape[0] / d.parts);
            ready_factors(1, lane_fiber);
            fill(1, lane_fiber, lane_row, lane_side, &own, lane_kind);
            return own;
        }
        each_end(f, [&](int other, int at_side) {
            for (int k = 0; k < 2; ++k) {
                if (lanes == W || lanes == left) return;
                if (other == r && at_side == side && k == c) continue;
                if (rows[other].force == T(0) || rubs[other].mu == T(0)) return;
                if (place(other, at_side, k) >= 0) continue;
                lane_row[lanes] = other;
                lane_side[lanes] = at_side;
                lane_kind[lanes++] = 1 + k;
            }
        });
        T* column[W];
        for (int l = 0; l < lanes; ++l) column[l] = columns.data + of * room + used + l * size;
        ready_factors(lanes, lane_fiber);
        fill(lanes, lane_fiber, lane_row, lane_side, column, lane_kind);
        for (int l = 0; l < lanes; ++l)
            place(lane_row[l], lane_side[l], lane_kind[l] - 1) =
                (int)((of * room + used + (long long)l * size) / W);
        part_used.data[of] = used + (long long)lanes * size;
        return column[0];
    };
"""


def waiting_numbers(name: str) -> int:
    """Of a list of fibers that wait for each other."""
    return 1 + (2 + LANES[name]) * LANES[name]


@cache
def make_chain_relaxation(
    name: str, law: str, module: str = "unique", friction: bool = False, found: bool = False
) -> Any:
    """Kernel `chain_relax` (see `native_relaxation` for its stages): forces, shifts, impulses.

    `found`: there are no factors but `axes` (`native_factor`).
    """
    real = precision(name).real
    Relaxation = relaxation_struct(name)
    Factor = elimination_row(name)
    begin_solve = make_relaxation_begin(name)
    reply_numbers = make_reply_numbers(name)
    filled = fill_text(LANES[name], friction, found)
    fibers = SIZES + filled + (NORMALS if friction else "") + COLUMNS
    fibers = fibers.replace("WAITING", str(waiting_numbers(name)))
    fibers = fibers.replace("PARTS_STAGE", str(PARTS))
    fibers = fibers.replace("AT_KIND", ", along_normal" if friction else "")
    fibers = fibers.replace("RESET_FRICTION", RESET if friction else "")
    rubs = FRICTION if friction else None

    @wp.func_native(relaxation_text(name, law, fibers, lane_types(name), rubs))
    def relax_chains(
        stage: wp.int32,
        part: wp.int32,
        d: Relaxation,
        row_stride: wp.int32,
        fiber_pace: wp.array(dtype=real),
        factors: wp.array(dtype=Factor),
        axes: wp.array(dtype=real),
        numbers: wp.array(dtype=real),
        column_at: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=real),
        part_used: wp.array(dtype=wp.int64),
        spare: wp.array(dtype=real),
        gathered: wp.array(dtype=real),
        waiting: wp.array(dtype=wp.int32),
        segment_impulse: wp.array(dtype=real),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def chain_relax(
        offset: wp.int32,
        stage: wp.int32,
        d: Relaxation,
        row_stride: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        factors: wp.array(dtype=Factor),
        axes: wp.array(dtype=real),
        numbers: wp.array(dtype=real),
        column_at: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=real),
        part_used: wp.array(dtype=wp.int64),
        spare: wp.array(dtype=real),
        gathered: wp.array(dtype=real),
        waiting: wp.array(dtype=wp.int32),
        segment_impulse: wp.array(dtype=real),
    ):
        if stage == wp.static(BEGIN):
            begin_solve(d)
        if d.status[wp.static(HALT)] != 0:
            return
        if d.row_count[0] == 0 or d.row_count[0] > d.row_i.shape[0]:
            return
        if stage == wp.static(BEGIN):
            for k in range(d.groups.shape[0]):
                n = reply_numbers(d.groups[k], real(step_size[0]), d.groups[k].segments)
                at = wp.static(REPLY_NUMBERS) * k
                numbers[at] = n.h
                numbers[at + 1] = n.kappa
                numbers[at + 2] = n.drag_end
                numbers[at + 3] = n.drag_inner
                numbers[at + 4] = n.drag_off
                numbers[at + 5] = n.strength
        relax_chains(
            stage,
            wp.tid() + offset,
            d,
            row_stride,
            fiber_pace,
            factors,
            axes,
            numbers,
            column_at,
            columns,
            part_used,
            spare,
            gathered,
            waiting,
            segment_impulse,
        )

    return chain_relax
