"""Lubrication between the beads of two segments: all bead pairs within reach, summed.

Source: Sasayama & Inagaki 2018, Appendix A. A segment owns its first node and its inner beads, the
    last segment also the last node, so that no bead counts twice.
Symbols: D = `delta` from the start of a to the start of b, s and t fractions of a and b, bead m of
    i and n of j.
"""

from functools import cache

import warp as wp

from warpfiber.laws.lubrication import INNER, OUTER, make_lubrication
from warpfiber.model import precision
from warpfiber.passes.precision import group_struct


@cache
def make_bead_pairs(name: str, is_shifted: bool):
    """`lubricate(...)`: force on segment i, its moments and how many bead pairs act."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    lubrication_resistance = make_lubrication(name)
    zero, one, two = real(0.0), real(1.0), real(2.0)
    inner, outer = real(INNER), real(OUTER)

    @wp.func
    def bead_count(g: Group, at: wp.int32) -> wp.int32:
        """Beads owned by the segment `at` of its fiber."""
        count = g.inner_beads + 1
        if at == g.segments - 1:
            count += 1
        return count

    @wp.func
    def lubricate(
        gi: Group,
        gj: Group,
        at_i: wp.int32,
        at_j: wp.int32,
        delta: vec3,
        a: vec3,
        b: vec3,
        vi0: vec3,
        vi1: vec3,
        vj0: vec3,
        vj1: vec3,
        dt: real,
    ):
        """Force on segment i, its moments (sum of s F, sum of t F), number of bead pairs."""
        force = vec3(zero, zero, zero)
        arm_i = vec3(zero, zero, zero)
        arm_j = vec3(zero, zero, zero)
        active = wp.int32(0)
        contact = gi.radius + gj.radius
        reach2 = (outer * contact) * (outer * contact)
        nearest2 = (inner * contact) * (inner * contact)
        narrow = gi.radius * gj.radius / contact
        scale = (gi.drag / gi.radius) * narrow * narrow
        shift = zero
        if wp.static(is_shifted):
            shift = two / contact
        inverse_mass_dt = dt * (one / gi.mass + one / gj.mass)
        count_i = bead_count(gi, at_i)
        count_j = bead_count(gj, at_j)
        per_bead_j = real(gj.inner_beads + 1)
        step_i = one / real(gi.inner_beads + 1)
        step_j = one / per_bead_j
        bb = wp.dot(b, b)
        inverse_bb = one / bb
        span = outer * contact / wp.sqrt(bb) * per_bead_j
        for m in range(count_i):
            s = real(m) * step_i
            weight_i = one
            if m > 0 and m <= gi.inner_beads:
                weight_i = gi.bead_weight
            c0 = delta - s * a
            # beads of j within reach of this bead lie around its foot on the line of j
            foot = -wp.dot(c0, b) * inverse_bb
            if wp.length_sq(c0 + foot * b) > reach2:
                continue
            n_first = wp.max(wp.int32(wp.ceil(foot * per_bead_j - span)), 0)
            n_last = wp.min(wp.int32(wp.floor(foot * per_bead_j + span)), count_j - 1)
            for n in range(n_first, n_last + 1):
                t = real(n) * step_j
                c = c0 + t * b
                cc = wp.length_sq(c)
                if cc < nearest2 or cc > reach2:
                    continue
                weight = weight_i
                if n > 0 and n <= gj.inner_beads:
                    weight *= gj.bead_weight
                velocity = (one - t) * vj0 + t * vj1 - (one - s) * vi0 - s * vi1
                gap = wp.sqrt(cc) - contact
                resistance = lubrication_resistance(weight * scale, gap, shift, inverse_mass_dt)
                f = (resistance * wp.dot(velocity, c) / cc) * c
                force += f
                arm_i += s * f
                arm_j += t * f
                active += 1
        return force, arm_i, arm_j, active

    return lubricate
