"""How far the ends of contact rows move on a flexible fiber: blocks of J S J^T, fiber by fiber.

A row has an end on each of its fibers. The block of a fiber, ends by ends, is filled column by
column when a row first has a force, so that an update costs
no solve; a fiber whose block does not fit `block` is solved in every update.
Symbols: ends of a fiber in the order of the rows that it owns, then those that it is the partner
    of; motion of an end along its row, -n for the owner and n for the partner.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.chain_reply import make_chain_reply, make_gather_push
from warpfiber.passes.chain_solve import OPTIONS
from warpfiber.passes.dual_rows import DONE, NEXT_PHASE
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.precision import group_struct


@cache
def make_end_kernels(name: str):
    """Kernels `end_count` and `end_fill` (one thread per fiber), `end_scan` (one thread) between.

    Fiber f has the ends `end_start[f]` .. `end_start[f + 1]` and, unless that is -1, the block from
    `block_start[f]` on. Row r has the ends `row_end[2 r]` and `row_end[2 r + 1]` (-1: a wall).
    """
    real = precision(name).real

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def end_count(
        offset: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        row_count: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        end_start: wp.array(dtype=wp.int32),
    ):
        fiber = wp.tid() + offset
        ends = wp.int32(0)
        if row_count[0] <= row_next.shape[0]:
            first = fiber_node_start[fiber] - fiber
            last = fiber_node_start[fiber + 1] - fiber - 1
            ends = row_out_start[last] - row_out_start[first]
            r = fiber_in[fiber]
            while r >= 0:
                ends += 1
                r = row_next[r]
        end_start[fiber + 1] = ends

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def end_scan(
        fibers: wp.int32,
        block_size: wp.int32,
        status: wp.array(dtype=wp.int32),
        end_start: wp.array(dtype=wp.int32),
        block_start: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        total = wp.int32(0)
        used = wp.int32(0)
        for fiber in range(fibers):
            ends = end_start[fiber + 1]
            total += ends
            end_start[fiber + 1] = total
            block_start[fiber] = -1
            if wp.int64(ends) * wp.int64(ends) <= wp.int64(block_size - used):
                block_start[fiber] = used
                used += ends * ends

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def end_fill(
        offset: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        end_start: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        row_end: wp.array(dtype=wp.int32),
        end_row: wp.array(dtype=wp.int32),
        end_known: wp.array(dtype=wp.uint8),
        end_force: wp.array(dtype=real),
        end_move: wp.array(dtype=real),
        end_diagonal: wp.array(dtype=real),
    ):
        fiber = wp.tid() + offset
        begin = end_start[fiber]
        end = end_start[fiber + 1]
        if status[wp.static(HALT)] != 0 or begin == end:
            return
        own = row_out_start[fiber_node_start[fiber] - fiber]
        owned = row_out_start[fiber_node_start[fiber + 1] - fiber - 1] - own
        r = fiber_in[fiber]
        for e in range(begin, end):
            end_known[e] = wp.uint8(0)
            end_force[e] = real(0.0)
            end_move[e] = real(0.0)
            end_diagonal[e] = real(0.0)
            if e - begin < owned:
                end_row[e] = own
                row_end[2 * own] = e
                if row_j[own] < 0:
                    row_end[2 * own + 1] = -1
                own += 1
            else:
                end_row[e] = r
                row_end[2 * r + 1] = e
                r = row_next[r]

    return {"end_count": end_count, "end_scan": end_scan, "end_fill": end_fill}


@cache
def make_chain_moves(name: str, has_frozen: bool):
    """Kernel `chain_moves`, one thread per fiber: motion of its ends by the present forces."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    Row = elimination_row(name)
    chain_reply = make_chain_reply(name)
    gather_push = make_gather_push(name)
    zero, one = real(0.0), real(1.0)

    @wp.func
    def end_motion(
        node: wp.int32, fraction: real, normal: vec3, node_shift: wp.array(dtype=vec3)
    ) -> real:
        move = (one - fraction) * node_shift[node] + fraction * node_shift[node + 1]
        return wp.dot(normal, move)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False, grid_stride=False)
    def chain_moves(
        offset: wp.int32,
        row_stride: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        rows: wp.array(dtype=Row),
        row_out_start: wp.array(dtype=wp.int32),
        fiber_in: wp.array(dtype=wp.int32),
        row_next: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_node: wp.array(dtype=wp.vec2i),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        end_start: wp.array(dtype=wp.int32),
        block_start: wp.array(dtype=wp.int32),
        end_row: wp.array(dtype=wp.int32),
        control: wp.array(dtype=wp.int32),
        node_push: wp.array(dtype=vec3),
        node_reply: wp.array(dtype=vec3),
        reply_impulse: wp.array(dtype=real),
        segment_impulse: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        block: wp.array(dtype=real),
        end_known: wp.array(dtype=wp.uint8),
        end_force: wp.array(dtype=real),
        end_move: wp.array(dtype=real),
        end_diagonal: wp.array(dtype=real),
    ):
        if control[wp.static(NEXT_PHASE)] == wp.static(DONE):
            return
        fiber = wp.tid() + offset
        begin = end_start[fiber]
        end = end_start[fiber + 1]
        if begin == end:
            return
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                return
        changed = wp.bool(False)
        for e in range(begin, end):
            force = row_force[end_row[e]]
            if force != end_force[e]:
                changed = True
                end_force[e] = force
        if not changed:
            return
        first = fiber_node_start[fiber]
        segments = fiber_node_start[fiber + 1] - first - 1
        owned = row_out_start[first - fiber + segments] - row_out_start[first - fiber]
        g = groups[fiber_group[fiber]]
        base = row_stride * fiber
        dt = fiber_pace[fiber] * real(step_size[0])
        column = block_start[fiber]
        if column < 0:
            gather_push(
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
            chain_reply(
                fiber,
                first,
                segments,
                base,
                dt,
                g,
                rows,
                node_push,
                node_reply,
                reply_impulse,
                segment_impulse,
                node_shift,
            )
            for e in range(begin, end):
                r = end_row[e]
                if e - begin < owned:
                    end_move[e] = end_motion(row_node[r][0], row_s[r], -row_normal[r], node_shift)
                else:
                    end_move[e] = end_motion(row_node[r][1], row_t[r], row_normal[r], node_shift)
            return
        for e in range(begin, end):
            end_move[e] = zero
        for source in range(begin, end):
            force = end_force[source]
            if force != zero:
                if end_known[source] == wp.uint8(0):
                    end_known[source] = wp.uint8(1)
                    r = end_row[source]
                    node = row_node[r][0]
                    fraction = row_s[r]
                    normal = -row_normal[r]
                    if source - begin >= owned:
                        node = row_node[r][1]
                        fraction = row_t[r]
                        normal = row_normal[r]
                    for i in range(first, first + segments + 1):
                        node_push[i] = vec3()
                    node_push[node] = (one - fraction) * normal
                    node_push[node + 1] = fraction * normal
                    chain_reply(
                        fiber,
                        first,
                        segments,
                        base,
                        dt,
                        g,
                        rows,
                        node_push,
                        node_reply,
                        reply_impulse,
                        segment_impulse,
                        node_shift,
                    )
                    for e in range(begin, end):
                        r = end_row[e]
                        node = row_node[r][0]
                        fraction = row_s[r]
                        normal = -row_normal[r]
                        if e - begin >= owned:
                            node = row_node[r][1]
                            fraction = row_t[r]
                            normal = row_normal[r]
                        block[column + e - begin] = end_motion(node, fraction, normal, node_shift)
                    end_diagonal[source] = block[column + source - begin]
                for e in range(begin, end):
                    end_move[e] = end_move[e] + force * block[column + e - begin]
            column += end - begin

    return chain_moves
