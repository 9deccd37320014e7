"""Whether a neighbor list still holds every pair within its reach, at positions not yet taken.

Source: motion u = x - x_o - F (x_build - x_o) beside the flow since the build; no unlisted pair is
    within reach while 2 max|u| + (1 - sigma_min(F)) h_list <= skin.
Symbols: F deformation since the build, sigma_min its smallest singular value, h_list reach + skin,
    x_o origin of the flow.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, precision


@cache
def make_list_bound(name: str):
    """`bound_fibers` and `bound_list` in launch order, as a dict by name."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    zero, half = real(0.0), real(0.5)
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

    @wp.func
    def farthest_motion(affine: mat33, sizes: wp.array(dtype=real)) -> real:
        """Largest |u| allowed: 1 - sigma_min is at most the largest row sum of |sym(F - I)|."""
        stretch = zero
        for row in range(3):
            norm = zero
            for column in range(3):
                entry = half * (affine[row, column] + affine[column, row])
                if row == column:
                    entry -= real(1.0)
                norm += wp.abs(entry)
            stretch = wp.max(stretch, norm)
        return half * (sizes[1] - stretch * sizes[0])

    @wp.kernel(**options)
    def bound_fibers(
        offset: wp.int32,
        flow_origin: vec3,
        list_sizes: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        deformation: wp.array(dtype=wp.mat33d),
        list_pos: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        short_out: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        affine = mat33(deformation[0])
        limit = farthest_motion(affine, list_sizes)
        found = wp.int32(0)
        for i in range(fiber_node_start[fiber], fiber_node_start[fiber + 1]):
            moved = node_pos[i] - flow_origin - affine * (list_pos[i] - flow_origin)
            if not (wp.length_sq(moved) <= limit * limit):
                found = 1
        if limit < zero:
            found = 1
        short_out[fiber] = found

    @wp.kernel(**options)
    def bound_list(
        fiber_short: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        list_short_out: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        found = wp.int32(0)
        for fiber in range(fiber_short.shape[0]):
            found = wp.max(found, fiber_short[fiber])
        list_short_out[0] = found

    return {"bound_fibers": bound_fibers, "bound_list": bound_list}
