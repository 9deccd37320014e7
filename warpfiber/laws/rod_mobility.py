"""Drag of a rigid rod of touching beads, and how easily a point of it moves.

Source: bead drag 6 pi eta a and bead torque 8 pi eta a^3 summed along a rigid line of N beads:
    xi = 6 pi eta a N,  K_r = 2 pi eta a^3 N (N^2 + 3).
Symbols: bead drag zeta = 6 pi eta a, bead torque 8 pi eta a^3; p direction of the rod, n unit
    force, s arc position from the middle.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_rod_mobility(name):
    """`turning_drag(torque, N)` = K_r; `point_mobility(zeta, torque, N, s, p.n)`: speed along n."""
    real = precision(name).real
    one, three, quarter = real(1.0), real(3.0), real(0.25)

    @wp.func
    def turning_drag(torque: real, beads: real) -> real:
        return quarter * torque * beads * (beads * beads + three)

    @wp.func
    def point_mobility(drag: real, torque: real, beads: real, arc: real, along: real) -> real:
        turning = turning_drag(torque, beads)
        return one / (drag * beads) + arc * arc * (one - along * along) / turning

    return turning_drag, point_mobility
