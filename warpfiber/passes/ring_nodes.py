"""Which nodes and segments follow one another along a fiber, over the closure of a ring too.

A ring of n nodes has n segments; the last of them goes from the last node to the first.
Source: the numbering of `build`; the vertex rule is that of `pairs.is_local_minimum`.
Symbols: at, number of a segment within its fiber; ring, nodes of a ring, 0 of an open fiber.
Limits: where a scene has no rings, what is returned here knows open fibers alone.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision
from warpfiber.passes.pairs import END_TOLERANCE


@cache
def make_ring_nodes(closed: bool):
    """`has_before`, `has_after`, `node_before`, `node_after`, `node_beyond`, `segment_over`."""

    @wp.func
    def has_before(at: wp.int32, ring: wp.int32) -> wp.bool:
        if wp.static(closed):
            if ring > 0:
                return True
        return at > 0

    @wp.func
    def has_after(at: wp.int32, segments: wp.int32, ring: wp.int32) -> wp.bool:
        if wp.static(closed):
            if ring > 0:
                return True
        return at < segments - 1

    @wp.func
    def node_before(node: wp.int32, at: wp.int32, ring: wp.int32) -> wp.int32:
        """The one before the first node of a segment, if there is any."""
        if wp.static(closed):
            if ring > 0 and at == 0:
                return node + ring - 1
        return node - 1

    @wp.func
    def node_after(node: wp.int32, at: wp.int32, ring: wp.int32) -> wp.int32:
        """Second node of a segment."""
        if wp.static(closed):
            if ring > 0 and at == ring - 1:
                return node - at
        return node + 1

    @wp.func
    def node_beyond(node: wp.int32, at: wp.int32, ring: wp.int32) -> wp.int32:
        """The one after the second node of a segment, if there is any."""
        if wp.static(closed):
            if ring > 0 and at >= ring - 2:
                return node + 2 - ring
        return node + 2

    @wp.func
    def segment_over(
        i: wp.int32, at: wp.int32, segments: wp.int32, ring: wp.int32, forward: wp.bool
    ) -> wp.int32:
        """The next segment over the second or the first node; i itself where the fiber ends."""
        if forward:
            if wp.static(closed):
                if ring > 0:
                    return wp.where(at == ring - 1, i - at, i + 1)
            return wp.where(at < segments - 1, i + 1, i)
        if wp.static(closed):
            if ring > 0:
                return wp.where(at == 0, i + ring - 1, i - 1)
        return wp.where(at > 0, i - 1, i)

    return has_before, has_after, node_before, node_after, node_beyond, segment_over


@cache
def make_ring_minimum(name: str):
    """`is_ring_minimum`: the vertex rule where fibers may be rings."""
    p = precision(name)
    real, vec2, vec3 = p.real, p.vec2, p.vec3
    has_before, has_after, node_before, _, _, _ = make_ring_nodes(True)
    one, near = real(1.0), real(END_TOLERANCE[name])

    @wp.func
    def is_ring_minimum(
        st: vec2,
        c: vec3,
        node_i: wp.int32,
        at_i: wp.int32,
        segments_i: wp.int32,
        ring_i: wp.int32,
        node_j: wp.int32,
        at_j: wp.int32,
        segments_j: wp.int32,
        ring_j: wp.int32,
        node_pos: wp.array(dtype=vec3),
    ) -> wp.bool:
        if st[0] >= one - near and has_after(at_i, segments_i, ring_i):
            return False
        if st[1] >= one - near and has_after(at_j, segments_j, ring_j):
            return False
        if st[0] <= near and has_before(at_i, ring_i):
            back = node_pos[node_i] - node_pos[node_before(node_i, at_i, ring_i)]
            if wp.dot(c, back) < -near * wp.dot(back, back):
                return False
        if st[1] <= near and has_before(at_j, ring_j):
            back = node_pos[node_j] - node_pos[node_before(node_j, at_j, ring_j)]
            if wp.dot(c, back) > near * wp.dot(back, back):
                return False
        return True

    return is_ring_minimum
