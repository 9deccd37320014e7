"""Overlaps at the end of a step of many pairs at a time, for the CPU: before `check_sweeps`.

Leaves to `check_segments` the segments that are nowhere, and those of which a pair may have been
passed through: its lines are no further apart than they moved.
Source, symbols: as there; all radii are the same.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.check_sweeps import LOST
from warpfiber.passes.native_pair_lanes import pair_lanes
from warpfiber.passes.pair_motion import CHUNK_SEGMENTS, STRETCH
from warpfiber.passes.portions import portioned

TEXT = """
    const T contact = T(2) * radius;
    for (int s = first_segment; s < last_segment; ++s) {
        segment_overlap.data[s] = T(0);
        overlap_partner.data[s] = -1;
        segment_crossed.data[s] = 0;
        crossed_partner.data[s] = -1;
        const auto& x = node_pos.data[segment_node.data[s]];
        const auto& y = node_pos.data[segment_node.data[s] + 1];
        T size2 = T(0), length2 = T(0);
        for (int c = 0; c < 3; ++c) {
            size2 += x[c] * x[c];
            length2 += (y[c] - x[c]) * (y[c] - x[c]);
        }
        segment_look.data[s] = !(size2 < T(LOST) && length2 < T(LOST));
    }
    int near[STRETCH + W];
    for (int begin = first; begin < last; begin += STRETCH) {
        const int end = begin + STRETCH < last ? begin + STRETCH : last;
        int count = 0;
        for (int k = begin; k < end; ++k) {
            near[count] = k;
            bool far = false;
            if (SHIFTED) {
                const int i = pair_i.data[k], j = pair_j.data[k];
                T shifted = segment_shift.data[i] + segment_shift.data[j];
                if (AGAIN) shifted += shift_again.data[i] + shift_again.data[j];
                far = pair_clear.data[k] - shifted > contact;
            }
            count += far ? 0 : 1;
        }
        for (int n = 0; n < W; ++n) near[count + n] = count > 0 ? near[count - 1] : begin;
        for (int k = 0; k < count; k += W) {
            const int* const pairs = near + k;
            const Motion m = motion_of(pairs);
            const V3 u = m.w - m.wa, v = m.w + m.wb, both = v - m.wa;
            const V moved2 = larger(larger(m.w.dot(m.w), u.dot(u)),
                                    larger(v.dot(v), both.dot(both)));
            const Motion now_at{m.d + m.w, m.a + m.wa, m.b + m.wb, m.w, m.wa, m.wb};
            const V aa = larger(now_at.a.dot(now_at.a), least);
            const V bb = larger(now_at.b.dot(now_at.b), least);
            const Place at = closest(now_at, aa, bb);
            const V3 c = now_at.d + now_at.b * at.t - now_at.a * at.s;
            const V dd = c.dot(c);
            const M touch = dd < V(contact * contact);
            const M met = ~(dd > moved2);  // also what is no number
            if (!any(touch | met)) continue;
            const V overlap = (V(contact) - __builtin_elementwise_sqrt(dd)) / V(radius);
            for (int l = 0; l < W && k + l < count; ++l) {
                const int i = pair_i.data[pairs[l]];
                if (met[l]) segment_look.data[i] = 1;
                if (!touch[l] || !(overlap[l] > segment_overlap.data[i])) continue;
                segment_overlap.data[i] = overlap[l];
                overlap_partner.data[i] = pair_j.data[pairs[l]];
            }
        }
    }
"""


@cache
def make_native_check(
    name: str, periodic: bool, shifted: bool, again: bool, module: str = "unique"
) -> Any:
    """Kernel `native_check`, over runs of CHUNK_SEGMENTS segments.

    `shifted`, `again`: what is known of pairs and how far contact moved the segments, by one solve
    or two.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    text = TEXT
    flags = {"SHIFTED": shifted, "AGAIN": again, "STRETCH": STRETCH, "LOST": LOST}
    for key, value in flags.items():
        text = text.replace(key, str(value).lower())

    @wp.func_native(pair_lanes(name, periodic) + text)
    def check_block(
        first_segment: wp.int32,
        last_segment: wp.int32,
        first: wp.int32,
        last: wp.int32,
        radius: real,
        segment_node: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        pair_clear: wp.array(dtype=real),
        segment_shift: wp.array(dtype=real),
        shift_again: wp.array(dtype=real),
        segment_overlap: wp.array(dtype=real),
        overlap_partner: wp.array(dtype=wp.int32),
        segment_crossed: wp.array(dtype=wp.int32),
        crossed_partner: wp.array(dtype=wp.int32),
        segment_look: wp.array(dtype=wp.uint8),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def native_check(
        offset: wp.int32,
        radius: real,
        segment_node: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        pair_clear: wp.array(dtype=real),
        segment_shift: wp.array(dtype=real),
        shift_again: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        overlap_out: wp.array(dtype=real),
        overlap_partner_out: wp.array(dtype=wp.int32),
        crossed_out: wp.array(dtype=wp.int32),
        crossed_partner_out: wp.array(dtype=wp.int32),
        segment_look_out: wp.array(dtype=wp.uint8),
    ):
        if status[wp.static(HALT)] != 0:
            return
        segments = segment_node.shape[0]
        chunks = (segments + wp.static(CHUNK_SEGMENTS - 1)) / wp.static(CHUNK_SEGMENTS)
        begin = portioned(wp.tid() + offset, chunks, 1) * wp.static(CHUNK_SEGMENTS)
        end = wp.min(begin + wp.static(CHUNK_SEGMENTS), segments)
        check_block(
            begin,
            end,
            out_start[begin],
            out_start[end],
            radius,
            segment_node,
            pair_i,
            pair_j,
            pair_image,
            lattice_back,
            lattice_now,
            node_back,
            node_pos,
            pair_clear,
            segment_shift,
            shift_again,
            overlap_out,
            overlap_partner_out,
            crossed_out,
            crossed_partner_out,
            segment_look_out,
        )

    return native_check
