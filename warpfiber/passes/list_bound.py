"""Whether a neighbor list still holds every pair within its reach, at positions not yet taken.

Source: a segment as listed, carried by the flow since the build: the line from x_o + F (x - x_o) of
    one listed node to that of the other, longer by the extension of the list at both ends. If no
    node is farther than u from the line of each of its segments, no unlisted pair is within reach
    while 2 u + (1 - sigma_min(F)) h_list <= skin. What slides along itself, as rigid fibers do in a
    flow that would stretch them, uses up the extension first. A list whose use, growing as in the
    last step, would be too much in the next one is built before that, not after it has failed.
    Beside it, how far each segment may have moved off the flow since the start of the last step:
    with it a pair that was apart by d then stays apart by (1 - s) d - m_i - m_j (`pair_motion`).
Symbols: F deformation since the build, sigma_min its smallest singular value, h_list reach + skin,
    x_o origin of the flow; `use` of a list: farthest sliding and distance from the lines without
    end, and the largest u allowed; `share` its largest u over that. m_i motion of segment i beside
    that of the flow in a step, and what contact moved it in the step before; s largest strain of
    the flow in a step, as a bound of 1 - sigma_min.
"""

from functools import cache

import warp as wp

from warpfiber.model import EXPIRED, HALT, precision
from warpfiber.passes.native_list_bound import bound_text
from warpfiber.passes.pair_motion import CHUNK_SEGMENTS

FORESEEN = 2.0  # in place of a share, of which none that is kept is above 1


@cache
def make_list_bound(name: str, module: str = "unique", native: bool = False):
    """`bound_fibers`, `bound_list`, `foresee_list` in launch order, as a dict by name.

    `native`: the first over runs of CHUNK_SEGMENTS segments, for the CPU.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    zero, half, one = real(0.0), real(0.5), real(1.0)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.func
    def largest_strain(affine: mat33) -> real:
        """1 - sigma_min is at most the largest row sum of |sym(F - I)|."""
        stretch = zero
        for row in range(3):
            norm = zero
            for column in range(3):
                entry = half * (affine[row, column] + affine[column, row])
                if row == column:
                    entry -= real(1.0)
                norm += wp.abs(entry)
            stretch = wp.max(stretch, norm)
        return stretch

    @wp.func
    def farthest_motion(affine: mat33, sizes: wp.array(dtype=real)) -> real:
        """Largest |u| allowed."""
        return half * (sizes[1] - largest_strain(affine) * sizes[0])

    @wp.func
    def step_push(before: wp.array(dtype=wp.mat33d), after: wp.array(dtype=wp.mat33d)) -> mat33:
        """F of the step alone."""
        return mat33(after[0] * wp.inverse(before[0]))

    @wp.func
    def is_new(before: wp.array(dtype=wp.mat33d)) -> wp.bool:
        """Whether the flow has carried nothing since the build: pairs are not those of before."""
        carried = before[0] - wp.identity(n=3, dtype=wp.float64)
        return wp.ddot(carried, carried) == wp.float64(0.0)

    if not native:

        @wp.kernel(**options)
        def bound_fibers(
            offset: wp.int32,
            flow_origin: vec3,
            segments: wp.int32,
            spares: wp.int32,
            segment_node: wp.array(dtype=wp.int32),
            list_sizes: wp.array(dtype=real),
            segment_extension: wp.array(dtype=real),
            fiber_node_start: wp.array(dtype=wp.int32),
            deformation_back: wp.array(dtype=wp.mat33d),
            deformation: wp.array(dtype=wp.mat33d),
            list_pos: wp.array(dtype=vec3),
            node_back: wp.array(dtype=vec3),
            node_pos: wp.array(dtype=vec3),
            segment_shift: wp.array(dtype=real),
            shift_again: wp.array(dtype=real),
            status: wp.array(dtype=wp.int32),
            pairs_known_out: wp.array(dtype=wp.int32),
            step_strain_out: wp.array(dtype=real),
            segment_moved_out: wp.array(dtype=real),
            short_out: wp.array(dtype=wp.int64),
            use_out: wp.array(dtype=vec3),
            share_out: wp.array(dtype=real),
        ):
            if status[wp.static(HALT)] != 0:
                return
            fiber = wp.tid() + offset
            affine = mat33(deformation[0])
            limit = farthest_motion(affine, list_sizes)
            push = step_push(deformation_back, deformation)
            if fiber == 0:
                step_strain_out[0] = largest_strain(push)
                if is_new(deformation_back):
                    pairs_known_out[0] = 0
            found = wp.int64(0)
            slid = zero
            across = zero
            most = zero
            for i in range(fiber_node_start[fiber], fiber_node_start[fiber + 1] - 1):
                listed = list_pos[i + 1] - list_pos[i]
                length = wp.length(listed)
                longer = list_sizes[2]
                if segment_extension.shape[0] > 0:
                    longer = segment_extension[i - fiber]
                beyond = longer / length
                start = flow_origin + affine * (list_pos[i] - flow_origin)
                axis = affine * listed
                inverse = one / wp.dot(axis, axis)
                moved2 = zero
                for end in range(2):
                    apart = node_pos[i + end] - start
                    s = wp.dot(apart, axis) * inverse
                    nearest = wp.clamp(s, -beyond, one + beyond)
                    off = wp.length_sq(apart - nearest * axis)
                    if not (off <= limit * limit):
                        found = wp.int64(1)
                    most = wp.max(most, off)
                    slid = wp.max(slid, wp.max(-s, s - one) * length)
                    across = wp.max(across, wp.length_sq(apart - s * axis))
                    carried = push * (node_back[i + end] - flow_origin)
                    moved2 = wp.max(moved2, wp.length_sq(node_pos[i + end] - flow_origin - carried))
                s_at = i - fiber
                segment_moved_out[s_at] = wp.sqrt(moved2) + segment_shift[s_at] + shift_again[s_at]
            if limit < zero:
                found = wp.int64(1)
            short_out[fiber] = found
            use_out[fiber] = vec3(slid, wp.sqrt(across), limit)
            share_out[fiber] = wp.sqrt(most) / wp.max(limit, real(1e-30))

    @wp.kernel(**options)
    def bound_list(
        fiber_short: wp.array(dtype=wp.int64),
        fiber_use: wp.array(dtype=vec3),
        fiber_share: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        list_short_out: wp.array(dtype=wp.int32),
        list_use_out: wp.array(dtype=vec3),
        list_share_out: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        found = wp.int32(0)
        use = vec3()
        share = zero
        for fiber in range(fiber_short.shape[0]):
            share = wp.max(share, fiber_share[fiber])
            if fiber_short[fiber] != wp.int64(0):
                found = 1
            use = wp.max(use, fiber_use[fiber])
        list_short_out[0] = found
        list_use_out[0] = use
        list_share_out[0] = share

    @wp.kernel(**options)
    def foresee_list(
        rejected: wp.array(dtype=wp.int32),
        list_share: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        share_back: wp.array(dtype=real),
        pairs_known: wp.array(dtype=wp.int32),
    ):
        """At the end of a step that is kept; `share_back` its share, 0 where the list is new.

        `pairs_known`: how far its pairs stayed apart bounds how near they come in the next one,
        unless the list is new by then.
        """
        if status[wp.static(HALT)] + rejected[0] != 0:
            return
        pairs_known[0] = 1
        share = list_share[0]
        foreseen = share + (share - share_back[0])
        share_back[0] = share
        if foreseen > one:
            status[wp.static(EXPIRED)] = 1
            share_back[0] = real(wp.static(FORESEEN))

    names = ["bound_fibers", "bound_list", "foresee_list"]
    if not native:  # vectors are no code for CUDA
        return dict(zip(names, [bound_fibers, bound_list, foresee_list], strict=True))

    @wp.func_native(bound_text(name))
    def bound_block(
        first: wp.int32,
        last: wp.int32,
        at_out: wp.int32,
        flow_origin: vec3,
        affine: mat33,
        push: mat33,
        limit: real,
        spares: wp.int32,
        extension: real,
        segment_extension: wp.array(dtype=real),
        segment_node: wp.array(dtype=wp.int32),
        list_pos: wp.array(dtype=vec3),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        segment_shift: wp.array(dtype=real),
        shift_again: wp.array(dtype=real),
        segment_moved: wp.array(dtype=real),
        short_out: wp.array(dtype=wp.int64),
        use_out: wp.array(dtype=vec3),
        share_out: wp.array(dtype=real),
    ): ...

    @wp.kernel(**options)
    def native_bound(
        offset: wp.int32,
        flow_origin: vec3,
        segments: wp.int32,
        spares: wp.int32,
        segment_node: wp.array(dtype=wp.int32),
        list_sizes: wp.array(dtype=real),
        segment_extension: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        deformation_back: wp.array(dtype=wp.mat33d),
        deformation: wp.array(dtype=wp.mat33d),
        list_pos: wp.array(dtype=vec3),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        segment_shift: wp.array(dtype=real),
        shift_again: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        pairs_known_out: wp.array(dtype=wp.int32),
        step_strain_out: wp.array(dtype=real),
        segment_moved_out: wp.array(dtype=real),
        short_out: wp.array(dtype=wp.int64),
        use_out: wp.array(dtype=vec3),
        share_out: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        chunk = wp.tid() + offset
        first = chunk * wp.static(CHUNK_SEGMENTS)
        affine = mat33(deformation[0])
        push = step_push(deformation_back, deformation)
        if chunk == 0:
            step_strain_out[0] = largest_strain(push)
            if is_new(deformation_back):
                pairs_known_out[0] = 0
        bound_block(
            first,
            wp.min(first + wp.static(CHUNK_SEGMENTS), segments),
            chunk,
            flow_origin,
            affine,
            push,
            farthest_motion(affine, list_sizes),
            spares,
            list_sizes[2],
            segment_extension,
            segment_node,
            list_pos,
            node_back,
            node_pos,
            segment_shift,
            shift_again,
            segment_moved_out,
            short_out,
            use_out,
            share_out,
        )

    return dict(zip(names, [native_bound, bound_list, foresee_list], strict=True))
