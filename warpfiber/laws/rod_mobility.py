"""Drag of a rigid rod of touching beads, how easily a point of it moves, how a couple turns it.

Source: bead drag 6 pi eta a summed along a rigid line of N beads, bead torque 8 pi eta a^3 over w
    of them: xi = 6 pi eta a N,  K_r = 2 pi eta a^3 (N (N^2 - 1) + 4 w).
    dp/dt = (I - p p^T) c is the motion of directions of light in a boost along c: exact for any t.
Symbols: bead drag zeta = 6 pi eta a, bead torque 8 pi eta a^3; p direction of the rod, n unit
    force, s arc position from the middle; w = N, or N - 1 with plain weights; c = H (F1 - F0)/K_r
    of forces F0, F1 at the ends of a rod of half length H.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_rod_mobility(name):
    """`turning_drag(torque, N, w)` = K_r; `point_mobility(zeta, torque, N, w, s, p.n)`: speed."""
    real = precision(name).real
    one, quarter = real(1.0), real(0.25)

    @wp.func
    def turning_drag(torque: real, beads: real, weight: real) -> real:
        return torque * (quarter * beads * (beads * beads - one) + weight)

    @wp.func
    def point_mobility(
        drag: real, torque: real, beads: real, weight: real, arc: real, along: real
    ) -> real:
        turning = turning_drag(torque, beads, weight)
        return one / (drag * beads) + arc * arc * (one - along * along) / turning

    return turning_drag, point_mobility


@cache
def make_rod_alignment(name):
    """`align(p, c t)`: p + T [u + T_2 ((u.p) u - p)], what c makes of p in the time t, not unit.

    u = c/|c|, T = tanh(|c| t), T_2 = tanh(|c| t/2). Its length is 1 + (u.p) T: nothing is left of a
    rod that stands against its couple for so long, and it keeps its direction.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    one, half = real(1.0), real(0.5)
    least = real(p.eps)

    @wp.func
    def align(p: vec3, couple: vec3) -> vec3:
        size = wp.length(couple)
        if size == real(0.0):
            return p
        u = couple / size
        along = wp.dot(u, p)
        turned = wp.tanh(size)
        if one + along * turned < least:
            return p
        return p + turned * (u + wp.tanh(half * size) * (along * u - p))

    return align
