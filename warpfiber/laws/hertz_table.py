"""Factor of Hertz for elliptic contacts from a table: two polynomials instead of four powers.

Between two contacts that differ in the angle alone everything depends on x = 4 P / S^2 = 1 - y,
with rho = (1 + sqrt(y))^2 / x:
    f = sqrt(S / 2) T(x),  T = x^(1/4) F_2^-1.5,  d ln f / d ln P = -1/4 - steep(x),
F_2 as in `capsule_contact`. T is singular at x = 0 and y = 0, so the smaller one of x and y is cut
where its digits change: each octave into 2^BITS pieces. In these the nearest singularity is at 33
half widths, and a polynomial by Chebyshev's points with n terms is exact to 66^-n or so.
Source: `capsule_contact`; error of Chebyshev's interpolation (Trefethen, Approximation Theory and
    Approximation Practice, Theorem 8.2).
Symbols: S, P sum and product of the relative curvatures.
Limits: x >= 2^-12 and y >= 2^-20, that is between 1.2 and 89.9 degrees for equal radii.
"""

import math
from functools import cache

import warp as wp

from warpfiber.model import precision

SLENDER, POWER = 0.0684, 1.531  # exponents of F_2
STEEP = 1.5 * SLENDER * POWER
BITS = 4  # pieces of an octave, as a power of two
OCTAVES = (12, 16)  # of x, of y, below 1
LEAST = 3.9e-4  # x between equal radii at the smallest sine; below 1.6e-4 F_2 has no root
TERMS = {"float64": 8, "float32": 4}

# Digits of a number, which C++ for CUDA takes out of it in another way.
TEXT = """
    typedef TYPE real;
    typedef WORD word;
    static const real table[] = {VALUES};
    const real y = (real)1 - x;
    const real z = x < y ? x : y;
    union { real value; word digits; } smaller, whole, middle;
    smaller.value = z;
    const word one = (word)BIAS << DIGITS, last = ((word)1 << (DIGITS - BITS)) - 1;
    whole.digits = (smaller.digits & (((word)1 << DIGITS) - 1)) | one;
    middle.digits = (whole.digits & ~last) | ((last >> 1) + 1);
    const real w = whole.value - middle.value;
    const int piece = (int)(smaller.digits >> (DIGITS - BITS)) - (x < y ? FIRST_X : FIRST_Y);
    const real* c = table + 2 * TERMS * piece;
    real factor = c[2 * TERMS - 2], steep = c[2 * TERMS - 1];
    for (int k = 2 * TERMS - 4; k >= 0; k -= 2) {
        factor = factor * w + c[k];
        steep = steep * w + c[k + 1];
    }
    return wp::vec_t<2, real>(factor, steep);
"""


def exact_factor(x: float, y: float) -> tuple[float, float]:
    """(T, steep) for 0 < x = 1 - y < 1."""
    side = math.sqrt(y)
    power = SLENDER * math.log((1.0 + side) ** 2 / x) if x < y else 2.0 * SLENDER * math.atanh(side)
    slope = math.expm1(power)
    lacking = slope**POWER
    correction = 1.0 - lacking
    steep = STEEP * lacking * (1.0 + slope) / (slope * correction * side)
    return x**0.25 * correction**-1.5, steep


def fitted(values: list[float]) -> list[float]:
    """Coefficients in powers of -1 <= t <= 1 of the polynomial through Chebyshev's points."""
    n = len(values)
    angles = [math.pi * (m + 0.5) / n for m in range(n)]
    powers = [0.0] * n
    before, row = [0.0] * n, [1.0] + [0.0] * (n - 1)  # T_(k-1), T_k
    for k in range(n):
        share = sum(v * math.cos(k * angle) for v, angle in zip(values, angles, strict=True))
        share *= (2.0 if k else 1.0) / n
        powers = [p + share * r for p, r in zip(powers, row, strict=True)]
        raised = [0.0, *row[:-1]]
        following = [(2.0 if k else 1.0) * a - b for a, b in zip(raised, before, strict=True)]
        before, row = row, following
    return powers


@cache
def factor_table(terms: int) -> list[float]:
    """T_0, steep_0, T_1, ... of all pieces: of x, from the lowest one up to 1/2, then of y."""
    pieces, table = 1 << BITS, []
    half = 0.5 / pieces
    points = [math.cos(math.pi * (m + 0.5) / terms) for m in range(terms)]
    for of_y, octaves in enumerate(OCTAVES):
        for octave in range(octaves, 0, -1):
            for piece in range(pieces):
                middle = 1.0 + (piece + 0.5) / pieces
                # beyond 1/2 lies 1/2 alone
                at = [2.0**-octave * (middle + half * t) for t in points]
                rows = [exact_factor(1.0 - z, z) if of_y else exact_factor(z, 1.0 - z) for z in at]
                both = [fitted([row[n] for row in rows]) for n in range(2)]
                for k in range(terms):
                    table += [both[n][k] / half**k for n in range(2)]
    return table


@cache
def make_hertz_table(name):
    """`is_tabled(x)` and `table_factor(x)` -> (T, steep)."""
    real = precision(name).real
    vec2 = precision(name).vec2
    low, high = real(LEAST), real(1.0 - 2.0 ** -OCTAVES[1])
    digits, bias = {"float64": (52, 1023), "float32": (23, 127)}[name]
    terms = TERMS[name]
    first_x = (bias - OCTAVES[0]) << BITS
    first_y = (bias - OCTAVES[1] - OCTAVES[0]) << BITS
    names = {
        "VALUES": ", ".join(repr(value) for value in factor_table(terms)),
        "TYPE": {"float64": "double", "float32": "float"}[name],
        "WORD": {"float64": "long long", "float32": "int"}[name],
        "DIGITS": digits,
        "BITS": BITS,
        "BIAS": bias,
        "FIRST_X": first_x,
        "FIRST_Y": first_y,
        "TERMS": terms,
    }
    text = TEXT
    for key, value in names.items():
        text = text.replace(key, str(value))

    @wp.func
    def is_tabled(x: real) -> wp.bool:
        return x >= low and x <= high

    @wp.func_native(text)
    def table_factor(x: real) -> vec2: ...

    return is_tabled, table_factor
