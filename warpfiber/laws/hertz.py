"""Hertz contact of a node's sphere with a rigid plane, with its dashpot.

Source: F = 4/3 E* sqrt(a) delta^1.5, E* = E_c / (1 - nu^2) (Hertz); dashpot 2 sqrt(5/6) beta
    sqrt(k m) v with k = 2 E* sqrt(a delta) (Tsuji; Antypov & Elliott 2011), so that the coefficient
    of restitution does not depend on speed. The plane never pulls:
    e = exp(-beta (pi - 2 asin beta) / sqrt(1 - beta^2)).
Symbols: delta overlap, k stiffness, a radius, v speed away from the wall, m mass of the node.
Limits: a straight or convex fiber touches a plane at a node first.
"""

import math
from functools import cache

import warp as wp

from warpfiber.model import precision

DASHPOT = 2.0 * math.sqrt(5.0 / 6.0)


@cache
def make_hertz(name):
    """`plane_stiffness(E*, a, delta)`, `plane_push(k, beta, m, delta, v)` and `plane_energy`."""
    real = precision(name).real
    zero = real(0.0)
    # quotients in device code would be taken in float32
    dashpot, spring_part, energy_part = real(DASHPOT), real(2.0 / 3.0), real(8.0 / 15.0)

    @wp.func
    def plane_stiffness(modulus: real, radius: real, depth: real) -> real:
        return real(2.0) * modulus * wp.sqrt(radius * wp.max(depth, zero))

    @wp.func
    def plane_push(stiffness: real, beta: real, mass: real, depth: real, speed: real) -> real:
        spring = spring_part * stiffness * depth
        return wp.max(spring - dashpot * beta * wp.sqrt(stiffness * mass) * speed, zero)

    @wp.func
    def plane_energy(modulus: real, radius: real, depth: real) -> real:
        if depth <= zero:
            return zero
        return energy_part * modulus * wp.sqrt(radius * depth) * depth * depth

    return plane_stiffness, plane_push, plane_energy
