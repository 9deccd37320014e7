"""C++ text of the normal contact of eight pairs of segments, one lane per pair.

The law of `capsule_contact` among the other segments of the two fibers (`capsule_touch`), branches
as masks. Powers are exponentials of logarithms, both by series to rounding.
Symbols: as in `capsule_contact`; a, b edges of the two segments, delta from start to start, `back_`
    and `ahead_` the edges before and after them, `tip0_`, `tip1_` lanes whose segment is the first
    or the last one of its fiber.
"""

import math

from warpfiber.laws.capsule_contact import (
    ALIGNED,
    LINE_COSINE,
    LINE_PART,
    POWER,
    SLENDER,
    SMALLEST_SINE,
)
from warpfiber.passes.capsule_touch import LEAST_PART
from warpfiber.passes.pairs import END_TOLERANCE

# Terms of log((1 + f) / (1 - f)) up to f = 3 - sqrt(8), and of exp up to half a binary digit.
LOG_TERMS = {"float64": 11, "float32": 5}
EXP_TERMS = {"float64": 14, "float32": 8}


def contact_constants(name: str) -> str:
    """Numbers of the law."""
    numbers = {
        "LINE_COSINE": LINE_COSINE,
        "LINE_PART": LINE_PART,
        "SMALLEST_SINE": SMALLEST_SINE,
        "ALIGNED": ALIGNED,
        "SLENDER": SLENDER,
        "POWER": POWER,
        "STEEP": 1.5 * SLENDER * POWER,
        "NEAR": END_TOLERANCE[name],
        "LEAST_PART": LEAST_PART,
        "ROUNDED": 2.0 * (1.0 + 1e-5),
        "TINY": 1e-30,
        "FAR": 1e30,
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

# Sets force, stiffness, s, t and depth of the lanes; no force where another pair has the contact;
# loads of nodes on top of that force where lanes are `saddled`.
# Without HAS_LINE for pairs none of which can be a line.
NORMAL = """
    const V reach = radius_i + radius_j;
    const V ki = T(1) / radius_i, kj = T(1) / radius_j;
    const V modulus = T(1) / (compliance_i + compliance_j);
    const V3 c0 = delta + b * t - a * s;
    const V square0 = c0.dot(c0);
    const M hit = square0 < reach * reach;
    const V aa = a.dot(a), bb = b.dot(b), ab = a.dot(b);
    const V la = root(aa), lb = root(bb), both = T(1) / (la * lb);
    const V cosine = (ab < T(0) ? -ab : ab) * both;
    const V3 normal = a.cross(b);
    const V sine = larger(root(normal.dot(normal)) * both, V(SMALLEST_SINE));
    V factor = V(T(1));
    V force = V(T(0)), stiffness = V(T(0)), depth = V(T(0)), line_s = s, line_t = t;
    M is_line = V(T(1)) < T(0);
    if constexpr (HAS_LINE) is_line = hit & (cosine > LINE_COSINE);
    if (HAS_LINE && any(is_line)) {
        V steepness;
        factor = hertz_factor(ki + kj, ki * kj * sine * sine, steepness);
        const V3 along = b * (ab < T(0) ? V(T(-1)) : V(T(1)));
        V3 middle = a * (T(1) / la) + along * (T(1) / lb);
        middle = middle * (T(1) / root(middle.dot(middle)));
        const V wa = a.dot(middle), wb = b.dot(middle), start = delta.dot(middle);
        const V inverse_a = T(1) / wa, inverse_b = T(1) / wb;
        const V low = larger(V(T(0)), smaller(start, start + wb)) * inverse_a;
        const V high = smaller(wa, larger(start, start + wb)) * inverse_a;
        const V t0 = -start * inverse_b, t1 = (wa - start) * inverse_b;
        const V3 d0 = delta + b * t0, dv = delta + b * t1 - a - d0;
        const V vv = dv.dot(dv), dd = d0.dot(dv), square = d0.dot(d0);
        const V held = larger(vv, V(TINY));
        const V closest = root(larger(square - dd * dd / held, V(T(0))));
        const V deepest = reach - closest;
        // overlap q - p u - e u^2, and its roots without the difference of large numbers
        const V scale = T(1) / (reach + closest);
        const V q = scale * (reach * reach - square), p = scale * T(2) * dd, e = scale * vv;
        V wide = root(larger(p * p + T(4) * e * q, V(T(0))));
        wide = p < T(0) ? -wide : wide;
        const V u = T(-0.5) * (p + wide);
        const V size = u < T(0) ? -u : u;
        const V first = size > TINY ? -q / u : V(-FAR);
        V second = u < T(0) ? V(-FAR) : V(FAR);
        second = size < T(1e20) * e ? u / e : second;
        const V u0 = larger(low, smaller(first, second)), u1 = smaller(high, larger(first, second));
        const V w1 = u1 - u0, s0 = u0 * u0, s1 = u1 * u1;
        const V w2 = T(0.5) * (s1 - s0), w3 = (s1 * u1 - s0 * u0) * T(1.0 / 3.0);
        const V w4 = T(0.25) * (s1 * s1 - s0 * s0);
        V integral = larger(q * w1 - p * w2 - e * w3, V(T(0)));
        integral = ((deepest > T(0)) & (u1 > u0)) ? integral : V(T(0));
        V center = (q * w2 - p * w3 - e * w4) / larger(integral, V(TINY));
        center = center > u0 ? center : u0;
        center = center < u1 ? center : u1;
        const V patch = LINE_PART * smaller(la, lb) * sine;
        is_line &= T(2) * reach * deepest >= patch * patch;
        const M acts = is_line & (integral > T(0));
        const V length = la * root(T(0.5) * (T(1) + cosine));
        const V k = modulus * factor * sine * length / root(T(2) * reach);
        const V per_part = T(1) / (t1 - t0), beyond = T(0.5) * (T(1) + lb / la);
        const V ahead = -t0 * per_part, behind = (T(1) - t0) * per_part;
        const V lowest = smaller(V(T(0)), smaller(ahead, behind)) - beyond;
        const V highest = larger(V(T(1)), larger(ahead, behind)) + beyond;
        const V way = smaller(larger(-dd / held, lowest), highest);
        const V3 there = d0 + dv * way;
        force = acts ? k * integral : force;
        stiffness = acts ? k * w1 : stiffness;
        line_s = acts ? center : line_s;
        line_t = acts ? clamp01(t0 + center * (t1 - t0)) : line_t;
        depth = acts ? reach - root(there.dot(there)) : depth;
    }

    const M low_i = s <= NEAR, high_i = s >= T(1) - NEAR;
    const M low_j = t <= NEAR, high_j = t >= T(1) - NEAR;
    const M end_i = (low_i & tip0_i) | (high_i & tip1_i);
    const M end_j = (low_j & tip0_j) | (high_j & tip1_j);
    M reject = (high_i & ~tip1_i) | (high_j & ~tip1_j) | (is_line & ~(end_i | end_j)) | ~hit;
    reject |= low_i & ~tip0_i & (c0.dot(back_i) < -NEAR * back_i.dot(back_i));
    reject |= low_j & ~tip0_j & (c0.dot(back_j) > NEAR * back_j.dot(back_j));
    // saddles and maxima of the distance between lanes' segments, beside a minimum or without one
    const V deep = larger(reach - root(square0), V(T(0))), deep_root = root(deep);
    const V all = deep * deep_root, patch = root(T(2) * reach * deep) / sine;
    V less = V(T(0)), less_root = V(T(0)), stored = V(T(0));
    V3 beside_i0 = nothing3, beside_i1 = nothing3, beside_j0 = nothing3, beside_j1 = nothing3;
    const V far_i = s * la, far_j = t * lb;
    const M bends = hit & ~is_line;
    const M at0_i = bends & ~tip0_i & (far_i < patch);
    const M at1_i = bends & ~tip1_i & (la - far_i < patch);
    const M at0_j = bends & ~tip0_j & (far_j < patch);
    const M at1_j = bends & ~tip1_j & (lb - far_j < patch);
    // one lane at a time: they are few
    struct One {
        T x, y, z;
        One operator+(const One& b) const { return {x + b.x, y + b.y, z + b.z}; }
        One operator-(const One& b) const { return {x - b.x, y - b.y, z - b.z}; }
        One operator-() const { return {-x, -y, -z}; }
        One operator*(T s) const { return {x * s, y * s, z * s}; }
        T dot(const One& b) const { return x * b.x + y * b.y + z * b.z; }
        bool nears(const One& edge) const { return dot(edge) > NEAR * edge.dot(edge); }
    };
    auto one_of = [](const V& v, int l) -> T { return ((const T*)&v)[l]; };
    auto at_lane = [](const V3& v, int l) -> One {
        return {((const T*)&v.x)[l], ((const T*)&v.y)[l], ((const T*)&v.z)[l]};
    };
    auto add_lane = [](V& v, int l, T more) { ((T*)&v)[l] += more; };
    auto add3 = [](V3& v, int l, const One& more) {
        ((T*)&v.x)[l] += more.x;
        ((T*)&v.y)[l] += more.y;
        ((T*)&v.z)[l] += more.z;
    };
    auto count_depth = [&](int l, T sign, T below, T root_there) {
        const T pull = below * root_there;
        add_lane(less_root, l, sign * root_there);
        add_lane(less, l, sign * pull);
        add_lane(stored, l, -sign * below * pull);
        return pull;
    };
    auto saddle = [&](int l, const One& vertex, const One& inward, const One& onward,
                      const One& from, const One& other, const One& behind, bool tip0, bool tip1,
                      V3& on_vertex, V3& on_start, V3& on_end) {
        T part = (vertex - from).dot(other) / other.dot(other);
        part = part > T(0) ? part : T(0);
        part = part < T(1) ? part : T(1);
        const One away = from + other * part - vertex;
        const T square = away.dot(away), span = one_of(reach, l);
        if (square >= span * span || !away.nears(inward) || !away.nears(onward)) return;
        if (part >= T(1) - NEAR && !tip1) return;
        if (part <= NEAR && !tip0 && (-away).nears(behind)) return;
        const T far = __builtin_elementwise_sqrt(square), below = span > far ? span - far : T(0);
        const T pull = count_depth(l, T(1), below, T(0.5) * __builtin_elementwise_sqrt(below));
        const One on = away * (pull / far);
        add3(on_vertex, l, on);
        add3(on_start, l, on * (part - T(1)));
        add3(on_end, l, on * -part);
    };
    auto summit = [&](int l, const One& gap, const One& inward_i, const One& onward_i,
                      const One& inward_j, const One& onward_j, V3& on_i, V3& on_j) {
        const T square = gap.dot(gap), span = one_of(reach, l);
        const One back = -gap;
        if (square >= span * span || !gap.nears(inward_i) || !gap.nears(onward_i)) return;
        if (!back.nears(inward_j) || !back.nears(onward_j)) return;
        const T far = __builtin_elementwise_sqrt(square), below = span > far ? span - far : T(0);
        const T push = count_depth(l, T(-1), below, T(0.25) * __builtin_elementwise_sqrt(below));
        const One on = gap * (push / far);
        add3(on_i, l, -on);
        add3(on_j, l, on);
    };
    if (any(at0_i | at1_i | at0_j | at1_j)) {
        const V3 onto_i = nothing3 - back_i, onto_j = nothing3 - back_j;
        // where the distance falls beyond a node: most nodes are out here, without their distances
        const V da = delta.dot(a), db = delta.dot(b), both2 = both * both;
        const V in_aa = bb * both2, in_bb = aa * both2;
        const V b_onto = b.dot(onto_i), b_ahead = b.dot(ahead_i);
        const V a_onto = a.dot(onto_j), a_ahead = a.dot(ahead_j);
        const V i00 = delta.dot(onto_i), i01 = i00 + b_onto;
        const V i10 = (delta - a).dot(ahead_i), i11 = i10 + b_ahead;
        const V j00 = delta.dot(onto_j), j10 = j00 - a_onto;
        const V j01 = (delta + b).dot(ahead_j), j11 = j01 - a_ahead;
        const M down0_i = i00 + clamp01(-db * in_bb) * b_onto > T(0);
        const M down1_i = i10 + clamp01((ab - db) * in_bb) * b_ahead > T(0);
        const M down0_j = j00 - clamp01(da * in_aa) * a_onto < T(0);
        const M down1_j = j01 - clamp01((da + ab) * in_aa) * a_ahead < T(0);
        const M down00 = (da > T(0)) & (db < T(0)) & (i00 > T(0)) & (j00 < T(0));
        const M down01 = (da > -ab) & (db > -bb) & (i01 > T(0)) & (j01 < T(0));
        const M down10 = (da < aa) & (db < ab) & (i10 > T(0)) & (j10 < T(0));
        const M down11 = (da < aa - ab) & (db > ab - bb) & (i11 > T(0)) & (j11 < T(0));
        const unsigned saddle0_i = bits(at0_i & ~low_i & down0_i);
        const unsigned saddle1_i = bits(at1_i & ~high_i & down1_i);
        const unsigned saddle0_j = bits(at0_j & ~low_j & down0_j);
        const unsigned saddle1_j = bits(at1_j & ~high_j & down1_j);
        const unsigned summit00 = bits(at0_i & at0_j & down00);
        const unsigned summit01 = bits(at0_i & at1_j & down01);
        const unsigned summit10 = bits(at1_i & at0_j & down10);
        const unsigned summit11 = bits(at1_i & at1_j & down11);
        const unsigned summits = summit00 | summit01 | summit10 | summit11;
        unsigned left = (saddle0_i | saddle1_i | saddle0_j | saddle1_j | summits)
            & ((1u << count) - 1u);
        for (; left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            const One start = {T(0), T(0), T(0)}, from = at_lane(delta, l);
            const One u = at_lane(a, l), w = at_lane(b, l), end = from + w;
            const One before_i = at_lane(onto_i, l), after_i = at_lane(ahead_i, l);
            const One before_j = at_lane(onto_j, l), after_j = at_lane(ahead_j, l);
            const int tips_i = ((const int*)&code_i)[l], tips_j = ((const int*)&code_j)[l];
            const bool first_i = tips_i & 1, last_i = tips_i & 2;
            const bool first_j = tips_j & 1, last_j = tips_j & 2;
            if (saddle0_i >> l & 1)
                saddle(l, start, u, before_i, from, w, before_j, first_j, last_j,
                       beside_i0, beside_j0, beside_j1);
            if (saddle1_i >> l & 1)
                saddle(l, u, -u, after_i, from, w, before_j, first_j, last_j,
                       beside_i1, beside_j0, beside_j1);
            if (saddle0_j >> l & 1)
                saddle(l, from, w, before_j, start, u, before_i, first_i, last_i,
                       beside_j0, beside_i0, beside_i1);
            if (saddle1_j >> l & 1)
                saddle(l, end, -w, after_j, start, u, before_i, first_i, last_i,
                       beside_j1, beside_i0, beside_i1);
            if (!(summits >> l & 1)) continue;
            if (summit00 >> l & 1)
                summit(l, from, u, before_i, w, before_j, beside_i0, beside_j0);
            if (summit01 >> l & 1)
                summit(l, end, u, before_i, -w, after_j, beside_i0, beside_j1);
            if (summit10 >> l & 1)
                summit(l, from - u, -u, after_i, w, before_j, beside_i1, beside_j0);
            if (summit11 >> l & 1)
                summit(l, end - u, -u, after_i, -w, after_j, beside_i1, beside_j1);
        }
    }
    M saddled = less != T(0);  // less than nothing where a maximum is deeper than the saddles
    if (any(~reject | saddled)) {
        const V total = ki + kj;
        V sum = end_i ? ki + total : total, product = end_i ? ki * total : ki * kj * sine * sine;
        sum = end_j ? kj + total : sum;
        product = end_j ? kj * total : product;
        sum = (end_i & end_j) ? T(2) * total : sum;
        product = (end_i & end_j) ? total * total : product;
        V steepness;
        factor = hertz_factor(sum, product, steepness);
        const V k = T(2) * modulus * factor, scale = T(2.0 / 3.0) * k;
        const M point = ~reject & ~(force >= scale * all);
        saddled = (saddled & (point | reject)) | point;
        const V net = larger(all - less, LEAST_PART * all);
        // of the whole minimum, this is not in the force at s and t
        const V3 rest = c0 * (point ? (all - net) / root(square0) : V(T(0)));
        beside_i0 = (beside_i0 - rest * (T(1) - s)) * scale;
        beside_i1 = (beside_i1 - rest * s) * scale;
        beside_j0 = (beside_j0 + rest * (T(1) - t)) * scale;
        beside_j1 = (beside_j1 + rest * t) * scale;
        // a wider angle stores less: d ln P = -2 cos d cos / sin^2
        stored += point ? deep * all : V(T(0));
        const V cosine1 = ab * both;
        V twist = T(0.8) * scale * stored * steepness * cosine1 / (sine * sine);
        twist = (end_i | end_j | (sine <= SMALLEST_SINE)) ? V(T(0)) : twist;
        const V3 along_a = a * (T(1) / la), along_b = b * (T(1) / lb);
        const V3 on_i = (along_b - along_a * cosine1) * (twist / la);
        const V3 on_j = (along_a - along_b * cosine1) * (twist / lb);
        beside_i0 = beside_i0 - on_i;
        beside_i1 = beside_i1 + on_i;
        beside_j0 = beside_j0 - on_j;
        beside_j1 = beside_j1 + on_j;
        force = point ? scale * net : force;
        stiffness = point ? k * larger(deep_root - less_root, LEAST_PART * deep_root) : stiffness;
        depth = point ? deep : depth;
        line_s = point ? s : line_s;
        line_t = point ? t : line_t;
    }
    auto of_saddled = [&](V3& load) {
        load = V3{saddled ? load.x : V(T(0)), saddled ? load.y : V(T(0)),
                  saddled ? load.z : V(T(0))};
    };
    of_saddled(beside_i0);
    of_saddled(beside_i1);
    of_saddled(beside_j0);
    of_saddled(beside_j1);
    s = line_s;
    t = line_t;
"""
