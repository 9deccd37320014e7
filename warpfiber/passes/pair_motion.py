"""How near every listed pair surely stays during a step, and which rows of contact it may have.

Rows and checks pass over what stays apart. On the CPU the rows of most others are chosen here too,
many pairs at a time (`native_row_slots`); a pair that takes more than its own two segments to
decide is marked LOOK, elsewhere every pair that does not stay apart is. Rows of the others are
counted, and segments with pairs to look at are marked.

Source: no two points of two segments approach each other by more than the largest relative motion
    of their ends, so the center lines stay apart by `clear` = distance at the start - that motion.
    The flow brings them nearer by no more than (1 - s), the rest of their motion by m_i + m_j.
    Contact moves the fibers further, which a check adds. Where `clear` of the last step is known,
    that of the next is at least (1 - s) clear - m_i - m_j, and only where that is little is it
    measured.
Symbols: as in `row_geometry`: D, a, b at the start, w, wa, wb the motion of the step, an image with
    its box vector at both times.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.native_pair_lanes import pair_lanes
from warpfiber.passes.native_row_slots import LOOK, slots_text
from warpfiber.passes.pairs import NO_IMAGE, PairFeatures, make_pair_geometry
from warpfiber.passes.portions import portioned
from warpfiber.passes.row_geometry import make_closest_points, make_row_geometry

AHEAD = 32  # pairs whose nodes are fetched
STRETCH = 512  # pairs of which the near ones are picked at a time
CHUNK_SEGMENTS = 64  # per launch index on the CPU: workers share pairs in such portions

BLOCK = """
SLOTS
    for (int i = first_segment; i < last_segment; ++i) {
        segment_rows.data[i] = 0;
        segment_look.data[i] = 0;
    }
    int waiting[2 * W], held = 0;
    // pairs that may have come near since, in order, a stretch of the list at a time
    int near[STRETCH + W];
    const T kept = T(1) - step_strain.data[0];
    const bool known = pairs_known.data[0] != 0;
    for (int begin = first; begin < last; begin += STRETCH) {
    const int end = begin + STRETCH < last ? begin + STRETCH : last;
    int count = 0;
    for (int k = begin; k < end; ++k) {
        near[count] = k;
        const T clear = kept * pair_clear.data[k]
            - segment_moved.data[pair_i.data[k]] - segment_moved.data[pair_j.data[k]];
        const bool far = known & (clear > looked_at);
        pair_clear.data[k] = clear;
        pair_slots.data[k] = 0;
        pair_row_count.data[k] = 0;
        count += far ? 0 : 1;
    }
    for (int n = 0; n < W; ++n) near[count + n] = count > 0 ? near[count - 1] : begin;
    for (int k = 0; k < count; k += W) {
        // partners are anywhere in memory
        for (int ahead = k + AHEAD; ahead < k + AHEAD + W && ahead < count; ++ahead) {
            const long long j = 3ll * segment_node.data[pair_j.data[near[ahead]]];
            __builtin_prefetch(back + j);
            __builtin_prefetch(back + j + 5);
            __builtin_prefetch(now + j);
            __builtin_prefetch(now + j + 5);
        }
        const int* const pairs = near + k;
        const Motion m = motion_of(pairs);
        const V aa = larger(m.a.dot(m.a), least), bb = larger(m.b.dot(m.b), least);
        const Place at = closest(m, aa, bb);
        const V3 c = m.d + m.b * at.t - m.a * at.s, u = m.w - m.wa, v = m.w + m.wb, both = v - m.wa;
        const V most = larger(larger(m.w.dot(m.w), u.dot(u)), larger(v.dot(v), both.dot(both)));
        V off_flow;
        for (int l = 0; l < W; ++l)
            off_flow[l] = segment_moved.data[pair_i.data[pairs[l]]]
                + segment_moved.data[pair_j.data[pairs[l]]];
        const V apart = __builtin_elementwise_sqrt(c.dot(c));
        const V clear = larger(apart - __builtin_elementwise_sqrt(most), kept * apart - off_flow);
        for (int l = 0; l < W && k + l < count; ++l) {
            pair_clear.data[pairs[l]] = clear[l];
            waiting[held] = pairs[l];
            held += clear[l] > looked_at ? 0 : 1;
        }
        if (held >= W) {
            find_slots(waiting, W, Alone{});
            find_joints(false);
            held -= W;
            for (int l = 0; l < held; ++l) waiting[l] = waiting[W + l];
        }
    }
    }
    if (held > 0) {
        for (int l = held; l < W; ++l) waiting[l] = waiting[held - 1];
        find_slots(waiting, held, Alone{});
    }
    find_joints(true);
"""


def native_chunks(segment_count: int) -> int:
    """Launch dimension of the native kernel."""
    return (segment_count + CHUNK_SEGMENTS - 1) // CHUNK_SEGMENTS


@cache
def make_pair_motion(name: str, periodic: bool, module: str = "unique", native: bool = False):
    """Kernel `pair_motion`, over segments; `native`: over runs of CHUNK_SEGMENTS, for the CPU.

    `keep`, `near_now` in radii of the thinner fiber; `widest` the largest radius of all; `settles`:
    all are equal, so that rows can be chosen here; what stays apart by `looked_at` has none, what
    is nearer than `wet` may have rows of beads.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    largest_motion, _, _, _ = make_row_geometry(name)
    closest_points = make_closest_points(name)
    _, image_shift, _, _ = make_pair_geometry(name, PairFeatures(periodic=periodic))
    options: dict[str, Any] = {"module": module, "enable_backward": False, "grid_stride": False}

    if not native:

        @wp.kernel(**options)
        def pair_motion(
            offset: wp.int32,
            segments: wp.int32,
            segment_node: wp.array(dtype=wp.int32),
            out_start: wp.array(dtype=wp.int32),
            pair_i: wp.array(dtype=wp.int32),
            pair_j: wp.array(dtype=wp.int32),
            pair_image: wp.array(dtype=wp.int32),
            lattice_back: wp.array(dtype=mat33),
            lattice_now: wp.array(dtype=mat33),
            node_back: wp.array(dtype=vec3),
            node_pos: wp.array(dtype=vec3),
            status: wp.array(dtype=wp.int32),
            widest: real,
            keep: real,
            near_now: real,
            looked_at: real,
            wet: real,
            settles: wp.int32,
            segment_fiber: wp.array(dtype=wp.int32),
            segment_ends: wp.array(dtype=wp.uint8),
            pairs_known: wp.array(dtype=wp.int32),
            step_strain: wp.array(dtype=real),
            segment_moved: wp.array(dtype=real),
            pair_clear: wp.array(dtype=real),
            pair_slots: wp.array(dtype=wp.uint8),
            pair_row_count: wp.array(dtype=wp.int32),
            segment_rows: wp.array(dtype=wp.int32),
            segment_look: wp.array(dtype=wp.uint8),
        ):
            if status[wp.static(HALT)] != 0:
                return
            i = wp.tid() + offset
            node_i = segment_node[i]
            xi = node_back[node_i]
            a = node_back[node_i + 1] - xi
            move_i = node_pos[node_i] - xi
            wa = node_pos[node_i + 1] - node_back[node_i + 1] - move_i
            stays = real(1.0) - step_strain[0]
            segment_rows[i] = 0
            looked_for = wp.uint8(0)
            for k in range(out_start[i], out_start[i + 1]):
                if pairs_known[0] != 0:
                    least = stays * pair_clear[k] - segment_moved[i] - segment_moved[pair_j[k]]
                    if least > looked_at:
                        pair_clear[k] = least
                        pair_slots[k] = wp.uint8(0)
                        pair_row_count[k] = 0
                        continue
                node_j = segment_node[pair_j[k]]
                xj = node_back[node_j]
                b = node_back[node_j + 1] - xj
                shift = image_shift(pair_image[k], lattice_back[0])
                delta = xj - xi + shift
                move_j = node_pos[node_j] - xj
                w = move_j - move_i
                if wp.static(periodic):
                    w += image_shift(pair_image[k], lattice_now[0]) - shift
                wb = node_pos[node_j + 1] - node_back[node_j + 1] - move_j
                st = closest_points(delta, a, b)
                distance = wp.length(delta + st[1] * b - st[0] * a)
                off_flow = segment_moved[i] + segment_moved[pair_j[k]]
                clear = wp.max(distance - largest_motion(w, wa, wb), stays * distance - off_flow)
                pair_clear[k] = clear
                near = wp.uint8(wp.where(clear > looked_at, 0, 1))
                pair_slots[k] = wp.uint8(wp.static(LOOK)) * near
                pair_row_count[k] = 0
                looked_for = looked_for | near
            segment_look[i] = looked_for

        return pair_motion

    text = BLOCK.replace("SLOTS", slots_text(name))
    for key, value in {"AHEAD": AHEAD, "STRETCH": STRETCH, "NONE": NO_IMAGE}.items():
        text = text.replace(key, str(value))

    @wp.func_native(pair_lanes(name, periodic) + text)
    def motion_block(
        first_segment: wp.int32,
        last_segment: wp.int32,
        first: wp.int32,
        last: wp.int32,
        segment_node: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        widest: real,
        keep: real,
        near_now: real,
        looked_at: real,
        wet: real,
        settles: wp.int32,
        segment_fiber: wp.array(dtype=wp.int32),
        segment_ends: wp.array(dtype=wp.uint8),
        pairs_known: wp.array(dtype=wp.int32),
        step_strain: wp.array(dtype=real),
        segment_moved: wp.array(dtype=real),
        pair_clear: wp.array(dtype=real),
        pair_slots: wp.array(dtype=wp.uint8),
        pair_row_count: wp.array(dtype=wp.int32),
        segment_rows: wp.array(dtype=wp.int32),
        segment_look: wp.array(dtype=wp.uint8),
    ): ...

    @wp.kernel(**options)
    def native_pair_motion(
        offset: wp.int32,
        segments: wp.int32,
        segment_node: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        widest: real,
        keep: real,
        near_now: real,
        looked_at: real,
        wet: real,
        settles: wp.int32,
        segment_fiber: wp.array(dtype=wp.int32),
        segment_ends: wp.array(dtype=wp.uint8),
        pairs_known: wp.array(dtype=wp.int32),
        step_strain: wp.array(dtype=real),
        segment_moved: wp.array(dtype=real),
        pair_clear: wp.array(dtype=real),
        pair_slots: wp.array(dtype=wp.uint8),
        pair_row_count: wp.array(dtype=wp.int32),
        segment_rows: wp.array(dtype=wp.int32),
        segment_look: wp.array(dtype=wp.uint8),
    ):
        if status[wp.static(HALT)] != 0:
            return
        chunks = (segments + wp.static(CHUNK_SEGMENTS - 1)) / wp.static(CHUNK_SEGMENTS)
        begin = portioned(wp.tid() + offset, chunks, 1) * wp.static(CHUNK_SEGMENTS)
        end = wp.min(begin + wp.static(CHUNK_SEGMENTS), segments)
        motion_block(
            begin,
            end,
            out_start[begin],
            out_start[end],
            segment_node,
            pair_i,
            pair_j,
            pair_image,
            lattice_back,
            lattice_now,
            node_back,
            node_pos,
            widest,
            keep,
            near_now,
            looked_at,
            wet,
            settles,
            segment_fiber,
            segment_ends,
            pairs_known,
            step_strain,
            segment_moved,
            pair_clear,
            pair_slots,
            pair_row_count,
            segment_rows,
            segment_look,
        )

    return native_pair_motion
