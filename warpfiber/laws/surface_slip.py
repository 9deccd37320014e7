"""Slip of the surfaces of two fibers where they touch, and what a force there does to a fiber.

Source: the surface at n times the radius off the center line moves with it, turns with its segment
    and rolls about it:
        v_s = v(s) +- [ (a/l) ((n.dv) p - (n.p) dv) + theta a n x p ]
    + for the slip of the partner over the owner, whichever of both the fiber is. A force F on the
    partner, -F on the owner, is a force on the center line, a couple a F x n on either fiber whose
    part across p is one of forces -/+ C on the two nodes of the segment, and a torque about p:
        C = (a/l) (n (F.p) - F (n.p)),  tau = a p.(F x n) = F.(a n x p)
    The second are the adjoint of the first, so no force of friction can do work on the fluid.
    Coulomb: |F| <= limit.
Symbols: n unit normal from the owner to its partner, p unit vector of the segment, l its length, a
    radius, dv motion of its second node less that of the first, theta angle about p.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_surface_slip(name):
    """`surface_turn(n, p, a/l, dv)`, `surface_roll(n, p, a)`, `surface_couple(n, p, a/l, F)`."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.func
    def surface_turn(n: vec3, axis: vec3, share: real, turn: vec3) -> vec3:
        return share * (wp.dot(n, turn) * axis - wp.dot(n, axis) * turn)

    @wp.func
    def surface_roll(n: vec3, axis: vec3, radius: real) -> vec3:
        return radius * wp.cross(n, axis)

    @wp.func
    def surface_couple(n: vec3, axis: vec3, share: real, force: vec3) -> vec3:
        return share * (wp.dot(force, axis) * n - wp.dot(n, axis) * force)

    return surface_turn, surface_roll, surface_couple


@cache
def make_coulomb(name):
    """`coulomb_force(F, n, limit)`: F in the plane of the contact, no larger than the limit."""
    p = precision(name)
    real, vec3 = p.real, p.vec3

    @wp.func
    def coulomb_force(force: vec3, n: vec3, limit: real) -> vec3:
        flat = force - wp.dot(force, n) * n
        size = wp.length(flat)
        if size <= limit:
            return flat
        return (limit / size) * flat

    return coulomb_force
