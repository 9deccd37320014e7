"""Bending of the joint between two segments.

Source: Sasayama & Inagaki 2018, F^b of Eq. (1): minus the gradient of k_b theta^2 / 2, with theta
    the joint angle and k_b = E I / l = pi a^3 E / (8 M).
Symbols: n0, n1 unit vectors of the two segments, d0, d1 their lengths.
Limits: straight rest shape. At theta = pi the direction of unbending is undefined; the factor
    theta / sin(theta) is held at its value for sin(theta) = 1e-6 there.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_bending(name):
    """`bending_factor(n0, n1)` = theta/sin(theta) and `bending_angle(n0, n1)` = theta."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.func
    def bending_angle(n0: vec3, n1: vec3) -> real:
        return wp.atan2(wp.length(wp.cross(n0, n1)), wp.dot(n0, n1))

    @wp.func
    def bending_factor(n0: vec3, n1: vec3) -> real:
        sine = wp.length(wp.cross(n0, n1))
        cosine = wp.dot(n0, n1)
        if sine < real(1.0e-4) and cosine > real(0.0):
            return real(1.0) + sine * sine / real(6.0)
        return wp.atan2(sine, cosine) / wp.max(sine, real(1.0e-6))

    @wp.func
    def bending_forces(stiffness: real, n0: vec3, d0: real, n1: vec3, d1: real):
        """Forces on the nodes before and after the joint; the joint takes minus their sum."""
        moment = stiffness * bending_factor(n0, n1)
        cosine = wp.dot(n0, n1)
        after = moment * (n0 - cosine * n1) / d1
        before = -moment * (n1 - cosine * n0) / d0
        return before, after

    return bending_angle, bending_forces
