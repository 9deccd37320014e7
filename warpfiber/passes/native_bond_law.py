"""C++ text of the bonds of a block of fibers, one lane per fiber: law `bond`, its loads summed up.

The factor g of a bond is the short series of `bond` where that holds, and one of 24 terms up to
half a turn between two nodes: no angle is left that needs trigonometry.
Symbols: as in `bond`; m0, m1, m2 rows of the rotation by the frame midway, side = 1 / (1 + p_w);
    the rest as in `native_bonds_source`.
"""

from warpfiber.laws.bending import SERIES_END, SERIES_TERMS, bending_series

# Of the series up to a right angle between a node and the frame midway: errors 2e-17 and 3e-10.
LONG_SERIES_TERMS = 24


def bond_constants() -> str:
    """Series of the law."""
    lines = [f"constexpr T SERIES_END = T({SERIES_END!r});"]
    lines.append(f"constexpr int LONG_TERMS = {LONG_SERIES_TERMS};")
    for key, end, terms in (("SHORT", SERIES_END, SERIES_TERMS), ("LONG", 1.0, LONG_SERIES_TERMS)):
        text = ", ".join(f"T({value!r})" for value in bending_series(end, terms))
        lines.append(f"constexpr T {key}[{terms}] = {{{text}}};")
    return "\n".join(lines)


# Adds the loads of all bonds to a and b; lanes whose fiber tore are in `torn`.
BONDS = """
    const V kn = V(g.stiffness[0]), kt = V(g.stiffness[1]);
    const V kb = V(g.stiffness[2]), kw = V(g.stiffness[3]);
    const V cn = V(g.dashpots[0]), ct = V(g.dashpots[1]);
    const V cb = V(g.dashpots[2]), cw = V(g.dashpots[3]);
    auto split = [](const V3& u, const V3& axis, V along, V across) -> V3 {
        return u * across + axis * ((along - across) * u.dot(axis));
    };
    M torn = V(T(1)) < T(0);
    const T torn2 = g.torn_length * g.torn_length;
    P3 x0 = get_P(x, 0);
    V3 v0 = get(v, 0), w0 = get(w, 0);
    V4 q0 = get4(q, 0);
    for (int k = 0; k < segments; ++k) {
        const P3 x1 = get_P(x, k + 1);
        const V3 v1 = get(v, k + 1), w1 = get(w, k + 1);
        const V4 q1 = get4(q, k + 1);
        const V3 d = {narrow(x1.x - x0.x), narrow(x1.y - x0.y), narrow(x1.z - x0.z)};
        const V3 e0 = get(axis, k);
        const V l0 = length[k];
        V pw = q0.v.dot(q1.v) + q0.s * q1.s;
        const V sign = pw < T(0) ? V(T(-1)) : V(T(1));
        pw *= sign;
        const V3 near_v = q1.v * sign;
        const V near_s = q1.s * sign;
        const V3 pv = near_v * q0.s - q0.v * near_s - q0.v.cross(near_v);
        const V side = T(1) / (T(1) + pw);
        const V3 s = q0.v + near_v;
        const V ss = q0.s + near_s;
        // rotation by the frame midway, of any length: |s|^2 = 2 (1 + p_w)
        const V3 r = s * side;
        const V xx = r.x * s.x, yy = r.y * s.y, zz = r.z * s.z;
        const V xy = r.x * s.y, xz = r.x * s.z, yz = r.y * s.z;
        const V sx = r.x * ss, sy = r.y * ss, sz = r.z * ss;
        const V3 m0 = {T(1) - (yy + zz), xy - sz, xz + sy};
        const V3 m1 = {xy + sz, T(1) - (xx + zz), yz - sx};
        const V3 m2 = {xz - sy, yz + sx, T(1) - (xx + yy)};
        const V3 edge = m0 * d.x + m1 * d.y + m2 * d.z;

        const V y = T(1) - pw, z = y * y;
        V even = SHORT[7] + z * (SHORT[9] + z * SHORT[11]);
        even = SHORT[1] + z * (SHORT[3] + z * (SHORT[5] + z * even));
        V odd = SHORT[6] + z * (SHORT[8] + z * SHORT[10]);
        odd = SHORT[2] + z * (SHORT[4] + z * odd);
        V slope = even + y * odd;
        const M wide = y > SERIES_END;
        if (__builtin_expect(any(wide), 0)) {
            V sum = V(LONG[LONG_TERMS - 1]);
            #pragma unroll
            for (int t = LONG_TERMS - 2; t > 0; --t) sum = sum * y + LONG[t];
            slope = wide ? sum : slope;
        }
        const V factor = T(1) + y * slope;

        const V3 n = split(edge - e0 * l0, e0, kn, kt);
        const V3 mm = split(pv * (factor * T(2)), e0, kw, kb);
        V3 couple = mm * factor - pv * (slope * side * pv.dot(mm));
        couple = couple + edge.cross(n).cross(pv) * (side * T(0.5));
        V3 pull = {m0.dot(n), m1.dot(n), m2.dot(n)};
        V3 twist = {m0.dot(couple), m1.dot(couple), m2.dot(couple)};
        const V dd = d.dot(d);
        if constexpr (HAS_DASHPOTS) {
            const V inverse = T(1) / (dd > T(1e-30) ? dd : V(T(1e-30)));
            const V3 slip = v1 - v0 - (w0 + w1).cross(d) * V(T(0.5));
            const V3 turning = w1 - w0;
            pull = pull + slip * ct + d * ((cn - ct) * inverse * slip.dot(d));
            twist = twist + turning * cb + d * ((cw - cb) * inverse * turning.dot(d));
        }
        const V3 lever = d.cross(pull) * V(T(0.5));
        put(a, k, get(a, k) + pull);
        put(b, k, get(b, k) + lever + twist);
        put(a, k + 1, get(a, k + 1) - pull);
        put(b, k + 1, get(b, k + 1) + lever - twist);
        torn |= ~(dd < torn2);  // not finite is torn too
        x0 = x1;
        v0 = v1;
        w0 = w1;
        q0 = q1;
    }
"""
