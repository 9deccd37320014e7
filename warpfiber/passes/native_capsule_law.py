"""C++ text of the normal contact of eight pairs of segments, one lane per pair.

The laws `capsule_contact` and `capsule_patch` as in `capsule_touch`, branches as masks. Powers are
exponentials of logarithms, both by series to rounding.
Symbols: as in `capsule_patch`; `tip0_`, `tip1_` lanes whose segment is the first or the last one of
    its fiber.
"""

import math

from warpfiber.laws.capsule_contact import POWER, SLENDER, SMALLEST_SINE
from warpfiber.laws.capsule_patch import BEYOND, BOTH_WAYS, PARALLEL, TURNING_SINE

# Terms of log((1 + f) / (1 - f)) up to f = 3 - sqrt(8), and of exp up to half a binary digit.
LOG_TERMS = {"float64": 11, "float32": 5}
EXP_TERMS = {"float64": 14, "float32": 8}


def contact_constants(name: str) -> str:
    """Numbers of the law."""
    numbers = {
        "SMALLEST_SINE": SMALLEST_SINE,
        "TURNING_SINE": TURNING_SINE,
        "BOTH_WAYS": BOTH_WAYS,
        "FURTHER": 0.5 * BEYOND,
        "NEAR": PARALLEL[name],
        "PARALLEL2": PARALLEL[name] ** 2,
        "SLENDER": SLENDER,
        "POWER": POWER,
        "STEEP": 1.5 * SLENDER * POWER,
        "OUTERMOST": math.sqrt(0.6),
        "TINY": 1e-30,
        "LN2": math.log(2.0),
        "ROOT2": math.sqrt(2.0),
    }
    lines = [f"constexpr T {key} = T({value!r});" for key, value in numbers.items()]
    logs = [2.0 / (2 * n + 1) for n in range(LOG_TERMS[name])]
    exps = [1.0 / math.factorial(n) for n in range(EXP_TERMS[name])]
    for key, values in (("LOG", logs), ("EXP", exps)):
        text = ", ".join(f"T({value!r})" for value in values)
        lines.append(f"constexpr int {key}_TERMS = {len(values)};")
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
    // x > 0, normal
    auto power = [](V x, T exponent) -> V {
        const M word = __builtin_bit_cast(M, x);
        M e = (word >> DIGITS) - BIAS;
        V m = __builtin_bit_cast(V, (word & ((M)1 << DIGITS) - 1) | ((M)BIAS << DIGITS));
        const M high = m > ROOT2;
        m = high ? m * T(0.5) : m;
        e = e - high;  // true is -1
        const V f = (m - T(1)) / (m + T(1)), f2 = f * f;
        V sum = V(LOG[LOG_TERMS - 1]);
        #pragma unroll
        for (int n = LOG_TERMS - 2; n >= 0; --n) sum = sum * f2 + LOG[n];
        const V digits = __builtin_convertvector(e, V);
        const V y = exponent * (sum * f + digits * LN2);
        constexpr T whole = T(1.5) * (T)(1ll << DIGITS);
        const V n = (y * (T(1) / LN2) + whole) - whole;
        const V r = (y - n * LN2_HIGH) - n * LN2_LOW;
        V value = V(EXP[EXP_TERMS - 1]);
        #pragma unroll
        for (int k = EXP_TERMS - 2; k >= 0; --k) value = value * r + EXP[k];
        const M twos = (__builtin_convertvector(n, M) + BIAS) << DIGITS;
        return value * __builtin_bit_cast(V, twos);
    };
    // sqrt(R*) F_2^-1.5 of the sum and the product of the curvatures, and its d ln / d ln product
    auto hertz_factor = [&](V sum, V product, V& steepness) -> V {
        const V difference = root(larger(sum * sum - T(4) * product, V(T(0))));
        const V ratio = (sum + difference) * (sum + difference) / (T(4) * product);
        const V slope = larger(power(ratio, SLENDER) - T(1), V(T(1e-15)));
        const V lacking = power(slope, POWER), correction = T(1) - lacking;
        const V steep = STEEP * lacking * (T(1) + slope) * sum / (slope * correction * difference);
        steepness = (difference > T(0) ? -steep : V(T(0))) - T(0.25);
        return T(1) / (root(root(product)) * correction * root(correction));
    };
"""

# Slices that both segments share (`capsule_patch.side_share`), and those of a tip (`tip_share`).
SHARES = """
    struct Share {
        V energy, stiffness, damped, s, t, depth;
        V3 by_delta, by_a, by_b;
    };
    auto scaled = [](const V3& v, M kept) -> V3 {
        return {kept ? v.x : V(T(0)), kept ? v.y : V(T(0)), kept ? v.z : V(T(0))};
    };
    auto kept_where = [&](M kept, Share& share) {
        share.energy = kept ? share.energy : V(T(0));
        share.stiffness = kept ? share.stiffness : V(T(0));
        share.damped = kept ? share.damped : V(T(0));
        share.s = kept ? share.s : V(T(0));
        share.t = kept ? share.t : V(T(0));
        share.depth = kept ? share.depth : V(T(0));
        share.by_delta = scaled(share.by_delta, kept);
        share.by_a = scaled(share.by_a, kept);
        share.by_b = scaled(share.by_b, kept);
    };
    auto replace = [&](M other, Share& share, const Share& by) {
        auto chosen = [&](const V3& v, const V3& w) -> V3 {
            return {other ? w.x : v.x, other ? w.y : v.y, other ? w.z : v.z};
        };
        share.energy = other ? by.energy : share.energy;
        share.stiffness = other ? by.stiffness : share.stiffness;
        share.damped = other ? by.damped : share.damped;
        share.s = other ? by.s : share.s;
        share.t = other ? by.t : share.t;
        share.depth = other ? by.depth : share.depth;
        share.by_delta = chosen(share.by_delta, by.by_delta);
        share.by_a = chosen(share.by_a, by.by_a);
        share.by_b = chosen(share.by_b, by.by_b);
    };
    struct Slices { V u1, u2, part, o2, o, ou, ouu; };
    // between low and high, of overlaps q - 2 slope x - vv x^2 at u_h + x
    auto slices = [&](V q, V slope, V vv, V u_h, V low, V high, V length)
        -> Slices {
        const V wide = root(larger(slope * slope + vv * q, V(T(0))));
        const V down = q / larger(wide - slope, V(TINY)), up = q / larger(wide + slope, V(TINY));
        Slices sums = {larger(low, u_h - down), smaller(high, u_h + up)};
        const V width = sums.u2 - sums.u1;
        sums.part = width / smaller(up + down, length);
        sums.o2 = sums.o = sums.ou = sums.ouu = V(T(0));
        #pragma unroll
        for (int k = -1; k <= 1; ++k) {
            const V u = T(0.5) * (sums.u1 + sums.u2) + (T(0.5 * k) * OUTERMOST) * width;
            const V x = u - u_h, o = q - (T(2) * slope + vv * x) * x;
            const V g = width * (k == 0 ? T(4.0 / 9.0) : T(5.0 / 18.0)) * o;
            sums.o2 = sums.o2 + g * o;
            sums.o = sums.o + g;
            sums.ou = sums.ou + g * u;
            sums.ouu = sums.ouu + g * u * u;
        }
        return sums;
    };
    // rigidity = E* f, steepness = d ln f / d ln P
    auto side_share = [&](const V3& delta, const V3& a, const V3& b, V la, V lb, V reach,
                          V rigidity, V steepness, V cross, V sine, V sigma, V weight,
                          V weight_slope) -> Share {
        const V3 along_a = a * (T(1) / la), along_b = b * (sigma / lb);
        const V cosine = smaller(along_a.dot(along_b), V(T(1)));
        const V twice = root(T(2) * (T(1) + cosine)), in_twice = T(1) / twice;
        const V3 middle = (along_a + along_b) * in_twice;
        const V in_bm = T(1) / b.dot(middle), t0 = delta.dot(middle) * -in_bm;
        const V ratio = sigma * la / lb, in_ratio = T(1) / ratio;
        const V3 d0 = delta + b * t0, dv = b * ratio - a;
        const V begin = -t0 * in_ratio, end = (T(1) - t0) * in_ratio;
        const V first = smaller(begin, end), last = larger(begin, end);
        const V low = larger(V(T(0)), first), high = smaller(V(T(1)), last);
        const V vv = dv.dot(dv), flat = PARALLEL2 * la * la;
        const V deepest = vv > flat ? -d0.dot(dv) / larger(vv, flat) : T(0.5) * (low + high);
        const V mean = T(0.5) * (T(1) + lb / la), beyond = (T(2) * FURTHER) * mean;
        const V ahead = smaller(V(T(0)), first) - beyond, behind = larger(V(T(1)), last) + beyond;
        const V u_h = smaller(larger(deepest, ahead), behind);
        const V3 nearest = d0 + dv * u_h;
        const V h = root(nearest.dot(nearest)), in_h = T(1) / h;
        const V q = (reach - h) * (reach + h), slope = nearest.dot(dv);
        const Slices sums = slices(q, slope, vv, u_h, low, high, mean);
        const M touches = (sums.u2 - sums.u1 > NEAR) & (h < reach) & (weight > T(0));
        const V in_wide = T(1) / (reach + h), in_root = root(in_wide);
        const V rigid = weight * rigidity * (T(2) * sine * in_twice) * la;
        const V scale = T(0.5) * rigid * in_wide * in_wide * in_root;
        Share share;
        share.energy = scale * sums.o2;
        share.stiffness = rigid * (sums.u2 - sums.u1) * in_root;
        share.damped = share.stiffness * sums.part;
        share.s = sums.ou / larger(sums.o, V(TINY));
        share.t = t0 + share.s * ratio;
        share.depth = reach - h;
        const V pull = T(-4) * scale;
        const V3 whole = (d0 * sums.o + dv * sums.ou) * pull;
        const V3 moment = (d0 * sums.ou + dv * sums.ouu) * pull;
        const V3 by_h = nearest * (T(-2.5) * share.energy * in_wide * in_h);
        share.by_delta = whole + by_h;
        share.by_a = (moment + by_h * u_h) * V(T(-1));
        share.by_b = whole * t0 + moment * ratio + by_h * (t0 + u_h * ratio);
        V by_t0 = share.by_delta.dot(b), by_ratio = -share.by_a.dot(b);
        auto squared = [&](V u) -> V {
            const V x = u - u_h, o = q - (T(2) * slope + vv * x) * x;
            return scale * o * o;
        };
        const V none = V(T(0)), held = by_h.dot(dv);
        // half where ends face each other and rounding would decide
        auto beyond_zero = [&](V x) -> V {
            return x > NEAR ? V(T(1)) : (x < -NEAR ? none : V(T(0.5)));
        };
        const V at_high = sums.u2 >= high ? beyond_zero(T(1) - last) * squared(sums.u2) : none;
        const V at_low = sums.u1 <= low ? beyond_zero(first) * squared(sums.u1) : none;
        // slices may be deepest far beyond both, where the mean length beyond them ends
        const M is_ahead = deepest < ahead, is_behind = deepest > behind;
        const V at_first = is_ahead ? beyond_zero(-first) * held : none;
        const V at_last = is_behind ? beyond_zero(last - T(1)) * held : none;
        const V stretched = is_ahead ? held : (is_behind ? -held : none);
        by_t0 = by_t0 - (at_high - at_low + at_first + at_last) * in_ratio;
        by_ratio = by_ratio + (FURTHER * sigma * in_ratio * stretched - at_high * sums.u2
            + at_low * sums.u1 - at_first * first - at_last * last) * in_ratio;
        V by_cosine = weight_slope / weight - T(0.5) / (T(1) + cosine);
        const V steep = (T(2) * steepness + T(1)) * cosine / (sine * sine);
        by_cosine = share.energy * (cross > TURNING_SINE ? by_cosine - steep : by_cosine);
        by_t0 = by_t0 * -in_bm;
        share.by_delta = share.by_delta + middle * by_t0;
        const V3 turned = d0 * (by_t0 * in_twice);
        share.by_a = share.by_a + along_a * (share.energy / la + by_ratio * sigma / lb)
            + ((along_b - along_a * cosine) * by_cosine + turned
               - along_a * turned.dot(along_a)) * (T(1) / la);
        share.by_b = share.by_b + middle * (by_t0 * t0) - b * (by_ratio * ratio / (lb * lb))
            + ((along_a - along_b * cosine) * by_cosine + turned
               - along_b * turned.dot(along_b)) * (sigma / lb);
        kept_where(touches, share);
        return share;
    };
    // of a tip; the segment begins at delta from it
    auto tip_share = [&](const V3& delta, const V3& b, V lb, V reach, V rigidity, M is_tip)
        -> Share {
        const V bb = lb * lb;
        const V t_h = clamp01(-delta.dot(b) / bb);
        const V3 nearest = delta + b * t_h;
        const V h = root(nearest.dot(nearest));
        const V q = (reach - h) * (reach + h);
        const Slices sums = slices(q, nearest.dot(b), bb, t_h, V(T(0)), V(T(1)), V(T(1)));
        const V in_wide = T(1) / (reach + h), in_root = root(in_wide);
        const V rigid = rigidity * lb, scale = T(0.5) * rigid * in_wide * in_wide * in_root;
        Share share;
        share.energy = scale * sums.o2;
        share.stiffness = rigid * (sums.u2 - sums.u1) * in_root;
        share.damped = share.stiffness * sums.part;
        share.s = V(T(0));
        share.t = sums.ou / larger(sums.o, V(TINY));
        share.depth = reach - h;
        const V3 by_h = nearest * (T(-2.5) * share.energy * in_wide / h);
        const V pull = T(-4) * scale;
        share.by_delta = (delta * sums.o + b * sums.ou) * pull + by_h;
        share.by_a = nothing3;
        share.by_b = (delta * sums.ou + b * sums.ouu) * pull + by_h * t_h + b * (share.energy / bb);
        kept_where(is_tip & (h < reach), share);
        return share;
    };
"""

# Sets `share` of the lanes, the part of its force along the normal, and what nodes feel besides.
# Without IS_SHARED for pairs that have a patch within both segments.
NORMAL = """
    const V reach = radius_i + radius_j;
    const V ki = T(1) / radius_i, kj = T(1) / radius_j;
    const V modulus = T(1) / (compliance_i + compliance_j);
    const V la = root(a.dot(a)), lb = root(b.dot(b)), both = T(1) / (la * lb);
    const V signed_cosine = a.dot(b) * both;
    const V cosine = signed_cosine < T(0) ? -signed_cosine : signed_cosine;
    const V3 normal = a.cross(b);
    const V cross = root(normal.dot(normal)) * both, sine = larger(cross, V(SMALLEST_SINE));
    V steepness;
    const V rigidity = modulus * hertz_factor(ki + kj, ki * kj * sine * sine, steepness);
    auto point_share = [&](V deep, V stiff) -> Share {
        const V3 gap = delta + b * t - a * s;
        Share at = {T(4.0 / 15.0) * stiff * deep * deep, stiff, stiff, s, t, deep};
        at.by_delta = gap * (T(-2.0 / 3.0) * stiff * deep / root(gap.dot(gap)));
        at.by_a = at.by_delta * -s;
        at.by_b = at.by_delta * t;
        return at;
    };
    const V3 closest_gap = delta + b * t - a * s;
    Share share;
    if constexpr (!IS_SHARED) {
        const V deep = larger(reach - root(closest_gap.dot(closest_gap)), V(T(0)));
        share = point_share(deep, T(2) * rigidity * root(deep));
        // a wider angle stores less: d ln P = -2 cos d cos / sin^2
        V twist = T(-2) * steepness * share.energy * signed_cosine / (sine * sine);
        twist = cross > TURNING_SINE ? twist : V(T(0));
        const V3 along_a = a * (T(1) / la), along_b = b * (T(1) / lb);
        share.by_a = share.by_a + (along_b - along_a * signed_cosine) * (twist / la);
        share.by_b = share.by_b + (along_a - along_b * signed_cosine) * (twist / lb);
    } else {
        const V sigma = signed_cosine < T(0) ? V(T(-1)) : V(T(1));
        const M two_ways = cosine < BOTH_WAYS;
        const V weight = two_ways ? T(0.5) + cosine : V(T(1));
        const V weight_slope = two_ways ? V(T(1)) : V(T(0));
        share = side_share(delta, a, b, la, lb, reach, rigidity, steepness, cross, sine, sigma,
                           weight, weight_slope);
        if (any(two_ways)) {
            const Share more = side_share(delta, a, b, la, lb, reach, rigidity, steepness, cross,
                                          sine, -sigma, T(1) - weight, weight_slope);
            const V energy = share.energy + more.energy;
            const V part = energy > T(0) ? more.energy / energy : V(T(0));
            share.s = share.s + (more.s - share.s) * part;
            share.t = share.t + (more.t - share.t) * part;
            share.energy = energy;
            share.stiffness = share.stiffness + more.stiffness;
            share.damped = share.damped + more.damped;
            share.depth = larger(share.depth, more.depth);
            share.by_delta = share.by_delta + more.by_delta;
            share.by_a = share.by_a + more.by_a;
            share.by_b = share.by_b + more.by_b;
        }
        const M is_tip_i = s < T(0.5) ? tip0_i : tip1_i, is_tip_j = t < T(0.5) ? tip0_j : tip1_j;
        if (any(is_tip_i | is_tip_j)) {
            s = s < T(0.5) ? V(T(0)) : V(T(1));
            t = t < T(0.5) ? V(T(0)) : V(T(1));
            const V total = ki + kj;
            V none;
            const V round_i = modulus * hertz_factor(ki + total, ki * total, none);
            Share tip = tip_share(delta - a * s, b, lb, reach, round_i, is_tip_i);
            tip.s = s;
            tip.by_a = tip.by_delta * -s;
            replace(tip.energy > share.energy, share, tip);
            const V round_j = modulus * hertz_factor(kj + total, kj * total, none);
            tip = tip_share(nothing3 - delta - b * t, a, la, reach, round_j, is_tip_j);
            tip.s = tip.t;
            tip.t = t;
            tip.by_a = tip.by_b;
            tip.by_b = tip.by_delta * -t;
            tip.by_delta = tip.by_delta * V(T(-1));
            replace(tip.energy > share.energy, share, tip);
            const V3 gap = delta + b * t - a * s;
            const V deep = larger(reach - root(gap.dot(gap)), V(T(0)));
            const V round = modulus * hertz_factor(T(2) * total, total * total, none);
            tip = point_share(deep, T(2) * round * root(deep));
            replace(is_tip_i & is_tip_j & (tip.energy > share.energy), share, tip);
        }
    }
    s = share.s;
    t = share.t;
    const V3 c = delta + b * t - a * s;
    const V distance = root(c.dot(c));
    const V3 n = c * (T(1) / distance);
    const V force = larger(-share.by_delta.dot(n), V(T(0)));
    const V stiffness = share.stiffness, damped = share.damped, depth = share.depth;
    // of the first nodes; the second ones feel the reverse
    const V3 couple_i = share.by_a + share.by_delta * s;
    const V3 couple_j = share.by_b - share.by_delta * t;
"""
