"""Contact forces of flexible fibers on one thread of the CPU: rows relaxed one after the other.

Source: `native_relaxation`; how far the ends of rows move on a fiber, and what it does itself, by
    unit forces at them (`native_blocks`), computed when a row of the fiber first has a force. What
    does not fit `block` is computed again whenever it is needed.
Symbols: ends of a fiber in the order of the rows that it owns, then those that it is the partner
    of; `row_end` of a row: where the motions of its two ends along it are in `end_move`.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.chain_reply import make_reply_numbers
from warpfiber.passes.dual_rows import DONE, NEXT_PHASE, NEXT_UPDATES, PHASE, UPDATES
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.native import lane_types
from warpfiber.passes.native_blocks import FILL_BLOCK
from warpfiber.passes.native_relaxation import relaxation_texts
from warpfiber.passes.precision import group_struct

REPLY_NUMBERS = 6  # of every group, see `chain_reply.make_reply_numbers`

FIBERS = """
    auto row_fiber = [&](int r, int side) -> int {
        const int segment = side == 0 ? row_i.data[r] : row_j.data[r];
        return segment < 0 ? -1 : segment_fiber.data[segment];
    };
    auto partner = [&](int r) -> int { return row_fiber(r, 1); };
    auto row_first = [&](int f) -> int {
        return row_out_start.data[fiber_node_start.data[f] - f];
    };
    auto row_last = [&](int f) -> int {
        return row_out_start.data[fiber_node_start.data[f + 1] - f - 1];
    };
    auto is_fixed = [&](int f) -> bool {
        return f < 0 || (fiber_frozen.shape[0] > 0 && fiber_frozen.data[f]);
    };
    auto end_node = [&](int r, bool own) -> int {
        return segment_node.data[own ? row_i.data[r] : row_j.data[r]];
    };
"""

BLOCKS = """
    auto row_of = [&](int f, int x) -> int {
        const int owned = row_last(f) - row_first(f);
        return x < owned ? row_first(f) + x : in_row.data[in_start.data[f] + x - owned];
    };
    long long used = 0;
    end_start.data[0] = 0;
    for (int f = 0; f < fibers; ++f) {
        const int begin = end_start.data[f], first = row_first(f), owned = row_last(f) - first;
        const int count = owned + in_start.data[f + 1] - in_start.data[f];
        end_start.data[f + 1] = begin + count;
        fiber_known.data[f] = 0;
        const long long groups_of = (count + W - 1) / W;
        const long long nodes = fiber_node_start.data[f + 1] - fiber_node_start.data[f];
        const long long size = groups_of * W * (count + 4 * nodes);
        block_start.data[f] = used + size <= block.shape[0] ? (int)used : -1;
        if (used + size <= block.shape[0]) used += size;
        for (int x = 0; x < count; ++x) {
            end_move.data[begin + x] = T(0);
            row_end.data[2 * row_of(f, x) + (x < owned ? 0 : 1)] = begin + x;
        }
    }
"""

SOLVE = """
    // by a unit force at end x of fiber f: how far its end y moves, at[y * stride]
    struct Column { const T* at; int stride; };
    auto width_of = [&](int f) -> int {
        return (end_start.data[f + 1] - end_start.data[f] + W - 1) / W * W;
    };
    auto column_of = [&](int f, int x) -> Column {
        const int width = width_of(f);
        if (block_start.data[f] < 0) {
            T* const own = spare.data;
            fill(f, x / W * W, own, W, (U*)(own + (long long)W * width));
            return Column{own + x % W, W};
        }
        T* const own = block.data + block_start.data[f];
        const int nodes = fiber_node_start.data[f + 1] - fiber_node_start.data[f];
        const int count = end_start.data[f + 1] - end_start.data[f];
        if (!fiber_known.data[f]) {
            fiber_known.data[f] = 1;
            T* reply = own + (long long)count * width;
            for (int group = 0; group < count; group += W, reply += 4 * W * nodes)
                fill(f, group, own + group, width, (U*)reply);
        }
        return Column{own + (long long)x * width, 1};  // the block is symmetric
    };
    auto balance_of = [&](int r) -> T {
        T e = row_base.data[r] + end_move.data[row_end.data[2 * r]];
        return row_j.data[r] < 0 ? e : e + end_move.data[row_end.data[2 * r + 1]];
    };
    auto move = [&](int r, T change) {
        for (int side = 0; side < 2; ++side) {
            const int f = row_fiber(r, side);
            if (is_fixed(f)) continue;
            const int begin = end_start.data[f], count = end_start.data[f + 1] - begin;
            const Column column = column_of(f, row_end.data[2 * r + side] - begin);
            T* const moves = end_move.data + begin;
            if (column.stride == 1)
                for (int y = 0; y < count; ++y) moves[y] += change * column.at[y];
            else
                for (int y = 0; y < count; ++y) moves[y] += change * column.at[y * W];
        }
    };
    auto diagonal_of = [&](int r) -> T {
        T diagonal = T(0);
        for (int side = 0; side < 2; ++side) {
            const int f = row_fiber(r, side);
            if (is_fixed(f)) continue;
            const int begin = end_start.data[f], x = row_end.data[2 * r + side] - begin;
            const Column column = column_of(f, x);
            diagonal += column.at[x * column.stride];
            if (row_fiber(r, 1 - side) == f)  // a fiber and itself, or its own image
                diagonal += column.at[(row_end.data[2 * r + 1 - side] - begin) * column.stride];
        }
        return diagonal;
    };
    for (int r = 0; r < count; ++r) {
        start_force(r);
        prepare_later(r, is_fixed(row_fiber(r, 0)) && is_fixed(row_fiber(r, 1)));
        if (state[r].force != T(0)) move(r, state[r].force);
    }
"""

SHIFTS = """
    for (int f = 0; f < fibers; ++f) {
        const int begin = end_start.data[f], ends = end_start.data[f + 1] - begin;
        const int first = fiber_node_start.data[f], nodes = fiber_node_start.data[f + 1] - first;
        for (int k = 0; k < nodes; ++k) node_shift.data[first + k] = {};
        for (int k = 1; k < nodes; ++k) segment_impulse.data[first - f + k - 1] = T(0);
        if (is_fixed(f)) continue;
        for (int group = 0; group < ends; group += W) {
            V force = V(T(0));
            bool pushed = false;
            for (int l = 0; l < W && group + l < ends; ++l) {
                force[l] = state[row_of(f, group + l)].force;
                pushed = pushed || force[l] != T(0);
            }
            if (!pushed) continue;
            column_of(f, group);
            const long long width = width_of(f);
            const U* reply = (const U*)(spare.data + W * width);
            if (block_start.data[f] >= 0)
                reply = (const U*)(block.data + block_start.data[f] + ends * width)
                    + (long long)(group / W) * 4 * nodes;
            for (int k = 0; k < nodes; ++k) {
                for (int c = 0; c < 3; ++c)
                    node_shift.data[first + k][c] += sum(reply[4 * k + c] * force);
                if (k > 0) segment_impulse.data[first - f + k - 1] += sum(reply[4 * k + 3] * force);
            }
        }
    }
"""

SUM = """
    auto sum = [](V v) -> T {
        T all = T(0);
        for (int l = 0; l < W; ++l) all += v[l];
        return all;
    };
"""


@cache
def make_chain_relaxation(name: str, law: str, module: str = "unique") -> Any:
    """Kernel `chain_relax` (one thread): forces of all rows, shifts and impulses of the fibers."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    Row = elimination_row(name)
    reply_numbers = make_reply_numbers(name)
    rows_text, incoming, solve = relaxation_texts(name, law)
    text = lane_types(name) + SUM + rows_text + FIBERS + incoming + BLOCKS + FILL_BLOCK
    text += SOLVE + solve + SHIFTS

    @wp.func_native(text)
    def relax_chains(
        fibers: wp.int32,
        count: wp.int32,
        row_stride: wp.int32,
        most: wp.int32,
        tolerance: wp.float64,
        stiffness: real,
        decay: real,
        fiber_pace: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        rows: wp.array(dtype=Row),
        row_out_start: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_base: wp.array(dtype=real),
        row_compliance: wp.array(dtype=real),
        numbers: wp.array(dtype=real),
        end_start: wp.array(dtype=wp.int32),
        block_start: wp.array(dtype=wp.int32),
        fiber_known: wp.array(dtype=wp.uint8),
        row_end: wp.array(dtype=wp.int32),
        end_move: wp.array(dtype=real),
        block: wp.array(dtype=real),
        spare: wp.array(dtype=real),
        row_state: wp.array(dtype=real),
        in_start: wp.array(dtype=wp.int32),
        in_row: wp.array(dtype=wp.int32),
        fiber_queued: wp.array(dtype=wp.uint8),
        queue: wp.array(dtype=wp.int32),
        row_force: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        segment_impulse: wp.array(dtype=real),
        best: wp.array(dtype=wp.float64),
        control: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def chain_relax(
        fibers: wp.int32,
        row_stride: wp.int32,
        most: wp.int32,
        tolerance: wp.float64,
        stiffness: real,
        decay: real,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        rows: wp.array(dtype=Row),
        row_count: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_base: wp.array(dtype=real),
        row_compliance: wp.array(dtype=real),
        numbers: wp.array(dtype=real),
        end_start: wp.array(dtype=wp.int32),
        block_start: wp.array(dtype=wp.int32),
        fiber_known: wp.array(dtype=wp.uint8),
        row_end: wp.array(dtype=wp.int32),
        end_move: wp.array(dtype=real),
        block: wp.array(dtype=real),
        spare: wp.array(dtype=real),
        row_state: wp.array(dtype=real),
        in_start: wp.array(dtype=wp.int32),
        in_row: wp.array(dtype=wp.int32),
        fiber_queued: wp.array(dtype=wp.uint8),
        queue: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        row_force: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        segment_impulse: wp.array(dtype=real),
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
            for fiber in range(fibers):
                end_start[fiber + 1] = 0
            for node in range(node_shift.shape[0]):
                node_shift[node] = vec3()
            return
        for k in range(groups.shape[0]):
            n = reply_numbers(groups[k], real(step_size[0]), groups[k].segments)
            at = wp.static(REPLY_NUMBERS) * k
            numbers[at] = n.h
            numbers[at + 1] = n.kappa
            numbers[at + 2] = n.drag_end
            numbers[at + 3] = n.drag_inner
            numbers[at + 4] = n.drag_off
            numbers[at + 5] = n.strength
        relax_chains(
            fibers,
            count,
            row_stride,
            most,
            tolerance,
            stiffness,
            decay,
            fiber_pace,
            groups,
            fiber_node_start,
            fiber_group,
            segment_node,
            segment_fiber,
            fiber_frozen,
            rows,
            row_out_start,
            row_i,
            row_j,
            row_s,
            row_t,
            row_normal,
            row_base,
            row_compliance,
            numbers,
            end_start,
            block_start,
            fiber_known,
            row_end,
            end_move,
            block,
            spare,
            row_state,
            in_start,
            in_row,
            fiber_queued,
            queue,
            row_force,
            node_shift,
            segment_impulse,
            best,
            control,
        )

    return chain_relax
