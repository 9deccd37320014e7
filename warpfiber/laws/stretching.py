"""Axial spring of a segment.

Source: Sasayama & Inagaki 2018, F^S of Eq. (1); k_s = E A / l = pi a E / (2 M) makes the axial
    stiffness of the whole fiber E A / L for every number of segments.
Symbols: d length, l rest length, n unit vector from the first to the second node.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_stretching(name):
    """`stretching_force(k_s, d, l, n)` -> force on the first node (opposite on the second)."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.func
    def stretching_force(stiffness: real, d: real, rest: real, n: vec3) -> vec3:
        return stiffness * (d - rest) * n

    return stretching_force
