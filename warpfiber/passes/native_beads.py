"""Bead lubrication of several pairs at once: text of the native pair sweep on the CPU.

Every lane owns one pair and walks over its own bead pairs (m, n) in the order of
`bead_pairs.lubricate`, with the same operations, so that both give the same bits. The beads of i
that can be near form an interval, and those of j near to one of them another: a lane goes from one
candidate to the next, and the lanes need as many rounds as the longest of them.

Source: as `bead_pairs.lubricate`. With q(s) = D - s a across b, |q|^2 <= reach^2 bounds s; with p =
    |q(s)|^2 the beads of j are at most sqrt((reach^2 - p) / b^2) from the foot of s. Both bounds
    are widened by more than their rounding; the distance itself decides, as in the law.
"""

from string import Template

from warpfiber.laws.lubrication import INNER, OUTER

# Widening of the bounds: relative to the squares of the lengths they come from, and of s itself.
MARGIN = {"float32": 1e-4, "float64": 1e-9}
# Below this sin^2 of their angle two segments count as parallel: all beads of i are looked at.
STEEP = 1e-2

SQUEEZE_PAIRS = Template("""
    const bool alike = groups.shape[0] == 1;
    const int segments = segment_node.shape[0];
    const auto* group_of = fiber_group.data;
    auto is_last = [&](int i) { return i + 1 == segments || segment[i + 1] != segment[i] + 1; };
    auto root = [](lane_t u) { return __builtin_elementwise_sqrt(u); };
    const lane_t zero = real(0), one = real(1);
    while (near) {
        int ks[$lanes], used = 0;
        for (; near && used < $lanes; near &= near - 1)
            ks[used++] = first + __builtin_ctzll(near);
        for (int q = used; q < $lanes; ++q) ks[q] = ks[used - 1];
        point_t a, b, delta;
        gather(ks, a, b, delta);

        rows_t rows_vi0, rows_vi1, rows_vj0, rows_vj1;
        lane_t last_i, last_j;
        lane_t radius_i, radius_j, mass_i, mass_j, drag_i, inner_i, inner_j, weigh_i, weigh_j;
        for (int q = 0; q < $lanes; ++q) {
            int i = pair_i.data[ks[q]], j = pair_j.data[ks[q]];
            last_i[q] = is_last(i);
            last_j[q] = is_last(j);
            const real* vi = (const real*)node_velocity.data + 3 * (long long)segment[i];
            const real* vj = (const real*)node_velocity.data + 3 * (long long)segment[j];
            rows_vi0.r[q] = load(vi);
            rows_vi1.r[q] = load(vi + 2).yzww;
            rows_vj0.r[q] = load(vj);
            rows_vj1.r[q] = load(vj + 2).yzww;
            $moving
            if (alike && q > 0) continue;
            const auto& gi = groups.data[alike ? 0 : group_of[segment_fiber.data[i]]];
            const auto& gj = groups.data[alike ? 0 : group_of[segment_fiber.data[j]]];
            radius_i[q] = gi.radius; mass_i[q] = gi.mass; drag_i[q] = gi.drag;
            inner_i[q] = gi.inner_beads; weigh_i[q] = gi.bead_weight;
            radius_j[q] = gj.radius; mass_j[q] = gj.mass;
            inner_j[q] = gj.inner_beads; weigh_j[q] = gj.bead_weight;
        }
        if (alike) {
            radius_i = radius_j = lane_t(radius_i[0]);
            mass_i = mass_j = lane_t(mass_i[0]);
            inner_i = inner_j = lane_t(inner_i[0]);
            weigh_i = weigh_j = lane_t(weigh_i[0]);
            drag_i = lane_t(drag_i[0]);
        }
        point_t vi0 = transpose(rows_vi0), vi1 = transpose(rows_vi1);
        point_t vj0 = transpose(rows_vj0), vj1 = transpose(rows_vj1);

        lane_t contact = radius_i + radius_j;
        lane_t reach2 = (real($outer) * contact) * (real($outer) * contact);
        lane_t nearest2 = (real($inner) * contact) * (real($inner) * contact);
        lane_t narrow = radius_i * radius_j / contact;
        lane_t scale = (drag_i / radius_i) * narrow * narrow;
        lane_t inverse_mass_dt = dt * (one / mass_i + one / mass_j);
        lane_t shift = $resistance_shift;
        lane_t beads_i = inner_i + one, beads_j = inner_j + one;
        lane_t step_i = one / beads_i, step_j = one / beads_j;
        lane_t end_n = inner_j + last_j;
        lane_t bb = dot(b, b), inverse_bb = one / bb;

        // beads m ... end_m of i may be near
        lane_t along_a = dot(a, b) * inverse_bb, along_d = dot(delta, b) * inverse_bb;
        point_t across = {
            a.x - along_a * b.x, a.y - along_a * b.y, a.z - along_a * b.z
        };
        point_t offset = {
            delta.x - along_d * b.x, delta.y - along_d * b.y, delta.z - along_d * b.z
        };
        lane_t qq = dot(across, across), dq = dot(offset, across), aa = dot(a, a);
        lane_t loose = reach2 + real($margin) * (reach2 + aa + dot(delta, delta));
        lane_t half = root(larger(dq * dq - qq * (dot(offset, offset) - loose), zero));
        lane_t per_s = beads_i / qq;
        lane_t m = larger(
            __builtin_elementwise_ceil((dq - half) * per_s - real($margin) * beads_i), zero
        );
        lane_t end_m = __builtin_elementwise_floor(
            (dq + half) * per_s + real($margin) * beads_i
        );
        end_m = end_m < inner_i + last_i ? end_m : inner_i + last_i;
        m = qq > real($steep) * aa ? m : zero;
        end_m = qq > real($steep) * aa ? end_m : inner_i + last_i;

        lane_t n = zero, active = zero;
        point_t force = {zero, zero, zero}, arm_i = force, arm_j = force;
        while (any(m <= end_m)) {
            lane_t s = m * step_i;
            point_t c0 = {delta.x - s * a.x, delta.y - s * a.y, delta.z - s * a.z};
            lane_t foot = -dot(c0, b) * inverse_bb;
            point_t p = {c0.x + foot * b.x, c0.y + foot * b.y, c0.z + foot * b.z};
            lane_t left = reach2 - dot(p, p);
            lane_t span = left + real($margin) * (reach2 + dot(c0, c0));
            span = root(larger(span * inverse_bb, zero)) * beads_j;
            lane_t middle = foot * beads_j;
            n = larger(n, __builtin_elementwise_ceil(middle - span));
            lane_t n_last = __builtin_elementwise_floor(middle + span);
            n_last = n_last < end_n ? n_last : end_n;

            lane_t t = n * step_j;
            point_t c = {c0.x + t * b.x, c0.y + t * b.y, c0.z + t * b.z};
            lane_t cc = dot(c, c);
            auto acts = (m <= end_m) & (left >= zero) & (n <= n_last)
                & (cc >= nearest2) & (cc <= reach2);
            lane_t weight = ((m > zero) & (m <= inner_i)) ? weigh_i : one;
            weight = ((n > zero) & (n <= inner_j)) ? weight * weigh_j : weight;
            lane_t os = one - s, ot = one - t;
            point_t v = {
                ot * vj0.x + t * vj1.x - os * vi0.x - s * vi1.x,
                ot * vj0.y + t * vj1.y - os * vi0.y - s * vi1.y,
                ot * vj0.z + t * vj1.z - os * vi0.z - s * vi1.z
            };
            lane_t gap = root(cc) - contact;
            lane_t share = weight * scale * (one - shift * gap);
            lane_t resistance = share / (gap + share * inverse_mass_dt);
            lane_t size = resistance * dot(v, c) / cc;
            size = acts ? size : zero;
            point_t f = {size * c.x, size * c.y, size * c.z};
            force.x += f.x; force.y += f.y; force.z += f.z;
            arm_i.x += s * f.x; arm_i.y += s * f.y; arm_i.z += s * f.z;
            arm_j.x += t * f.x; arm_j.y += t * f.y; arm_j.z += t * f.z;
            active = acts ? one : active;

            auto stay = (n < n_last) & (left >= zero);
            n = stay ? n + one : zero;
            m = stay ? m : m + one;
        }
        for (int q = 0; q < used; ++q) {
            int k = ks[q];
            if (active[q] == real(0)) continue;
            pair_acts.data[k] = 1;
            pair_force.data[k] = wp::vec_t<3, real>(force.x[q], force.y[q], force.z[q]);
            pair_arm_i.data[k] = wp::vec_t<3, real>(arm_i.x[q], arm_i.y[q], arm_i.z[q]);
            pair_arm_j.data[k] = wp::vec_t<3, real>(arm_j.x[q], arm_j.y[q], arm_j.z[q]);
        }
    }
    return touch;
""")
# images move with the flow
MOVING = """if (pair_image.data[ks[q]] != none) {
                wp::vec_t<3, real> u = wp::mul(gradient.data[0], shift_of(ks[q]));
                row_t moving = {u.c[0], u.c[1], u.c[2], real(0)};
                rows_vj0.r[q] += moving;
                rows_vj1.r[q] += moving;
            }"""


def squeeze_text(name: str, lanes: int, lubrication: str, sheared: bool) -> str:
    """The part of the native block that lubricates near pairs; returns the touching ones."""
    return SQUEEZE_PAIRS.substitute(
        lanes=lanes,
        moving=MOVING if sheared else "",
        outer=OUTER,
        inner=INNER,
        margin=MARGIN[name],
        steep=STEEP,
        resistance_shift="real(2) / contact" if lubrication == "shifted" else "zero",
    )
