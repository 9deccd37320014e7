"""Entries of the matrices of one fiber without inertia: drag of its beads, bending of its joints.

Source: bead drag projected on hat functions, zeta A with A of `closure` (Galerkin); bending energy
    k_b / (2 l^2) sum |x_(i+1) - 2 x_i + x_(i-1)|^2, of matrix k_b / l^2 D^T D with rows (1, -2, 1)
    of D; a segment resists turning by tau = 8 pi eta a^3 w / d^2 and by its tension, lambda / d.
Symbols: M = N_R + 1 spacing, N_seg segments, node i = 0 .. N_seg, w beads whose torque a segment
    carries, h effective step.
Limits: open fibers, straight at rest; no twist.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_chain_terms(name):
    """`drag_diagonal`, `bending_entries`, `turning_resistance` in the given precision."""
    p = precision(name)
    real, vec2 = p.real, p.vec2
    zero, one, two, four, six = real(0.0), real(1.0), real(2.0), real(4.0), real(6.0)

    @wp.func
    def drag_diagonal(spacing: real, node: wp.int32, segments: wp.int32) -> real:
        """A_ii: (M + 1)(2M + 1)/(6M) at an end, twice that minus 1 inside."""
        end = (spacing + one) * (two * spacing + one) / (six * spacing)
        if node == 0 or node == segments:
            return end
        return two * end - one

    @wp.func
    def bending_entries(node: wp.int32, segments: wp.int32) -> vec2:
        """(D^T D)_ii and (D^T D)_(i, i-1); the entry (i, i-2) is 1."""
        diagonal = zero
        below = zero
        if node >= 2:
            diagonal += one
            below -= two
        if node >= 1 and node < segments:
            diagonal += four
            below -= two
        if node + 2 <= segments:
            diagonal += one
        return vec2(diagonal, below)

    @wp.func
    def turning_resistance(strength: real, inverse: real, tension: real, h: real) -> real:
        """tau + h lambda / d, tau = strength / d^2; inverse = 1 / d."""
        return (strength * inverse + h * tension) * inverse

    return drag_diagonal, bending_entries, turning_resistance
