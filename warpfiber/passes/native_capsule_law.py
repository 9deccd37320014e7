"""C++ text of the normal contact of pairs of segments, one lane per pair.

The laws `capsule_contact` and `capsule_patch` as in `capsule_touch`, branches as masks or, where
they are rare, as kinds of pairs of their own (`native_capsule_hits`). Divisions that share a factor
are one: most of the time would go into them.
Symbols: as in `capsule_patch`; `tip0_`, `tip1_` lanes whose segment is the first or the last one of
    its fiber.
"""

from warpfiber.laws.capsule_contact import SMALLEST_SINE
from warpfiber.laws.capsule_patch import BEYOND, BOTH_WAYS, PARALLEL, TURNING_SINE
from warpfiber.passes.native_capsule_powers import power_constants


def contact_constants(name: str) -> str:
    """Numbers of the law."""
    numbers = {
        "SMALLEST_SINE": SMALLEST_SINE,
        "TURNING_SINE": TURNING_SINE,
        "BOTH_WAYS": BOTH_WAYS,
        "FURTHER": 0.5 * BEYOND,
        "NEAR": PARALLEL[name],
        "PARALLEL2": PARALLEL[name] ** 2,
        "TINY": 1e-30,
        "SMALL": {"float64": 1e-30, "float32": 1e-12}[name],  # its square is a number
    }
    lines = [f"constexpr T {key} = T({value!r});" for key, value in numbers.items()]
    return "\n".join([*lines, power_constants(name)])


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
    struct Slices { V u1, u2, width, part, at, o2, o, ou, ouu; };
    // between low and high, of overlaps q - 2 slope x - vv x^2 at u_h + x; `at` their mean place
    auto slices = [&](V q, V slope, V vv, V u_h, V low, V high, V length) -> Slices {
        const V wide = root(larger(slope * slope + vv * q, V(T(0))));
        const V sum = larger(wide + (slope < T(0) ? -slope : slope), V(SMALL));
        const V bent = larger(vv, V(SMALL)), in_sum = T(1) / (sum * bent);
        // overlaps end nearer to u_h on the side to which they fall there
        const V there = q * bent * in_sum, back = larger(sum * sum * in_sum, there);
        const V up = slope < T(0) ? back : there, down = slope < T(0) ? there : back;
        Slices sums = {larger(low, u_h - down), smaller(high, u_h + up)};
        const V width = sums.width = sums.u2 - sums.u1, mid = T(0.5) * (sums.u1 + sums.u2);
        const V x = mid - u_h, o = q - (T(2) * slope + vv * x) * x;
        const V fall = T(-2) * (slope + vv * x), w2 = width * width * T(1.0 / 12.0);
        const V bow = vv * w2, along = width * w2 * fall;
        sums.o = width * (o - bow);
        sums.o2 = width * (o * (o - T(2) * bow) + fall * fall * w2 + T(1.8) * bow * bow);
        sums.ou = mid * sums.o + along;
        sums.ouu = mid * (sums.ou + along) + width * w2 * (o - T(1.8) * bow);
        const V most = smaller(up + down, length), held = larger(sums.o, V(SMALL));
        const V in_both = T(1) / (most * held);
        sums.part = width * held * in_both;
        sums.at = sums.ou * most * in_both;
        return sums;
    };
    // what both ways across share; rigidity = E* f, steepness = d ln f / d ln P
    struct Edges {
        V3 delta, a, b, along_a, along_b;
        V la, lb, in_la, in_lb, cosine, cross, sine, in_sine2, reach, rigidity, steepness;
    };
    // weight_rate: d ln weight / d cosine
    auto side_share = [&](const Edges& e, V sigma, V weight, V weight_rate) -> Share {
        const V3 along_b = e.along_b * sigma;
        const V cosine = smaller(e.cosine * sigma, V(T(1)));
        const V twice = root(T(2) * (T(1) + cosine)), in_twice = T(1) / twice;
        const V3 middle = (e.along_a + along_b) * in_twice;
        // b.middle = sigma l_b twice / 2
        const V in_bm = T(2) * sigma * e.in_lb * in_twice, t0 = e.delta.dot(middle) * -in_bm;
        const V ratio = sigma * e.la * e.in_lb, in_ratio = sigma * e.lb * e.in_la;
        const V3 d0 = e.delta + e.b * t0, dv = e.b * ratio - e.a;
        const V begin = -t0 * in_ratio, end = (T(1) - t0) * in_ratio;
        const V first = smaller(begin, end), last = larger(begin, end);
        const V low = larger(V(T(0)), first), high = smaller(V(T(1)), last);
        const V vv = dv.dot(dv), flat = PARALLEL2 * e.la * e.la;
        const V deepest = vv > flat ? -d0.dot(dv) / larger(vv, flat) : T(0.5) * (low + high);
        const V mean = T(0.5) * (T(1) + e.lb * e.in_la), beyond = (T(2) * FURTHER) * mean;
        const V ahead = smaller(V(T(0)), first) - beyond, behind = larger(V(T(1)), last) + beyond;
        const V u_h = smaller(larger(deepest, ahead), behind);
        const V3 nearest = d0 + dv * u_h;
        const V h = root(nearest.dot(nearest)), sum = e.reach + h, in_both = T(1) / (h * sum);
        const V in_h = sum * in_both, in_wide = h * in_both, in_root = root(in_wide);
        const V q = (e.reach - h) * sum, slope = nearest.dot(dv);
        const Slices sums = slices(q, slope, vv, u_h, low, high, mean);
        const M touches = (sums.width > NEAR) & (h < e.reach) & (weight > T(0));
        const V rigid = weight * e.rigidity * (T(2) * e.sine * in_twice) * e.la;
        const V scale = T(0.5) * rigid * in_wide * in_wide * in_root;
        Share share;
        share.energy = scale * sums.o2;
        share.stiffness = rigid * sums.width * in_root;
        share.damped = share.stiffness * sums.part;
        share.s = sums.at;
        share.t = t0 + share.s * ratio;
        share.depth = e.reach - h;
        const V pull = T(-4) * scale;
        const V3 whole = (d0 * sums.o + dv * sums.ou) * pull;
        const V3 moment = (d0 * sums.ou + dv * sums.ouu) * pull;
        const V3 by_h = nearest * (T(-2.5) * share.energy * in_wide * in_h);
        share.by_delta = whole + by_h;
        share.by_a = (moment + by_h * u_h) * V(T(-1));
        share.by_b = whole * t0 + moment * ratio + by_h * (t0 + u_h * ratio);
        V by_t0 = share.by_delta.dot(e.b), by_ratio = -share.by_a.dot(e.b);
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
        // twice^2 = 2 (1 + cosine)
        V by_cosine = weight_rate - in_twice * in_twice;
        const V steep = (T(2) * e.steepness + T(1)) * cosine * e.in_sine2;
        by_cosine = share.energy * (e.cross > TURNING_SINE ? by_cosine - steep : by_cosine);
        by_t0 = by_t0 * -in_bm;
        share.by_delta = share.by_delta + middle * by_t0;
        const V3 turned = d0 * (by_t0 * in_twice);
        share.by_a = share.by_a + e.along_a * (share.energy * e.in_la + by_ratio * sigma * e.in_lb)
            + ((along_b - e.along_a * cosine) * by_cosine + turned
               - e.along_a * turned.dot(e.along_a)) * e.in_la;
        share.by_b = share.by_b + middle * (by_t0 * t0)
            - e.b * (by_ratio * ratio * e.in_lb * e.in_lb)
            + ((e.along_a - along_b * cosine) * by_cosine + turned
               - along_b * turned.dot(along_b)) * (sigma * e.in_lb);
        kept_where(touches, share);
        return share;
    };
    // of a tip; the segment begins at delta from it
    auto tip_share = [&](const V3& delta, const V3& b, V lb, V in_lb, V reach, V rigidity, M is_tip)
        -> Share {
        const V bb = lb * lb, in_bb = in_lb * in_lb;
        const V t_h = clamp01(-delta.dot(b) * in_bb);
        const V3 nearest = delta + b * t_h;
        const V h = root(nearest.dot(nearest)), sum = reach + h, in_both = T(1) / (h * sum);
        const V q = (reach - h) * sum;
        const Slices sums = slices(q, nearest.dot(b), bb, t_h, V(T(0)), V(T(1)), V(T(1)));
        const V in_wide = h * in_both, in_root = root(in_wide);
        const V rigid = rigidity * lb, scale = T(0.5) * rigid * in_wide * in_wide * in_root;
        Share share;
        share.energy = scale * sums.o2;
        share.stiffness = rigid * sums.width * in_root;
        share.damped = share.stiffness * sums.part;
        share.s = V(T(0));
        share.t = sums.at;
        share.depth = reach - h;
        const V3 by_h = nearest * (T(-2.5) * share.energy * in_both);
        const V pull = T(-4) * scale;
        share.by_delta = (delta * sums.o + b * sums.ou) * pull + by_h;
        share.by_a = nothing3;
        share.by_b = (delta * sums.ou + b * sums.ouu) * pull + by_h * t_h
            + b * (share.energy * in_bb);
        kept_where(is_tip & (h < reach), share);
        return share;
    };
"""

# Constants of the groups of pairs, `of(side, field)` those of one side; of all pairs at once where
# there is one group. Rounds: rigidities of tips.
SPRINGS = """
    struct Springs {
        V reach, lever, sum, root_product, modulus, round_i, round_j, round_both;
        V in_i, in_j, tip_i, tip_j, shear_part, root_shear;
    };
    auto springs_of = [&](auto has_tips, auto of) -> Springs {
        Springs g;
        const V radius_i = of(0, [](const auto& g) -> T { return g.radius; });
        const V radius_j = of(1, [](const auto& g) -> T { return g.radius; });
        const V soft = of(0, [](const auto& g) -> T { return g.compliance; })
            + of(1, [](const auto& g) -> T { return g.compliance; });
        g.reach = radius_i + radius_j;
        g.lever = radius_i - radius_j;
        const V ki = T(1) / radius_i, kj = T(1) / radius_j, total = ki + kj;
        g.sum = total;
        g.root_product = root(ki * kj);
        g.modulus = T(1) / soft;
        if constexpr (decltype(has_tips)::value) {
            V none;
            g.round_i = g.modulus * hertz_factor(ki + total, root(ki * total), none);
            g.round_j = g.modulus * hertz_factor(kj + total, root(kj * total), none);
            g.round_both = g.modulus * hertz_factor(T(2) * total, total, none);
        }
        if constexpr (HAS_DASHPOT || HAS_FRICTION) {
            auto inside = [](const auto& g) -> T { return g.mass; };
            auto end = [](const auto& g) -> T { return g.closed ? g.mass : g.end_mass; };
            g.in_i = T(1) / of(0, inside);
            g.in_j = T(1) / of(1, inside);
            g.tip_i = T(1) / of(0, end);
            g.tip_j = T(1) / of(1, end);
        }
        if constexpr (HAS_FRICTION) {
            auto shear = [](const auto& g) -> T { return g.shear_compliance; };
            g.shear_part = T(4) * soft / (of(0, shear) + of(1, shear));
            g.root_shear = root(g.shear_part);
        }
        return g;
    };
    struct Tipped { enum { value = true }; };
    struct Untipped { enum { value = false }; };
    Springs alike;
    if (one_group)
        alike = springs_of(Tipped(), [&](int, auto field) -> V { return V(field(groups[0])); });
"""

# Sets `share` of the lanes, the part of its force along the normal, and what nodes feel besides.
# Without IS_SHARED for pairs that have a patch within both segments; WAYS across which slices lie,
# 0 for lanes of either kind; HAS_TIPS where a patch may be at the end of a fiber.
NORMAL = """
    const V reach = g.reach;
    Edges e = {delta, a, b};
    e.la = root(a.dot(a));
    e.lb = root(b.dot(b));
    const V in_both = T(1) / (e.la * e.lb);
    e.in_la = e.lb * in_both;
    e.in_lb = e.la * in_both;
    e.along_a = a * e.in_la;
    e.along_b = b * e.in_lb;
    e.cosine = a.dot(b) * in_both;
    const V cosine = e.cosine < T(0) ? -e.cosine : e.cosine;
    const V3 normal = a.cross(b);
    e.cross = root(normal.dot(normal)) * in_both;
    e.sine = larger(e.cross, V(SMALLEST_SINE));
    e.reach = reach;
    e.rigidity = g.modulus * hertz_factor(g.sum, g.root_product * e.sine, e.steepness);
    auto point_share = [&](V stiff) -> Share {
        const V3 gap = delta + b * t - a * s;
        const V size = root(gap.dot(gap)), deep = larger(reach - size, V(T(0)));
        stiff = T(2) * stiff * root(deep);
        Share at = {T(4.0 / 15.0) * stiff * deep * deep, stiff, stiff, s, t, deep};
        at.by_delta = gap * (T(-2.0 / 3.0) * stiff * deep / size);
        at.by_a = at.by_delta * -s;
        at.by_b = at.by_delta * t;
        return at;
    };
    Share share;
    if constexpr (!KIND::IS_SHARED) {
        e.in_sine2 = T(1) / (e.sine * e.sine);
        share = point_share(e.rigidity);
        // a wider angle stores less: d ln P = -2 cos d cos / sin^2
        V twist = T(-2) * e.steepness * share.energy * e.cosine * e.in_sine2;
        twist = e.cross > TURNING_SINE ? twist : V(T(0));
        share.by_a = share.by_a + (e.along_b - e.along_a * e.cosine) * (twist * e.in_la);
        share.by_b = share.by_b + (e.along_a - e.along_b * e.cosine) * (twist * e.in_lb);
    } else {
        const V sigma = e.cosine < T(0) ? V(T(-1)) : V(T(1));
        if constexpr (KIND::WAYS == 1) {
            e.in_sine2 = T(1) / (e.sine * e.sine);
            share = side_share(e, sigma, V(T(1)), V(T(0)));
        } else {
            const M two_ways = (KIND::WAYS == 2) | (cosine < BOTH_WAYS);
            const V weight = two_ways ? smaller(T(0.5) + cosine, V(T(1))) : V(T(1));
            const V rest = T(1) - weight, other = larger(rest, V(SMALL));
            const V in_all = T(1) / (e.sine * e.sine * weight * other);
            const V rate = e.sine * e.sine * in_all;
            e.in_sine2 = weight * other * in_all;
            share = side_share(e, sigma, weight, two_ways ? other * rate : V(T(0)));
            if (KIND::WAYS == 2 || any(two_ways)) {
                const Share more = side_share(e, -sigma, rest, weight * rate);
                const V energy = share.energy + more.energy;
                const V part = more.energy / larger(energy, V(TINY));
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
        }
        if constexpr (KIND::HAS_TIPS) {
            const M is_tip_i = s < T(0.5) ? tip0_i : tip1_i;
            const M is_tip_j = t < T(0.5) ? tip0_j : tip1_j;
            s = s < T(0.5) ? V(T(0)) : V(T(1));
            t = t < T(0.5) ? V(T(0)) : V(T(1));
            Share tip = tip_share(delta - a * s, b, e.lb, e.in_lb, reach, g.round_i, is_tip_i);
            tip.s = s;
            tip.by_a = tip.by_delta * -s;
            replace(tip.energy > share.energy, share, tip);
            tip = tip_share(
                nothing3 - delta - b * t, a, e.la, e.in_la, reach, g.round_j, is_tip_j);
            tip.s = tip.t;
            tip.t = t;
            tip.by_a = tip.by_b;
            tip.by_b = tip.by_delta * -t;
            tip.by_delta = tip.by_delta * V(T(-1));
            replace(tip.energy > share.energy, share, tip);
            tip = point_share(g.round_both);
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
