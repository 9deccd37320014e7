"""Rotation of a node over one step.

Source: q <- exp(w dt) q, the exact turn by a constant angular velocity. cos and sin(h) / h of the
    half angle h are power series in h^2 up to h = 0.1, exact to 1e-17 there; the length of q is
    brought back by one Newton step, exact for what rounding changes in one step.
Symbols: q quaternion (x, y, z, w), w angular velocity in the world's axes.
"""

import math
from functools import cache

import warp as wp

from warpfiber.model import precision

LARGEST_HALF_ANGLE = 0.1  # up to which the series is used


@cache
def make_rotation(name):
    """`turned(q, w, dt)` = normalized exp(w dt) q."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    one, half = real(1.0), real(0.5)
    largest = real(LARGEST_HALF_ANGLE**2)
    # quotients in device code would be taken in float32
    c = [real((-1.0) ** n / math.factorial(2 * n)) for n in range(6)]
    s = [real((-1.0) ** n / math.factorial(2 * n + 1)) for n in range(6)]

    @wp.func
    def turned(q: vec4, w: vec3, dt: real) -> vec4:
        half_turn = (half * dt) * w
        z = wp.length_sq(half_turn)
        cosine = wp.static(c[3]) + z * (wp.static(c[4]) + z * wp.static(c[5]))
        cosine = one + z * (wp.static(c[1]) + z * (wp.static(c[2]) + z * cosine))
        sine = wp.static(s[3]) + z * (wp.static(s[4]) + z * wp.static(s[5]))
        sine = one + z * (wp.static(s[1]) + z * (wp.static(s[2]) + z * sine))
        if z > largest:
            h = wp.sqrt(z)
            cosine = wp.cos(h)
            sine = wp.sin(h) / h
        r = sine * half_turn
        v = vec3(q[0], q[1], q[2])
        vector = cosine * v + q[3] * r + wp.cross(r, v)
        new = vec4(vector[0], vector[1], vector[2], cosine * q[3] - wp.dot(r, v))
        return (real(1.5) - half * wp.length_sq(new)) * new

    return turned
