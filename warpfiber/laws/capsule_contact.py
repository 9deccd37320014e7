"""Normal contact of two sphero-cylinders: Hertz for elliptic contacts.

Source: F = 4/3 E* f delta^1.5, f = sqrt(R*) F_2^-1.5 with the correction F_2 = 1 - (rho^0.0684 -
    1)^1.531 (Johnson, Contact Mechanics); R* = 1 / sqrt(P) and rho = (S + D) / (S - D), D =
    sqrt(S^2 - 4 P), with S and P the sum and the product of the two principal relative curvatures:
    hemispheres, hemisphere on cylinder, cylinders at the angle alpha. With x = 4 P / S^2 the factor
    is f sqrt(P) = sqrt(S / 2) T(x), T = x^(1/4) F_2^-1.5 (`hertz_table`). What of a patch two
    segments share: `capsule_patch`.
Symbols: r radius, m = r_a r_b, E* = 1 / (e_a + e_b), e = (1 - nu^2) / E_c, delta overlap.
Limits: sin(alpha) is to be 0.02 at least, where the patch of parallel cylinders would be endless.
"""

from functools import cache

import warp as wp

from warpfiber.laws.hertz_table import POWER, SLENDER, STEEP, make_hertz_table
from warpfiber.model import precision

SMALLEST_SINE = 0.02


@cache
def make_capsule_contact(name):
    """`curvatures` and `hertz_factor`."""
    p = precision(name)
    real, vec2 = p.real, p.vec2
    zero, one, two, four, quarter = (real(x) for x in (0.0, 1.0, 2.0, 4.0, 0.25))
    slender, power, steep = real(SLENDER), real(POWER), real(STEEP)
    is_tabled, table_factor = make_hertz_table(name)

    @wp.func
    def curvatures(ends: wp.int32, ra: real, rb: real) -> vec2:
        """m S and x; ends: 0 cylinders that cross, 1 the end of a on b, 2 of b on a, 3 two ends."""
        total = ra + rb
        sum = total
        product = ra * rb
        if ends == 1:
            sum = rb + total
            product = rb * total
        if ends == 2:
            sum = ra + total
            product = ra * total
        if ends == 3:
            sum = two * total
            product = total * total
        return vec2(sum, four * product / (sum * sum))

    @wp.func
    def hertz_factor(x: real) -> vec2:
        """T and d ln f / d ln P."""
        if is_tabled(x):
            tabled = table_factor(x)
            return vec2(tabled[0], -quarter - tabled[1])
        difference = wp.sqrt(wp.max(one - x, zero))
        # (S + D) / (S - D) without the difference of numbers that are nearly equal
        ratio = (one + difference) * (one + difference) / x
        slope = wp.exp(slender * wp.log(ratio)) - one
        correction = one
        steepness = -quarter
        if slope > zero:
            lacking = wp.exp(power * wp.log(slope))
            correction = one - lacking
            # d ln rho / d ln P = -S / D
            steepness -= steep * lacking * (one + slope) / (slope * correction * difference)
        cube = correction * correction * correction
        return vec2(wp.sqrt(wp.sqrt(x) / cube), steepness)

    return curvatures, hertz_factor
