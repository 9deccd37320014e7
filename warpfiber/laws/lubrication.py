"""Squeeze-film resistance between two beads.

Source: Sasayama & Inagaki 2018, Eq. (A.3): c = 3 pi eta a^2 / (2 h) for 2.001 a <= D <= 3 a, h = D
    - 2a; for unequal radii 6 pi eta (a1 a2 / (a1 + a2))^2 / h. `shifted` subtracts the value at 3a,
    where the published form jumps by a quarter of the Stokes drag.
Symbols: h gap, D bead distance, c resistance (N s/m).
Limits: `limited` replaces c by c / (1 + c dt (1/m1 + 1/m2)), the resistance that an implicit step
    of the two beads alone would feel. It tends to c as dt -> 0 and removes the limit that 250
    Stokes drags at 2.001 a would put on dt.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision

INNER = 1.0005  # of the sum of the radii
OUTER = 1.5


@cache
def make_lubrication(name):
    """`lubrication_resistance(scale, h, shift, k)`, scale = 6 pi eta (a1 a2 / (a1 + a2))^2."""
    real = precision(name).real
    one = real(1.0)

    @wp.func
    def lubrication_resistance(scale: real, gap: real, shift: real, inverse_mass_dt: real) -> real:
        # c = scale (1/h - shift), shift = 1/a or 0; c / (1 + c k) with one division
        share = scale * (one - shift * gap)
        return share / (gap + share * inverse_mass_dt)

    return lubrication_resistance
