"""Hydrodynamic torque of a segment's beads as a couple of forces on its two nodes.

Source: Sasayama & Inagaki 2018, force F^ht of Eq. (1): T = 8 pi eta a^3 w (Omega - omega),
    omega = n x (v_2 - v_1) / d, force T x n / d on the second node and its opposite on the first.
    omega x n = (dv - n (n . dv)) / d.
Symbols: n unit vector of the segment, d its length, w beads whose torque it carries, Omega spin of
    the flow.
Limits: the twisting component of T is dropped, as in the paper.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_torque(name):
    """`torque_couple(strength, n, 1/d, dv, Omega)` -> force on the second node."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.func
    def torque_couple(strength: real, n: vec3, inverse: real, dv: vec3, spin: vec3) -> vec3:
        turning = inverse * (dv - wp.dot(n, dv) * n)
        return (strength * inverse) * (wp.cross(spin, n) - turning)

    return torque_couple
