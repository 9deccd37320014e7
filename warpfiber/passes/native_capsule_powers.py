"""C++ text of powers and of the factor of Hertz in lanes.

Powers are exponentials of logarithms, both by series to rounding. Divisions and square roots take
as long as twenty multiplications: what is divided by is multiplied up and divided by once.
Source: law `capsule_contact`.
"""

import math
from collections.abc import Sequence
from fractions import Fraction

from warpfiber.laws.capsule_contact import POWER, SLENDER

# Terms of log((1 + f) / (1 - f)) up to f = 3 - sqrt(8), and of exp up to half a binary digit; by
# fours. Errors 1e-18 and 3e-18, in float32 7e-10 and 4e-11.
LOG_TERMS = {"float64": 8, "float32": 4}
EXP_TERMS = {"float64": 12, "float32": 8}


def economized(
    series: Sequence[Fraction], low: Fraction, high: Fraction, terms: int
) -> list[float]:
    """Coefficients of `terms` powers of x, of a longer series that holds for low <= x <= high.

    The highest power is replaced by the lower ones of its Chebyshev polynomial until they are left.
    """
    mid, half = (low + high) / 2, (high - low) / 2
    # Chebyshev polynomials of the interval by T_(n+1) = 2 (x - mid) / half T_n - T_(n-1)
    rows = [[Fraction(1)], [-mid / half, 1 / half]]
    while len(rows) < len(series):
        last, before = rows[-1], [*rows[-2], 0, 0]
        shifted, same = [0, *last], [*last, 0]
        rows.append(
            [2 * (s - mid * t) / half - b for s, t, b in zip(shifted, same, before, strict=True)]
        )
    left = list(series)
    while len(left) > terms:
        row = rows[len(left) - 1]
        share = left.pop() / row[-1]
        left = [value - share * by for value, by in zip(left, row, strict=False)]
    return [float(value) for value in left]


def power_constants(name: str) -> str:
    """Series of powers, numbers of the law."""
    numbers = {
        "SLENDER": SLENDER,
        "POWER": POWER,
        "STEEP": 1.5 * SLENDER * POWER,
        "LN2": math.log(2.0),
        "ROOT2": math.sqrt(2.0),
    }
    lines = [f"constexpr T {key} = T({value!r});" for key, value in numbers.items()]
    longer = 8  # terms more, for the series that are shortened
    largest, digit = (Fraction(x) for x in ((3.0 - math.sqrt(8.0)) ** 2, 0.5 * math.log(2.0)))
    logs = [Fraction(2, 2 * n + 1) for n in range(LOG_TERMS[name] + longer)]
    exps = [Fraction(1, math.factorial(n)) for n in range(EXP_TERMS[name] + longer)]
    logs = economized(logs, Fraction(0), largest, LOG_TERMS[name])
    exps = economized(exps, -digit, digit, EXP_TERMS[name])
    for key, values in (("LOG", logs), ("EXP", exps)):
        text = ", ".join(f"T({value!r})" for value in values)
        lines.append(f"constexpr T {key}[{len(values)}] = {{{text}}};")
    # ln 2 in two parts, the first with zeros in its last digits
    bits = {"float64": (52, 1023, 21), "float32": (23, 127, 10)}[name]
    high = math.floor(math.log(2.0) * 2.0 ** bits[2]) / 2.0 ** bits[2]
    low = math.log(2.0) - high
    if name == "float64":  # log(2) to more than 53 bits
        low = 0.6931471805599453 - high + 2.319046813846299e-17
    lines.append(f"constexpr T LN2_HIGH = T({high!r}), LN2_LOW = T({low!r});")
    lines.append(f"constexpr int DIGITS = {bits[0]}, BIAS = {bits[1]};")
    return "\n".join(lines)


POWERS = """
    auto root = [](V x) -> V { return __builtin_elementwise_sqrt(x); };
    auto larger = [](V x, V y) -> V { return x > y ? x : y; };
    auto smaller = [](V x, V y) -> V { return x < y ? x : y; };
    auto clamp01 = [](V x) -> V {
        x = x > T(0) ? x : V(T(0));
        return x < T(1) ? x : V(T(1));
    };
    // by fours, which do not wait for each other
    auto series = [](const auto& terms, V x) -> V {
        constexpr int count = sizeof(terms) / sizeof(T);
        static_assert(count % 4 == 0);
        const V x2 = x * x, x4 = x2 * x2;
        V sum = V(T(0));
        #pragma unroll
        for (int k = count - 4; k >= 0; k -= 4) {
            const V low = terms[k] + terms[k + 1] * x, high = terms[k + 2] + terms[k + 3] * x;
            sum = k == count - 4 ? low + high * x2 : sum * x4 + (low + high * x2);
        }
        return sum;
    };
    // (x / by)^exponent of normal numbers > 0
    auto power = [&](V x, V by, T exponent) -> V {
        const M word = __builtin_bit_cast(M, x), word_by = __builtin_bit_cast(M, by);
        const M fraction = ((M)1 << DIGITS) - 1, one = (M)BIAS << DIGITS;
        const V m = __builtin_bit_cast(V, (word & fraction) | one);
        const V m_by = __builtin_bit_cast(V, (word_by & fraction) | one);
        const M high = m > m_by * ROOT2, low = m_by > m * ROOT2;
        // true is -1
        const M e = (word >> DIGITS) - (word_by >> DIGITS) - high + low;
        const V n = high ? m * T(0.5) : m, n_by = low ? m_by * T(0.5) : m_by;
        const V f = (n - n_by) / (n + n_by), f2 = f * f;
        const V y = exponent * (series(LOG, f2) * f + __builtin_convertvector(e, V) * LN2);
        constexpr T whole = T(1.5) * (T)(1ll << DIGITS);
        const V twos = (y * (T(1) / LN2) + whole) - whole;
        const V r = (y - twos * LN2_HIGH) - twos * LN2_LOW;
        const V value = series(EXP, r);
        const M scale = (__builtin_convertvector(twos, M) + BIAS) << DIGITS;
        return value * __builtin_bit_cast(V, scale);
    };
    // sqrt(R*) F_2^-1.5 of the sum and the root of the product of the curvatures, and its
    // d ln / d ln product
    auto hertz_factor = [&](V sum, V root_product, V& steepness) -> V {
        const V twice = T(2) * root_product;
        const V difference = root(larger((sum - twice) * (sum + twice), V(T(0))));
        const V apart = larger(difference, V(T(1e-15)));
        const V slope = larger(power(sum + difference, twice, 2 * SLENDER) - T(1), V(T(1e-15)));
        const V lacking = power(slope, V(T(1)), POWER), correction = T(1) - lacking;
        const V rooted = root(root_product * correction);
        const V back = T(1) / (slope * apart * correction * rooted);
        const V steep = STEEP * lacking * (T(1) + slope) * sum * rooted * back;
        steepness = (difference > T(0) ? -steep : V(T(0))) - T(0.25);
        return slope * apart * back;
    };
"""
