"""Closest points of two segments, without branches.

Source: minimum of |D + t b - s a|^2 over s, t in [0, 1] by one Newton step and two clamped
    projections; equal to the case-by-case solution except that exactly parallel segments return one
    of their many closest pairs.
Symbols: a, b segment vectors, D from the start of a to the start of b, s and t fractions of a and
    b.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_segment_distance(name):
    """`closest_fractions(D, a, b)` -> vec2 (s, t), each in [0, 1]."""
    p = precision(name)
    real, vec2, vec3 = p.real, p.vec2, p.vec3
    eps = real(p.eps)
    tiny = real(1.0e-30)
    zero, one = real(0.0), real(1.0)

    @wp.func
    def fraction(x: real) -> real:
        """x between 0 and 1, as `wp.clamp` but without its care for what is not a number."""
        low = wp.where(x > zero, x, zero)
        return wp.where(low < one, low, one)

    @wp.func
    def closest_fractions(delta: vec3, a: vec3, b: vec3) -> vec2:
        aa = wp.max(wp.dot(a, a), tiny)
        bb = wp.max(wp.dot(b, b), tiny)
        ab = wp.dot(a, b)
        da = wp.dot(delta, a)
        db = wp.dot(delta, b)
        den = wp.max(aa * bb - ab * ab, eps * aa * bb)
        s = fraction((da * bb - db * ab) / den)
        t = fraction((s * ab - db) / bb)
        s = fraction((t * ab + da) / aa)
        return vec2(s, t)

    return closest_fractions
