"""Pace of fibers that spring far in a step: the share of it for which forces act on them.

In a packed cell a fiber that slips off another springs back by several radii, faster than any step
resolves; others would have to be looked for all around it. Such a fiber takes more steps for it.
Source: a motion without contact that leads farther than MOST_MOVE radii across the fiber, beside
    that of the flow, is repeated with elastic and contact forces that act for a part of the step:
        (R + T) (v - u) = pace F
    as if the liquid were more viscous around this fiber. What the flow does to a rigid fiber does
    not depend on its viscosity.
Symbols: F deformation of the flow in the step; u flow, v fiber.
Limits: a motion that a step would complete is not shortened in proportion; the pace of no fiber is
    below LEAST. As dt goes to 0 every pace is 1.
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.held_nodes import FROZEN
from warpfiber.passes.precision import group_struct

MOST_MOVE = 1.0  # radii
LEAST = 1.0 / 64.0


@cache
def make_chain_pace(name: str, module: str = "unique"):
    """Kernel `set_pace` (one thread per fiber): its pace; the start of a step to be repeated."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    one, least, most_move = real(1.0), real(LEAST), real(MOST_MOVE)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def set_pace(
        offset: wp.int32,
        flow_origin: vec3,
        deformation: wp.array(dtype=wp.mat33d),
        deformation_next: wp.array(dtype=wp.mat33d),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        node_hold: wp.array(dtype=wp.uint8),
        node_back: wp.array(dtype=vec3),
        velocity_back: wp.array(dtype=vec3),
        tension_back: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
        fiber_pace_out: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        fiber_pace_out[fiber] = one
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        if wp.int32(node_hold[first]) == wp.static(FROZEN):
            return
        affine = mat33(deformation_next[0] * wp.inverse(deformation[0]))
        most = real(0.0)
        for i in range(first, last):
            start = flow_origin + affine * (node_back[i] - flow_origin)
            axis = wp.normalize(affine * (node_back[i + 1] - node_back[i]))
            for end in range(2):
                apart = node_pos[i + end] - start
                most = wp.max(most, wp.length_sq(apart - wp.dot(apart, axis) * axis))
        limit = most_move * groups[fiber_group[fiber]].radius
        if not (most > limit * limit):
            return
        fiber_pace_out[fiber] = wp.max(limit / wp.sqrt(most), least)
        for i in range(first, last + 1):
            node_pos[i] = node_back[i]
            node_velocity[i] = velocity_back[i]
            if i < last:
                tension[i - fiber] = tension_back[i - fiber]

    return set_pace
