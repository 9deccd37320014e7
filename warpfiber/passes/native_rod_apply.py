"""Rods moved by their shifts, many at a time, for the CPU: what `rod_response` does at its end.

Repeats the plain kernel `rod_apply` there.
Source, symbols: as there.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.native_pair_lanes import row_lanes
from warpfiber.passes.native_rods import PUT
from warpfiber.passes.precision import group_struct
from warpfiber.passes.rigid_rods import CHUNK

TEXT = """
    const T* const shift = (const T*)node_shift.data;
    T* const now = (T*)node_pos.data;
    T* const speed = (T*)node_velocity.data;
    const V zero = V(T(0)), half = V(T(0.5)), rate = V(share);
    for (int f = first; f < last; f += W) {
        R rows[6][W];
        V reach;
        for (int l = 0; l < W; ++l) {
            // the second node is read from its end, so that nothing behind the last is touched
            const int rod = f + l < last ? f + l : last - 1;
            rows[0][l] = load(shift + 6ll * rod);
            rows[1][l] = load(shift + 6ll * rod + 2).yzww;
            rows[2][l] = load(now + 6ll * rod);
            rows[3][l] = load(now + 6ll * rod + 2).yzww;
            rows[4][l] = load(speed + 6ll * rod);
            rows[5][l] = load(speed + 6ll * rod + 2).yzww;
            reach[l] = T(0.5) * groups.data[fiber_group.data[rod]].rest;
        }
        const V3 shift0 = transposed(rows[0]), shift1 = transposed(rows[1]);
        const V3 from0 = transposed(rows[2]), from1 = transposed(rows[3]);
        const V3 x0 = from0 + shift0, x1 = from1 + shift1;
        const V3 center = (x0 + x1) * half, axis = x1 - x0;
        const V3 lever = axis * (reach / __builtin_elementwise_sqrt(axis.dot(axis)));
        const V3 to[2] = {center - lever, center + lever};
        const V3 off0 = to[0] - from0, off1 = to[1] - from1;
        const M stays = shift0.dot(shift0) + shift1.dot(shift1) == zero;
        auto kept = [&](const V3& x, const V3& y) -> V3 {
            return V3{stays ? x.x : y.x, stays ? x.y : y.y, stays ? x.z : y.z};
        };
        const int own = f + W < last ? W : last - f;
        put(now + 6ll * f, kept(from0, to[0]), kept(from1, to[1]), own);
        const V3 speed0 = transposed(rows[4]), speed1 = transposed(rows[5]);
        put(speed + 6ll * f, speed0 + shift0 * rate, speed1 + shift1 * rate, own);
        const V moved = __builtin_elementwise_sqrt(larger(off0.dot(off0), off1.dot(off1)));
        const V told = stays ? zero : moved;
        __builtin_memcpy((T*)segment_shift.data + f, &told, own * sizeof(T));
    }
"""


@cache
def make_native_rod_apply(name: str, module: str = "unique") -> Any:
    """Kernel `native_rod_apply`, over CHUNK rods each; takes what `rod_apply` takes."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)

    @wp.func_native(row_lanes(name) + PUT + TEXT)
    def apply_rods(
        first: wp.int32,
        last: wp.int32,
        share: real,
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        node_shift: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        segment_shift: wp.array(dtype=real),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def native_rod_apply(
        offset: wp.int32,
        carried: real,
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        node_shift: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        segment_shift: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        first = wp.static(CHUNK) * (wp.tid() + offset)
        apply_rods(
            first,
            wp.min(first + wp.static(CHUNK), fiber_group.shape[0]),
            carried / real(step_size[0]),
            groups,
            fiber_group,
            node_shift,
            node_pos,
            node_velocity,
            segment_shift,
        )

    return native_rod_apply
