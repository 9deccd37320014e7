"""Exponential of a 3x3 matrix on the device, in float64.

Source: series of b / 2^k, doubled k times by e^2b - 1 = (e^b - 1)(e^b + 1) and
    phi(2b) = (e^b + 1) phi(b) / 2. Kept without its leading 1, so that what a small step changes
    has no rounding of the size of 1.
Symbols: phi(b) = (e^b - 1)/b = integral of e^(b t) over t = 0 ... 1.
Limits: the largest row sum of e^b must be a number, about 700 for the row sums of b.
"""

from functools import cache

import warp as wp

SERIES_SIZE = 0.125  # largest row sum that the series takes
SERIES_TERMS = 12  # SERIES_SIZE^12 / 13! = 2e-21


@cache
def make_exponential():
    """`largest_row_sum(b)` and `exponential_change(b)` -> e^b - 1 and phi(b)."""

    @wp.func
    def largest_row_sum(b: wp.mat33d) -> wp.float64:
        largest = wp.float64(0.0)
        for i in range(3):
            row = wp.abs(b[i, 0]) + wp.abs(b[i, 1]) + wp.abs(b[i, 2])
            largest = wp.max(largest, row)
        return largest

    @wp.func
    def exponential_change(b: wp.mat33d):
        one = wp.identity(n=3, dtype=wp.float64)
        size = largest_row_sum(b)
        scale = wp.float64(1.0)
        doublings = wp.int32(0)
        while size * scale > wp.float64(wp.static(SERIES_SIZE)) and doublings < 64:
            scale = wp.float64(0.5) * scale
            doublings += 1
        small = scale * b
        phi = one
        for k in range(wp.static(SERIES_TERMS)):
            order = wp.float64(wp.static(SERIES_TERMS) + 1 - k)
            phi = one + (wp.float64(1.0) / order) * (small * phi)
        change = small * phi
        for _ in range(doublings):
            phi = phi + wp.float64(0.5) * (change * phi)
            change = wp.float64(2.0) * change + change * change
        return change, phi

    return largest_row_sum, exponential_change
