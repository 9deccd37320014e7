"""Lubrication rows of the beads of two segments: which bead pairs act, and their compliance.

Source: the bead pairs and weights of `bead_pairs`; c of law `lubrication` at the start of the step.
    Without a sign condition, base + J delta + (dt/c) f = 0.
Symbols: s and t fractions of a and b, D = `delta` from the start of a to the start of b.
"""

from functools import cache

import warp as wp

from warpfiber.laws.lubrication import INNER, OUTER, make_lubrication
from warpfiber.model import precision
from warpfiber.passes.precision import group_struct

# Of 1/a, below which a resistance that tends to zero at the end of its range is none.
SMALLEST_SHARE = 1e-6


@cache
def make_bead_rows(name: str, is_shifted: bool):
    """`bead_steps`, `bead_range`, `bead_resistance`."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    lubrication_resistance = make_lubrication(name)
    zero, one, two = real(0.0), real(1.0), real(2.0)
    inner, outer = real(INNER), real(OUTER)
    smallest = real(SMALLEST_SHARE)

    @wp.func
    def owned_beads(g: Group, at: wp.int32) -> wp.int32:
        """Beads of the segment `at` of its fiber: the last one alone has its last node."""
        if at == g.segments - 1:
            return g.inner_beads + 2
        return g.inner_beads + 1

    @wp.func
    def bead_range(c: vec3, b: vec3, g: Group, count: wp.int32, contact: real) -> wp.vec2i:
        """First and last bead of b that may lie within reach of a bead, c from it to b's start."""
        per = real(g.inner_beads + 1)
        inverse = one / wp.dot(b, b)
        foot = -wp.dot(c, b) * inverse
        reach = outer * contact
        if wp.length_sq(c + foot * b) > reach * reach:
            return wp.vec2i(0, -1)
        span = reach * wp.sqrt(inverse)
        first = wp.max(wp.int32(wp.ceil((foot - span) * per)), 0)
        last = wp.min(wp.int32(wp.floor((foot + span) * per)), count - 1)
        return wp.vec2i(first, last)

    @wp.func
    def bead_resistance(gi: Group, gj: Group, m: wp.int32, n: wp.int32, distance: real) -> real:
        """c of bead m of i and bead n of j, 0 out of range."""
        contact = gi.radius + gj.radius
        if distance < inner * contact or distance > outer * contact:
            return zero
        narrow = gi.radius * gj.radius / contact
        scale = (gi.drag / gi.radius) * narrow * narrow
        if m > 0 and m <= gi.inner_beads:
            scale *= gi.bead_weight
        if n > 0 and n <= gj.inner_beads:
            scale *= gj.bead_weight
        shift = zero
        if wp.static(is_shifted):
            shift = two / contact
        gap = distance - contact
        if one - shift * gap < smallest:
            return zero
        return lubrication_resistance(scale, gap, shift, zero)

    return owned_beads, bead_range, bead_resistance
