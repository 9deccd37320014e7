"""Hydrodynamic drag of one bead, the only distributed force besides gravity.

Source: Sasayama & Inagaki 2018, Eq. (3); Stokes: F = zeta (u - v), zeta = 6 pi eta a.
Symbols: half_drag = zeta dt / 2.
Limits: no hydrodynamic interaction between beads.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_drag(name):
    """`drag_force(zeta, u, v)` and `damped_mass(mass, half_drag)` in the given precision."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.func
    def drag_force(zeta: real, u: vec3, v: vec3) -> vec3:
        return zeta * (u - v)

    @wp.func
    def damped_mass(mass: real, half_drag: real) -> real:
        """Mass m* of the step m* (v1 - v0) = dt (zeta (u - v0) + F) that is stable for any drag.

        m + zeta dt / 2 takes the drag at the middle of the step (second order). Where that would
        overshoot (zeta dt > 2 m), zeta dt gives the velocity u + F / zeta of a massless bead. The
        published beta^R, and so the drag, can become negative; it then stays explicit.
        """
        return wp.max(mass, half_drag + wp.max(mass, half_drag))

    return drag_force, damped_mass
