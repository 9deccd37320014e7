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
    // integrals over x1 to x2 of overlaps o = q - 2 slope x - ww x^2
    struct Slices { V o2, o, ox, oxx; };
    auto overlap_at = [](V q, V slope, V ww, V x) -> V {
        return q - (T(2) * slope + ww * x) * x;
    };
    auto slices = [&](V q, V slope, V ww, V x1, V x2) -> Slices {
        const V x = T(0.5) * (x1 + x2), width = x2 - x1, r = T(0.5) * width;
        const V o0 = overlap_at(q, slope, ww, x), o1 = -width * (slope + ww * x), o2 = ww * r * r;
        const V o = o0 - T(1.0 / 3.0) * o2, first = r * T(1.0 / 3.0) * o1;
        const V square = o0 * (o0 - T(2.0 / 3.0) * o2) + T(1.0 / 3.0) * o1 * o1 + T(0.2) * o2 * o2;
        const V second = r * r * (T(1.0 / 3.0) * o0 - T(0.2) * o2);
        return {width * square, width * o, width * (x * o + first),
                width * (x * (x * o + T(2) * first) + second)};
    };
    // rigidity = E* f; turning: d ln rigidity / d cosine
    struct Edges {
        V3 delta, along_a, along_b;
        V la, lb, in_la, in_lb, cosine, cross, sine, reach, rigidity, steepness, turning;
    };
    // slices across the mean direction of a and sigma b; wider = 1 / (1 + cosine), in_ww = 1 / w^2
    struct Way { V sigma, weight, wider, in_ww, leading; };
    auto side_share = [&](const Edges& e, const Way& way) -> Share {
        const V sigma = way.sigma, wider = way.wider, none = V(T(0));
        const V3 along_b = e.along_b * sigma, mean = e.along_a + along_b, w = along_b - e.along_a;
        const V offset = e.delta.dot(mean) * -wider;
        const V3 d0 = e.delta + along_b * offset;
        const V first = (sigma > T(0) ? none : -e.lb) - offset, last = first + e.lb;
        const V low = larger(none, first), high = smaller(e.la, last);
        const V w2 = w.dot(w), ww = larger(w2, V(PARALLEL2));
        const V deepest = w2 > PARALLEL2 ? d0.dot(w) * -way.in_ww : T(0.5) * (low + high);
        const V both = e.la + e.lb, beyond = FURTHER * both;
        const V ahead = smaller(none, first) - beyond, behind = larger(e.la, last) + beyond;
        const V u_h = smaller(larger(deepest, ahead), behind);
        const V3 nearest = d0 + w * u_h;
        const V h = root(nearest.dot(nearest)), sum = e.reach + h, in_h = T(1) / (h * sum);
        const V q = (e.reach - h) * sum, slope = nearest.dot(w);
        const V wide = root(larger(slope * slope + ww * q, none));
        const V begin = low - u_h, end = high - u_h;
        const V x1 = larger(begin, (wide + slope) * -way.in_ww);
        const V x2 = smaller(end, (wide - slope) * way.in_ww);
        const V width = x2 - x1, rounding = NEAR * e.la;
        const M touches =
            (high > low) & (h < e.reach) & (width > rounding) & (way.weight > T(0));
        const Slices sums = slices(q, slope, ww, x1, x2);
        const V in_wide = in_h * h, in_root = root(in_wide);
        const V rigid = way.weight * e.rigidity * e.sine * root(T(2) * wider);
        const V scale = T(0.5) * rigid * in_wide * in_wide * in_root;
        const V most = smaller(T(2) * wide * way.in_ww, T(0.5) * both);
        const V parts = T(1) / larger(most * sums.o, V(TINY));
        const V place = u_h + sums.ox * (parts * most);
        Share share;
        share.energy = scale * sums.o2;
        share.stiffness = rigid * width * in_root;
        share.damped = share.stiffness * width * (parts * sums.o);
        share.s = place * e.in_la;
        share.t = (offset + place) * (sigma * e.in_lb);
        share.depth = e.reach - h;
        const V pull = T(-4) * scale;
        const V3 deeper = nearest * (T(-2.5) * share.energy * in_h);
        const V by_o = pull * sums.o, by_ox = pull * sums.ox, by_oxx = pull * sums.oxx;
        const V3 whole = nearest * by_o + w * by_ox + deeper;
        const V3 moment = nearest * by_ox + w * by_oxx + whole * u_h;
        // half where ends face each other and rounding would decide
        auto beyond_zero = [&](V x) -> V {
            return x > rounding ? V(T(1)) : (x < -rounding ? none : V(T(0.5)));
        };
        auto squared = [&](V x) -> V {
            const V o = overlap_at(q, slope, ww, x);
            return scale * o * o;
        };
        const V at_high = x2 >= end ? squared(x2) : none, held = deeper.dot(w);
        // slices may be deepest far beyond both, where the mean length beyond them ends
        const M is_ahead = deepest < ahead, is_behind = deepest > behind;
        const V ends = beyond_zero(last - e.la);
        V at_last = beyond_zero(e.la - last) * at_high;
        V at_first = x1 <= begin ? -beyond_zero(first) * squared(x1) : none;
        V by_length_a = at_high - at_last;
        at_first = at_first + (is_ahead ? beyond_zero(-first) * held : none);
        at_last = at_last + (is_behind ? ends * held : none);
        const V stretched = FURTHER * (is_behind ? held : (is_ahead ? -held : none));
        by_length_a = by_length_a + (is_behind ? (T(1) - ends) * held : none) + stretched;
        // along sigma b
        const V by_length_b = sigma * stretched + (sigma > T(0) ? at_last : at_first);
        const V by_cosine = share.energy * (way.leading - T(0.5) * wider + sigma * e.turning);
        // slices turn with the mean direction: d0 stays across it
        const V turn_by = (whole.dot(along_b) - at_first - at_last) * -wider;
        share.by_delta = whole + mean * turn_by;
        const V3 turned = d0 * turn_by;
        const V3 g_a = turned - moment + along_b * by_cosine;
        const V3 g_b = turned + moment + e.along_a * by_cosine + share.by_delta * offset;
        const V in_lb = sigma * e.in_lb;
        share.by_a = g_a * e.in_la + e.along_a * (by_length_a - e.in_la * g_a.dot(e.along_a));
        share.by_b = g_b * in_lb
            + along_b * (by_length_b - in_lb * g_b.dot(along_b));
        kept_where(touches, share);
        return share;
    };
    // of a tip; the segment begins at delta from it
    auto tip_share = [&](const V3& delta, const V3& along, V length, V in_length, V reach,
                         V rigidity, M is_tip) -> Share {
        const V none = V(T(0)), one = V(T(1));
        const V t_h = smaller(larger(-delta.dot(along), none), length);
        const V3 nearest = delta + along * t_h;
        const V h = root(nearest.dot(nearest)), sum = reach + h, in_h = T(1) / (h * sum);
        const V q = (reach - h) * sum, slope = nearest.dot(along);
        const V wide = root(larger(slope * slope + q, none));
        const V x1 = larger(-t_h, -wide - slope), x2 = smaller(length - t_h, wide - slope);
        const Slices sums = slices(q, slope, one, x1, x2);
        const V in_wide = in_h * h, in_root = root(in_wide), width = x2 - x1;
        const V scale = T(0.5) * rigidity * in_wide * in_wide * in_root;
        const V most = smaller(T(2) * wide, length), held = larger(sums.o, V(TINY));
        const V parts = T(1) / (most * held);
        Share share;
        share.energy = scale * sums.o2;
        share.stiffness = rigidity * width * in_root;
        share.damped = share.stiffness * width * (held * parts);
        share.s = none;
        share.t = (t_h + sums.ox * (most * parts)) * in_length;
        share.depth = reach - h;
        const V pull = T(-4) * scale, by_ox = pull * sums.ox;
        share.by_delta = nearest * (pull * sums.o - T(2.5) * share.energy * in_h) + along * by_ox;
        const V3 moment = nearest * by_ox + along * (pull * sums.oxx) + share.by_delta * t_h;
        share.by_a = nothing3;
        share.by_b = (moment + along * share.energy) * in_length;
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
    Edges e = {delta};
    e.la = root(a.dot(a));
    e.lb = root(b.dot(b));
    // two divisions: of nearly parallel segments only the difference counts
    e.in_la = T(1) / e.la;
    e.in_lb = T(1) / e.lb;
    const V in_both = e.in_la * e.in_lb;
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
    const V sine2 = e.sine * e.sine;
    if constexpr (!KIND::IS_SHARED) {
        share = point_share(e.rigidity);
        // a wider angle stores less: d ln P = -2 cos d cos / sin^2
        V twist = T(-2) * e.steepness * share.energy * e.cosine / sine2;
        twist = e.cross > TURNING_SINE ? twist : V(T(0));
        share.by_a = share.by_a + (e.along_b - e.along_a * e.cosine) * (twist * e.in_la);
        share.by_b = share.by_b + (e.along_a - e.along_b * e.cosine) * (twist * e.in_lb);
    } else {
        Way way = {e.cosine < T(0) ? V(T(-1)) : V(T(1))};
        const V3 apart = e.along_b * way.sigma - e.along_a;
        const V ww = larger(apart.dot(apart), V(PARALLEL2)), side = T(1) + smaller(cosine, V(T(1)));
        const V ends = side * ww;
        const M two_ways = (KIND::WAYS == 2) | (cosine < BOTH_WAYS);
        V in_sine2, in_ends, rest, other;
        if constexpr (KIND::WAYS == 1) {
            const V in_all = T(1) / (sine2 * ends);
            in_sine2 = ends * in_all;
            in_ends = sine2 * in_all;
            way.weight = V(T(1));
            way.leading = V(T(0));
        } else {
            way.weight = two_ways ? smaller(T(0.5) + cosine, V(T(1))) : V(T(1));
            rest = T(1) - way.weight;
            other = larger(rest, V(SMALL));
            const V in_all = T(1) / (sine2 * ends * way.weight * other);
            const V in_weights = sine2 * ends * in_all, in_sides = way.weight * other * in_all;
            in_sine2 = ends * in_sides;
            in_ends = sine2 * in_sides;
            way.leading = two_ways ? other * in_weights : V(T(0));
            other = way.weight * in_weights;
        }
        way.wider = in_ends * ww;
        way.in_ww = in_ends * side;
        const V turning = (T(-2) * e.steepness - T(1)) * e.cosine * in_sine2;
        e.turning = e.cross > TURNING_SINE ? turning : V(T(0));
        share = side_share(e, way);
        if constexpr (KIND::WAYS != 1) {
            if (KIND::WAYS == 2 || any(two_ways)) {
                const Share more = side_share(
                    e, Way{-way.sigma, rest, T(2) * way.in_ww, T(0.5) * way.wider, other});
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
            Share tip = tip_share(
                delta - a * s, e.along_b, e.lb, e.in_lb, reach, g.round_i, is_tip_i);
            tip.s = s;
            tip.by_a = tip.by_delta * -s;
            replace(tip.energy > share.energy, share, tip);
            tip = tip_share(
                nothing3 - delta - b * t, e.along_a, e.la, e.in_la, reach, g.round_j, is_tip_j);
            tip.s = tip.t;
            tip.t = t;
            tip.by_a = tip.by_b;
            tip.by_b = tip.by_delta * -t;
            tip.by_delta = tip.by_delta * V(T(-1));
            replace(tip.energy > share.energy, share, tip);
            if (any(is_tip_i & is_tip_j)) {
                tip = point_share(g.round_both);
                replace(is_tip_i & is_tip_j & (tip.energy > share.energy), share, tip);
            }
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
