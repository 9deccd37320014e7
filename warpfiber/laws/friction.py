"""Tangential force of a contact: an elastic memory of its path, limited by Coulomb's law.

Source: Mindlin without partial slip, k_t = 8 G* sqrt(R* delta); the memory is kept in the plane of
    the contact and turns with the mean spin about the normal. A contact that is pressed deeper
    keeps its force, one that unloads its displacement, so that no energy is created (Thornton,
    Cummins & Cleary 2013). Sliding leaves the memory at the limit. The opposite rule, by which one
    that unloads is scaled, pressed one bed of 60 fibers and one of 100 harder by 2.4 and 3.1 % at a
    volume fraction of 0.415 (their scatter is not known), and left 1.2 instead of 1.0 % of the
    energy of a thrust unaccounted for.
Symbols: h elastic displacement of this side against the other, d overlap (k_t goes with its root),
    n normal, v tangential velocity of this side against the other.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision

SMALLEST = {"float32": 1e-36, "float64": 1e-300}  # what a product of squares is at least


@cache
def make_friction(name):
    """`carried_memory` and `friction_force` in the given precision."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    zero = real(0.0)
    tiny, smallest = real(1.0e-30), real(SMALLEST[name])

    @wp.func
    def carried_memory(h: vec3, d_before: real, d: real, n: vec3, turn: real) -> vec3:
        """h in the present plane, turned by `turn` (rad, small) about n; 0 without d_before."""
        if d_before <= zero:
            return vec3(zero, zero, zero)
        flat = h - wp.dot(h, n) * n
        flat += turn * wp.cross(n, flat)
        kept = wp.dot(h, h) * wp.min(d_before, d)
        return wp.sqrt(kept / wp.max(wp.dot(flat, flat) * d, smallest)) * flat

    @wp.func
    def friction_force(h: vec3, k: real, damping: real, v: vec3, limit: real):
        """Force on this side, and the memory that is left, for the present memory h."""
        force = -k * h - damping * v
        size = wp.length(force)
        if size <= limit:
            return force, h
        force *= limit / wp.max(size, tiny)
        return force, (real(-1.0) / k) * force

    return carried_memory, friction_force
