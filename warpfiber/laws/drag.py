"""Hydrodynamic drag of one bead, the only distributed force besides gravity.

Source: Sasayama & Inagaki 2018, Eq. (3); Stokes: F = zeta (u - v), zeta = 6 pi eta a.
Limits: no hydrodynamic interaction between beads.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_drag(name):
    """`drag_force(zeta, u, v)` in the given precision."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.func
    def drag_force(zeta: real, u: vec3, v: vec3) -> vec3:
        return zeta * (u - v)

    return drag_force
