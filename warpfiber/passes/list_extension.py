"""By how much each segment is listed longer than it is: what it will slide along itself.

Inextensible fibers slide along themselves in a flow that would stretch or shorten them, the more
the farther from their middle. Listed as long as the fastest one asks for, the others would have
pairs to no use.

Source: a segment with the axis n slides off its line, as the flow carries it, at the rate
    r = max(0, -n.(v_0 - u_0), n.(v_1 - u_1))
    and is listed longer by E min(1, FLOOR + SPARE r / r_max) at both ends; what slides by more uses
    up the skin (`list_bound`).
Symbols: v, u velocity of a node and of the flow there; E extension of the list, chosen by what the
    farthest slid in the time of the list before.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.laws.flow import make_flow
from warpfiber.model import precision

FLOOR, SPARE = 0.15, 1.1


@cache
def make_extension_kernels(name: str, module: str = "unique") -> dict[str, Any]:
    """`slide_segments`, `fastest_slide`, `extend_segments` in launch order, as a dict by name.

    They keep what there is where fibers are not wrapped: a list that is built again as it was.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    flow_velocity, _ = make_flow(name)
    zero, one = real(0.0), real(1.0)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def slide_segments(
        offset: wp.int32,
        flow_origin: vec3,
        gradient: wp.array(dtype=mat33),
        segment_node: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        slide_out: wp.array(dtype=real),
    ):
        i = wp.tid() + offset
        node = segment_node[i]
        start = node_pos[node]
        end = node_pos[node + 1]
        axis = wp.normalize(end - start)
        behind = wp.dot(axis, flow_velocity(gradient[0], flow_origin, start) - node_velocity[node])
        ahead = node_velocity[node + 1] - flow_velocity(gradient[0], flow_origin, end)
        slide_out[i] = wp.max(zero, wp.max(behind, wp.dot(axis, ahead)))

    @wp.kernel(**options)
    def fastest_slide(slide: wp.array(dtype=real), fastest_out: wp.array(dtype=real)):
        most = zero
        for i in range(slide.shape[0]):
            most = wp.max(most, slide[i])
        fastest_out[0] = most

    @wp.kernel(**options)
    def extend_segments(
        offset: wp.int32,
        wraps: wp.array(dtype=wp.int32),
        sizes: wp.array(dtype=wp.float64),
        slide: wp.array(dtype=real),
        fastest: wp.array(dtype=real),
        extension_out: wp.array(dtype=real),
    ):
        if wraps[0] == 0:
            return
        i = wp.tid() + offset
        share = one
        if fastest[0] > zero:
            share = wp.min(one, real(FLOOR) + real(SPARE) * slide[i] / fastest[0])
        extension_out[i] = share * real(sizes[2])

    kernels = [slide_segments, fastest_slide, extend_segments]
    return dict(zip(["slide_segments", "fastest_slide", "extend_segments"], kernels, strict=True))
