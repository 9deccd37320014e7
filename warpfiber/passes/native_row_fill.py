"""Rows of listed pairs written out many at a time, for the CPU: what `row_fill` does for pairs.

Source, symbols: as there and in `row_geometry`; all radii are the same, no rows of beads.
"""

from functools import cache
from typing import TYPE_CHECKING, Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.executor import Launch
from warpfiber.passes.native_pair_lanes import pair_lanes
from warpfiber.passes.pair_motion import CHUNK_SEGMENTS, STRETCH
from warpfiber.passes.pairs import IMAGE_BITS
from warpfiber.passes.portions import portioned
from warpfiber.passes.row_geometry import CROSSING, SLOTS

if TYPE_CHECKING:
    from warpfiber.passes.contact_rows import ContactRows

TEXT = """
    int pairs[2 * W + SLOTS], slots[2 * W + SLOTS], places[2 * W + SLOTS], held = 0;
    const T contact = T(2) * radius;
    int last_i = -1, likely = 0;
    // where no direction is left between two points: any normal of both lines
    auto normal_of_lines = [&](const Motion& m, int l, T* n) {
        const T a[3] = {m.a.x[l], m.a.y[l], m.a.z[l]}, b[3] = {m.b.x[l], m.b.y[l], m.b.z[l]};
        auto cross = [](const T* u, const T* v, T* w) {
            w[0] = u[1] * v[2] - u[2] * v[1];
            w[1] = u[2] * v[0] - u[0] * v[2];
            w[2] = u[0] * v[1] - u[1] * v[0];
        };
        auto size2 = [](const T* u) -> T { return u[0] * u[0] + u[1] * u[1] + u[2] * u[2]; };
        cross(a, b, n);
        if (!(size2(n) > T(CROSSING) * wp::sqrt(size2(a)) * wp::sqrt(size2(b)))) {
            const T along[3] = {wp::abs(a[0]), wp::abs(a[1]), wp::abs(a[2])};
            T axis[3] = {T(1), T(0), T(0)};
            if (along[1] < along[0] && along[1] <= along[2]) { axis[0] = T(0); axis[1] = T(1); }
            else if (along[2] < along[0]) { axis[0] = T(0); axis[2] = T(1); }
            cross(a, axis, n);
        }
        const T length = wp::sqrt(size2(n));
        for (int c = 0; c < 3; ++c) n[c] = n[c] / length;
    };
    auto write = [&](int count) __attribute__((noinline)) {
        const Motion m = motion_of(pairs);
        const V raw_aa = m.a.dot(m.a), raw_bb = m.b.dot(m.b);
        Place at = closest(m, larger(raw_aa, least), larger(raw_bb, least));
        V slot;
        for (int l = 0; l < W; ++l) slot[l] = T(slots[l]);
        const V ab = m.a.dot(m.b), da = m.d.dot(m.a), db = m.d.dot(m.b);
        const V end_s = V(T(2)) - slot, end_t = V(T(4)) - slot;
        const M of_i = (slot > V(T(0.5))) & (slot < V(T(2.5))), of_j = slot > V(T(2.5));
        const V on_j = clipped((end_s * ab - db) / raw_bb);
        const V on_i = clipped((da + end_t * ab) / raw_aa);
        at.s = of_i ? end_s : at.s;
        at.t = of_i ? on_j : at.t;
        at.s = of_j ? on_i : at.s;
        at.t = of_j ? end_t : at.t;
        const V3 c = m.d + m.b * at.t - m.a * at.s, moved = m.w + m.wb * at.t - m.wa * at.s;
        const V apart = __builtin_elementwise_sqrt(c.dot(c));
        const V one_over = V(T(1)) / apart;
        V3 n = c * one_over;
        const M crossed = ~(apart > V(T(CROSSING)));
        if (any(crossed))
            for (int l = 0; l < W; ++l) {
                if (!crossed[l]) continue;
                T normal[3];
                normal_of_lines(m, l, normal);
                n.x[l] = normal[0];
                n.y[l] = normal[1];
                n.z[l] = normal[2];
            }
        const V base = apart - V(contact) + n.dot(moved);
        for (int l = 0; l < count; ++l) {
            const int r = places[l], pair = pairs[l], i = pair_i.data[pair], j = pair_j.data[pair];
            int key = slots[l];
            if (PERIODIC) {
                const int code = pair_image.data[pair];
                const auto& mine = fiber_image.data[segment_fiber.data[i]];
                const auto& other = fiber_image.data[segment_fiber.data[j]];
                key += KEY_X * ((code & MASK) - HALF - other[0] + mine[0])
                    + KEY_Y * (((code >> BITS) & MASK) - HALF - other[1] + mine[1])
                    + KEY_Z * (((code >> (2 * BITS)) & MASK) - HALF - other[2] + mine[2]);
            }
            if (i != last_i) likely = carried_start.data[i];
            last_i = i;
            const int last_carried = carried_start.data[i + 1];
            auto is_at = [&](int q) -> bool {
                return q < last_carried && carried_j.data[q] == j && carried_key.data[q] == key;
            };
            // rows mostly stay in their order
            int q = likely;
            if (!is_at(q))
                for (q = carried_start.data[i]; q < last_carried && !is_at(q); ++q) {}
            const T force = q < last_carried ? carried_force.data[q] : T(0);
            likely = q < last_carried ? q + 1 : likely;
            row_i.data[r] = i;
            row_j.data[r] = j;
            row_key.data[r] = key;
            row_s.data[r] = at.s[l];
            row_t.data[r] = at.t[l];
            row_normal.data[r][0] = n.x[l];
            row_normal.data[r][1] = n.y[l];
            row_normal.data[r][2] = n.z[l];
            row_base.data[r] = base[l];
            row_compliance.data[r] = T(0);
            row_force.data[r] = force;
        }
    };
    int with_rows[STRETCH + 1], of = -1, r = 0;
    for (int begin = first; begin < last; begin += STRETCH) {
        const int end = begin + STRETCH < last ? begin + STRETCH : last;
        int found = 0;
        for (int k = begin; k < end; ++k) {
            with_rows[found] = k;
            found += pair_row_count.data[k] == 0 ? 0 : 1;
        }
        for (int n = 0; n < found; ++n) {
            const int k = with_rows[n], i = pair_i.data[k];
            r = i == of ? r : row_out_start.data[i];
            of = i;
            pair_row.data[k] = r;
            for (int left = pair_slots.data[k]; left; left &= left - 1) {
                pairs[held] = k;
                slots[held] = __builtin_ctz(left);
                places[held++] = r++;
            }
            if (held < W) continue;
            write(W);
            held -= W;
            for (int l = 0; l < held; ++l) {
                pairs[l] = pairs[W + l];
                slots[l] = slots[W + l];
                places[l] = places[W + l];
            }
        }
    }
    if (held > 0) {
        for (int l = held; l < W; ++l) {
            pairs[l] = pairs[held - 1];
            slots[l] = slots[held - 1];
        }
        write(held);
    }
"""


@cache
def make_native_row_fill(
    name: str, periodic: bool, keys: tuple[int, int, int], module: str = "unique"
) -> Any:
    """Kernel `fill_pairs`, over runs of CHUNK_SEGMENTS segments; `keys`: of images, see `row_fill`.

    Rows that do not fit are left to `fill_rows`.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    text = TEXT
    for key, value in {
        "CROSSING": repr(CROSSING[name]),
        "SLOTS": SLOTS,
        "STRETCH": STRETCH,
        "MASK": (1 << IMAGE_BITS) - 1,
        "HALF": 1 << (IMAGE_BITS - 1),
        "BITS": IMAGE_BITS,
        "PERIODIC": str(periodic).lower(),
        "KEY_X": keys[0],
        "KEY_Y": keys[1],
        "KEY_Z": keys[2],
    }.items():
        text = text.replace(key, str(value))

    @wp.func_native(pair_lanes(name, periodic) + text)
    def fill_block(
        first: wp.int32,
        last: wp.int32,
        radius: real,
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        fiber_image: wp.array(dtype=wp.vec3i),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        carried_start: wp.array(dtype=wp.int32),
        carried_j: wp.array(dtype=wp.int32),
        carried_key: wp.array(dtype=wp.int32),
        carried_force: wp.array(dtype=real),
        pair_slots: wp.array(dtype=wp.uint8),
        pair_row_count: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        pair_row: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_key: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_base: wp.array(dtype=real),
        row_compliance: wp.array(dtype=real),
        row_force: wp.array(dtype=real),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def fill_pairs(
        offset: wp.int32,
        radius: real,
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        fiber_image: wp.array(dtype=wp.vec3i),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        carried_start: wp.array(dtype=wp.int32),
        carried_j: wp.array(dtype=wp.int32),
        carried_key: wp.array(dtype=wp.int32),
        carried_force: wp.array(dtype=real),
        row_need: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        pair_slots: wp.array(dtype=wp.uint8),
        pair_row_count: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        pair_row_out: wp.array(dtype=wp.int32),
        row_i_out: wp.array(dtype=wp.int32),
        row_j_out: wp.array(dtype=wp.int32),
        row_key_out: wp.array(dtype=wp.int32),
        row_s_out: wp.array(dtype=real),
        row_t_out: wp.array(dtype=real),
        row_normal_out: wp.array(dtype=vec3),
        row_base_out: wp.array(dtype=real),
        row_compliance_out: wp.array(dtype=real),
        row_force_out: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0 or row_need[0] > 0:
            return
        segments = segment_node.shape[0]
        chunks = (segments + wp.static(CHUNK_SEGMENTS - 1)) / wp.static(CHUNK_SEGMENTS)
        begin = portioned(wp.tid() + offset, chunks, 1) * wp.static(CHUNK_SEGMENTS)
        end = wp.min(begin + wp.static(CHUNK_SEGMENTS), segments)
        if row_out_start[begin] == row_out_start[end]:
            return
        fill_block(
            out_start[begin],
            out_start[end],
            radius,
            segment_node,
            segment_fiber,
            pair_i,
            pair_j,
            pair_image,
            lattice_back,
            lattice_now,
            fiber_image,
            node_back,
            node_pos,
            carried_start,
            carried_j,
            carried_key,
            carried_force,
            pair_slots,
            pair_row_count,
            row_out_start,
            pair_row_out,
            row_i_out,
            row_j_out,
            row_key_out,
            row_s_out,
            row_t_out,
            row_normal_out,
            row_base_out,
            row_compliance_out,
            row_force_out,
        )

    return fill_pairs


def fill_pairs(rows: "ContactRows") -> list[Launch]:
    """The launch, before that of `fill_rows`."""
    model, state, pairs = rows.model, rows.state, rows.pairs
    inputs = [
        model.precision.real(model.group_rows[0]["radius"]),
        model.segment_node,
        model.segment_fiber,
        pairs.out_start,
        pairs.pair_i,
        pairs.pair_j,
        pairs.pair_image,
        rows.lattice_back,
        rows.lattice_now,
        state.fiber_image,
        rows.node_back,
        state.node_pos,
        rows.carried_start,
        rows.carried_j,
        rows.carried_key,
        rows.carried_force,
        rows.row_need,
        state.status,
        rows.pair_slots,
        rows.pair_row_count,
        rows.row_out_start,
        rows.pair_row,
        *rows.written(),
    ]
    kernel = rows.kernels["fill_pairs"]
    return [Launch("fill_pairs", kernel, rows.motion_dim, inputs, split=True)]
