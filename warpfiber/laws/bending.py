"""Bending of the joint between two segments.

Source: Sasayama & Inagaki 2018, F^b of Eq. (1): minus the gradient of k_b theta^2 / 2, with theta
    the joint angle and k_b = E I / l = pi a^3 E / (8 M). theta / sin(theta) is a power series in
    y = 1 - cos(theta), see `bending_series`.
Symbols: n0, n1 unit vectors of the two segments, d0, d1 their lengths.
Limits: straight rest shape. At theta = pi the direction of unbending is undefined; the factor
    theta / sin(theta) is held at its value for sin(theta) = 1e-6 there.
"""

from fractions import Fraction
from functools import cache

import warp as wp

from warpfiber.model import precision

# Up to this y (theta < 0.64) the series below takes the place of atan2. Its error there: 1e-17.
SERIES_END = 0.2
SERIES_TERMS = 12
SMALLEST_SINE = 1.0e-6


@cache
def bending_series(largest: float, terms: int) -> tuple[float, ...]:
    """Coefficients of theta / sin(theta) in y = 1 - cos(theta), 0 <= y <= largest <= 1.

    theta / sin(theta) = sum_n n! / (2n+1)!! y^n, economized: the highest power is replaced by the
    lower ones of its Chebyshev polynomial until `terms` are left. Error about
    (x + sqrt(x^2 - 1))^-terms with x = 4 / largest - 1, as the nearest singularity is at y = 2.
    """
    series = [Fraction(1)]
    for n in range(1, 3 * terms):
        series.append(series[-1] * Fraction(n, 2 * n + 1))
    scale = Fraction(largest).limit_denominator(1000)
    series = [value * scale**n for n, value in enumerate(series)]
    # Chebyshev polynomials of [0, 1] by T_(n+1) = (4 y - 2) T_n - T_(n-1)
    rows = [[1], [-1, 2]]
    while len(rows) < len(series):
        last, before = rows[-1], rows[-2] + [0, 0]
        shifted, same = [0, *last], [*last, 0]
        rows.append([4 * s - 2 * t - b for s, t, b in zip(shifted, same, before, strict=True)])
    while len(series) > terms:
        row = rows[len(series) - 1]
        share = series.pop() / row[-1]
        series = [value - share * row[n] for n, value in enumerate(series)]
    return tuple(float(value / scale**n) for n, value in enumerate(series))


@cache
def make_bending(name):
    """`bending_angle(n0, n1)` = theta and `bending_forces` in the given precision."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    one = real(1.0)
    series_end = real(SERIES_END)
    smallest_sine = real(SMALLEST_SINE)
    c = [real(value) for value in bending_series(SERIES_END, SERIES_TERMS)]

    @wp.func
    def bending_angle(n0: vec3, n1: vec3) -> real:
        return wp.atan2(wp.length(wp.cross(n0, n1)), wp.dot(n0, n1))

    @wp.func
    def bending_factor(n0: vec3, n1: vec3, cosine: real) -> real:
        """theta / sin(theta)."""
        y = one - cosine
        if y < series_end:
            # even and odd powers apart: two short chains of operations instead of a long one
            z = y * y
            even = wp.static(c[8]) + z * wp.static(c[10])
            odd = wp.static(c[9]) + z * wp.static(c[11])
            even = wp.static(c[4]) + z * (wp.static(c[6]) + z * even)
            odd = wp.static(c[5]) + z * (wp.static(c[7]) + z * odd)
            even = wp.static(c[0]) + z * (wp.static(c[2]) + z * even)
            odd = wp.static(c[1]) + z * (wp.static(c[3]) + z * odd)
            return even + y * odd
        sine = wp.length(wp.cross(n0, n1))
        return wp.atan2(sine, cosine) / wp.max(sine, smallest_sine)

    @wp.func
    def bending_forces(stiffness: real, n0: vec3, inverse0: real, n1: vec3, inverse1: real):
        """Forces on the nodes before and after the joint; the joint takes minus their sum.

        inverse0, inverse1: 1 / d0, 1 / d1.
        """
        cosine = wp.dot(n0, n1)
        moment = stiffness * bending_factor(n0, n1, cosine)
        after = (moment * inverse1) * (n0 - cosine * n1)
        before = (moment * inverse0) * (cosine * n0 - n1)
        return before, after

    return bending_angle, bending_forces
