"""Normal contact of two sphero-cylinders: Hertz for elliptic contacts.

Source: F = 4/3 E* f delta^1.5, f = sqrt(R*) F_2^-1.5 with the correction F_2 = 1 - (rho^0.0684 -
    1)^1.531 (Johnson, Contact Mechanics); R* = 1 / sqrt(P) and rho = (S + D) / (S - D), D =
    sqrt(S^2 - 4 P), with S and P the sum and the product of the two principal relative curvatures:
    hemispheres, hemisphere on cylinder, cylinders at the angle alpha. What of a patch two segments
    share: `capsule_patch`.
Symbols: r radius, m = r_a r_b, E* = 1 / (e_a + e_b), e = (1 - nu^2) / E_c, delta overlap.
Limits: sin(alpha) is to be 0.02 at least, where the patch of parallel cylinders would be endless.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision

SMALLEST_SINE = 0.02
SLENDER, POWER = 0.0684, 1.531  # exponents of F_2


@cache
def make_capsule_contact(name):
    """`curvatures` and `hertz_factor`."""
    p = precision(name)
    real, vec2 = p.real, p.vec2
    zero, one, two, four, quarter = (real(x) for x in (0.0, 1.0, 2.0, 4.0, 0.25))
    slender, power, steep = real(SLENDER), real(POWER), real(1.5 * SLENDER * POWER)

    @wp.func
    def curvatures(ends: wp.int32, ra: real, rb: real, sine2: real) -> vec2:
        """(m S, m^2 P); ends: 0 cylinders, 1 the end of a on b, 2 the end of b on a, 3 two ends."""
        total = ra + rb
        if ends == 0:
            return vec2(total, ra * rb * sine2)
        if ends == 1:
            return vec2(rb + total, rb * total)
        if ends == 2:
            return vec2(ra + total, ra * total)
        return vec2(two * total, total * total)

    @wp.func
    def hertz_factor(sp: vec2) -> vec2:
        """f = sqrt(R*) F_2^-1.5 times sqrt(P / k_a k_b), and d ln f / d ln P.

        The root is the sine between two cylinders.
        """
        difference = wp.sqrt(wp.max(sp[0] * sp[0] - four * sp[1], zero))
        # (S + D) / (S - D) without the difference of numbers that are nearly equal
        ratio = (sp[0] + difference) * (sp[0] + difference) / (four * sp[1])
        slope = wp.exp(slender * wp.log(ratio)) - one
        correction = one
        steepness = -quarter
        if slope > zero:
            lacking = wp.exp(power * wp.log(slope))
            correction = one - lacking
            # d ln rho / d ln P = -S / D
            more = lacking * (one + slope) * sp[0] / (slope * correction * difference)
            steepness -= steep * more
        cube = correction * correction * correction
        return vec2(wp.sqrt(wp.sqrt(sp[1]) / cube), steepness)

    return curvatures, hertz_factor
