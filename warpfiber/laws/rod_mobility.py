"""Drag of a rigid rod of touching beads, and how easily a point of it moves.

Source: bead drag 6 pi eta a summed along a rigid line of N beads, bead torque 8 pi eta a^3 over w
    of them: xi = 6 pi eta a N,  K_r = 2 pi eta a^3 (N (N^2 - 1) + 4 w).
Symbols: bead drag zeta = 6 pi eta a, bead torque 8 pi eta a^3; p direction of the rod, n unit
    force, s arc position from the middle; w = N, or N - 1 with plain weights.
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
