"""Normal contact of two sphero-cylinders: Hertz at a point, along a line where nearly parallel.

Source: Hertz for elliptic contacts with the correction F_2 = 1 - (rho^0.0684 - 1)^1.531 (Johnson,
    Contact Mechanics); R* = 1 / sqrt(P) and rho = (S + D) / (S - D), D = sqrt(S^2 - 4 P), with S
    and P the sum and the product of the two principal relative curvatures: hemispheres, hemisphere
    on cylinder, cylinders at the angle alpha. Where fibers are nearly parallel a contact is longer
    than a segment: there every pair of segments takes its part, F = c pi/4 E* times the integral of
    the overlap over the length that the two have side by side, at the center of that overlap. c
    makes the sum over a whole patch that of Hertz, so it does not matter where the nodes are.
    Overlap along the line: (b^2 - |D(u)|^2) / (b + d_0), exact where it is deepest.
Symbols: b = r_a + r_b, E* = 1 / (e_a + e_b), e = (1 - nu^2) / E_c, delta overlap, D(u) from one
    axis to the other at the part u of a, d_0 their smallest distance as endless lines.
Limits: sin(alpha) is taken as 0.02 at least, where c = 1.17 instead of 1 of parallel cylinders.
"""

import math
from functools import cache

import warp as wp

from warpfiber.model import precision

LINE_COSINE = math.cos(math.radians(30.0))  # fibers at wider angles touch at a point
ALIGNED = LINE_COSINE**2 * (1.0 - 1e-5)  # squared cosine below which surely none is a line
LINE_PART = 0.25  # of a segment: shorter half patches are points
SMALLEST_SINE = 0.02
SLENDER, POWER = 0.0684, 1.531  # exponents of F_2


@cache
def make_capsule_contact(name):
    """`curvatures`, `hertz_factor`, `side_by_side`, `line_overlap`, `line_depth`, `line_square`."""
    p = precision(name)
    real, vec2, vec3, vec4 = p.real, p.vec2, p.vec3, p.vec4
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    tiny, far_away = real(1.0e-30), real(1.0e30)
    third, quarter, ninth = real(1.0 / 3.0), real(0.25), real(1.0 / 9.0)
    outermost = real(math.sqrt(0.6))  # of three Gauss points
    slender, power, steep = real(SLENDER), real(POWER), real(1.5 * SLENDER * POWER)

    @wp.func
    def curvatures(ends: wp.int32, ka: real, kb: real, sine: real) -> vec2:
        """(S, P); ends: 0 cylinders, 1 the end of a on b, 2 the end of b on a, 3 two ends."""
        total = ka + kb
        if ends == 0:
            return vec2(total, ka * kb * sine * sine)
        if ends == 1:
            return vec2(ka + total, ka * total)
        if ends == 2:
            return vec2(kb + total, kb * total)
        return vec2(two * total, total * total)

    @wp.func
    def hertz_factor(sp: vec2) -> vec2:
        """f = sqrt(R*) F_2^-1.5, and d ln f / d ln P."""
        difference = wp.sqrt(wp.max(sp[0] * sp[0] - real(4.0) * sp[1], zero))
        # (S + D) / (S - D) without the difference of numbers that are nearly equal
        ratio = (sp[0] + difference) * (sp[0] + difference) / (real(4.0) * sp[1])
        slope = wp.pow(ratio, slender) - one
        correction = one
        steepness = -quarter
        if slope > zero:
            lacking = wp.pow(slope, power)
            correction = one - lacking
            # d ln rho / d ln P = -S / D
            steepness -= steep * lacking / (slope * correction) * (one + slope) * sp[0] / difference
        factor = one / (wp.sqrt(wp.sqrt(sp[1])) * correction * wp.sqrt(correction))
        return vec2(factor, steepness)

    @wp.func
    def side_by_side(delta: vec3, a: vec3, b: vec3) -> vec4:
        """(s0, s1, t0, t1): parts s0 to s1 of a lie beside b; t0, t1 on b beside the ends of a.

        Beside along the mean direction. Nothing does where s1 <= s0. delta from the start of a to
        the start of b.
        """
        along = b
        if wp.dot(a, b) < zero:
            along = -b
        middle = wp.normalize(a / wp.length(a) + along / wp.length(along))
        la = wp.dot(a, middle)
        lb = wp.dot(b, middle)  # negative where b runs the other way
        start = wp.dot(delta, middle)
        low = wp.max(zero, wp.min(start, start + lb))
        high = wp.min(la, wp.max(start, start + lb))
        return vec4(low / la, high / la, -start / lb, (la - start) / lb)

    @wp.func
    def parabola(d0: vec3, d1: vec3, reach: real) -> vec4:
        """(q, b, c, d_0) of the overlap q - b u - c u^2 along D(u) = d0 + u (d1 - d0)."""
        dv = d1 - d0
        vv = wp.dot(dv, dv)
        dd = wp.dot(d0, dv)
        square = wp.length_sq(d0)
        closest = wp.sqrt(wp.max(square - dd * dd / wp.max(vv, tiny), zero))
        scale = one / (reach + closest)
        return vec4(scale * (reach * reach - square), scale * two * dd, scale * vv, closest)

    @wp.func
    def positive_range(q: real, b: real, c: real, low: real, high: real) -> vec2:
        """Where q - b u - c u^2 > 0 in low <= u <= high; its roots without large differences."""
        root = wp.sqrt(wp.max(b * b + real(4.0) * c * q, zero))
        if b < zero:
            root = -root
        t = -half * (b + root)
        near = -far_away
        if wp.abs(t) > tiny:
            near = -q / t
        beyond = far_away
        if t < zero:
            beyond = -far_away
        if wp.abs(t) < real(1.0e20) * c:
            beyond = t / c
        return vec2(wp.max(low, wp.min(near, beyond)), wp.min(high, wp.max(near, beyond)))

    @wp.func
    def line_square(d0: vec3, d1: vec3, reach: real, low: real, high: real) -> real:
        """Integral of the squared overlap, as `line_overlap`: three Gauss points are exact."""
        form = parabola(d0, d1, reach)
        found = positive_range(form[0], form[1], form[2], low, high)
        if reach <= form[3] or found[1] <= found[0]:
            return zero
        middle = half * (found[0] + found[1])
        reached = half * (found[1] - found[0])
        total = zero
        for k in range(3):
            u = middle + real(k - 1) * outermost * reached
            overlap = form[0] - (form[1] + form[2] * u) * u
            total += wp.where(k == 1, real(8.0), real(5.0)) * overlap * overlap
        return ninth * reached * total

    @wp.func
    def line_overlap(d0: vec3, d1: vec3, reach: real, low: real, high: real) -> vec4:
        """(integral of the overlap, its center, its length, deepest overlap of endless lines).

        D(u) = d0 + u (d1 - d0), low <= u <= high; all but the last in parts of a; 0 where nothing
        overlaps.
        """
        form = parabola(d0, d1, reach)
        depth = reach - form[3]
        if depth <= zero:
            return vec4(zero, zero, zero, depth)
        q = form[0]
        b = form[1]
        c = form[2]
        found = positive_range(q, b, c, low, high)
        u0 = found[0]
        u1 = found[1]
        if u1 <= u0:
            return vec4(zero, zero, zero, depth)
        w1 = u1 - u0
        w2 = half * (u1 * u1 - u0 * u0)
        w3 = third * (u1 * u1 * u1 - u0 * u0 * u0)
        w4 = quarter * (u1 * u1 * u1 * u1 - u0 * u0 * u0 * u0)
        integral = wp.max(q * w1 - b * w2 - c * w3, zero)
        moment = q * w2 - b * w3 - c * w4
        center = wp.clamp(moment / wp.max(integral, tiny), u0, u1)
        return vec4(integral, center, w1, depth)

    @wp.func
    def line_depth(d0: vec3, d1: vec3, reach: real, t0: real, t1: real, ratio: real) -> real:
        """Deepest overlap along both segments and a mean length beyond them at both ends.

        The same for neighbors that share a patch, whatever part of it is theirs. t0, t1: parts of b
        beside the ends of a; ratio: length of b over that of a.
        """
        dv = d1 - d0
        begin = -t0 / (t1 - t0)
        end = (one - t0) / (t1 - t0)
        beyond = half * (one + ratio)
        low = wp.min(zero, wp.min(begin, end)) - beyond
        high = wp.max(one, wp.max(begin, end)) + beyond
        u = wp.clamp(-wp.dot(d0, dv) / wp.max(wp.dot(dv, dv), tiny), low, high)
        return reach - wp.length(d0 + u * dv)

    return curvatures, hertz_factor, side_by_side, line_overlap, line_depth, line_square
