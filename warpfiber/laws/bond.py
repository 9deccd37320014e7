"""Bond of two nodes of a fiber that move and turn: its energy, the exact gradient, dashpots.

Source: geometrically exact (Simo-Reissner) rod with one integration point, in the frame midway
    between those of the nodes; linearized, Xu, Ma & Guo 2023, Eqs. (3)-(6). Total form: loads
    follow from where the nodes are, not from how they came there, so nothing drifts. Dashpots in
    the form of their Eq. (10). With p = conj(q_i) q_j = (p_v, p_w) and y = 1 - p_w the factor
    g = (a/2) / sin(a/2) = 1 + y G(y) is the series of `bending`, without angles.
Symbols: d = x_j - x_i; q quaternion (x, y, z, w) of a node, 1 in the stress-free shape; e0, l0
    direction and length of the bond there; a, u angle and axis of the rotation from i to j;
    stiffness k = (K_n, K_t, K_b, K_w) of stretching, shear (N/m), bending and twist (N m); dashpots
    c alike.
Limits: a turn by pi between two nodes can be seen from both sides; the energy has a kink there.
"""

from functools import cache

import warp as wp

from warpfiber.laws.bending import SERIES_END, SERIES_TERMS, bending_series
from warpfiber.model import precision


@cache
def make_bond(name):
    """`bond_loads`, `bond_energies` and `bond_dashpots` in the given precision."""
    p = precision(name)
    real, vec2, vec3, vec4, mat33 = p.real, p.vec2, p.vec3, p.vec4, p.mat33
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    series_end = real(SERIES_END)
    c = [real(value) for value in bending_series(SERIES_END, SERIES_TERMS)]

    @wp.func
    def relative_rotation(qi: vec4, qj: vec4) -> vec4:
        """p = conj(q_i) q_j."""
        vi = vec3(qi[0], qi[1], qi[2])
        vj = vec3(qj[0], qj[1], qj[2])
        v = qi[3] * vj - qj[3] * vi - wp.cross(vi, vj)
        return vec4(v[0], v[1], v[2], wp.dot(qi, qj))

    @wp.func
    def rotation_matrix(s: vec4) -> mat33:
        """Of a quaternion of any length."""
        x, y, z, w = s[0], s[1], s[2], s[3]
        k = two / wp.dot(s, s)
        return mat33(
            one - k * (y * y + z * z),
            k * (x * y - z * w),
            k * (x * z + y * w),
            k * (x * y + z * w),
            one - k * (x * x + z * z),
            k * (y * z - x * w),
            k * (x * z - y * w),
            k * (y * z + x * w),
            one - k * (x * x + y * y),
        )

    @wp.func
    def rotation_factors(pv: vec3, pw: real) -> vec2:
        """(g, G)."""
        y = one - pw
        if y > series_end:
            sine = wp.length(pv)
            g = wp.atan2(sine, pw) / sine
            return vec2(g, (g - one) / y)
        # even and odd powers apart: two short chains of operations instead of a long one
        z = y * y
        even = wp.static(c[7]) + z * (wp.static(c[9]) + z * wp.static(c[11]))
        even = wp.static(c[1]) + z * (wp.static(c[3]) + z * (wp.static(c[5]) + z * even))
        odd = wp.static(c[6]) + z * (wp.static(c[8]) + z * wp.static(c[10]))
        odd = wp.static(c[2]) + z * (wp.static(c[4]) + z * odd)
        slope = even + y * odd
        return vec2(one + y * slope, slope)

    @wp.func
    def split(values: vec3, axis: vec3, along: real, across: real) -> vec3:
        """The part along the axis and the rest, each times its own constant."""
        return across * values + ((along - across) * wp.dot(values, axis)) * axis

    @wp.func
    def bond_loads(k: vec4, e0: vec3, l0: real, d: vec3, qi: vec4, qj: vec4):
        """Force F on i (-F on j) and moment N: d x F / 2 + N on i, d x F / 2 - N on j."""
        near = qj
        if wp.dot(qi, qj) < zero:
            near = -qj
        turn = relative_rotation(qi, near)
        pv = vec3(turn[0], turn[1], turn[2])
        middle = rotation_matrix(qi + near)
        factors = rotation_factors(pv, turn[3])
        g = factors[0]
        edge = wp.transpose(middle) * d
        force = split(edge - l0 * e0, e0, k[0], k[1])
        moment = split((two * g) * pv, e0, k[3], k[2])
        side = one / (one + turn[3])
        # tan(a/4) u = side p_v, and (1 - g) (u . m) u = -G side (p_v . m) p_v
        couple = g * moment - (factors[1] * side * wp.dot(pv, moment)) * pv
        couple += (half * side) * wp.cross(wp.cross(edge, force), pv)
        return middle * force, middle * couple

    @wp.func
    def bond_energies(k: vec4, e0: vec3, l0: real, d: vec3, qi: vec4, qj: vec4) -> vec4:
        """Energies of stretching, shear, bending and twist."""
        near = qj
        if wp.dot(qi, qj) < zero:
            near = -qj
        turn = relative_rotation(qi, near)
        pv = vec3(turn[0], turn[1], turn[2])
        factors = rotation_factors(pv, turn[3])
        gamma = wp.transpose(rotation_matrix(qi + near)) * d - l0 * e0
        psi = (two * factors[0]) * pv
        stretch = wp.dot(gamma, e0)
        twist = wp.dot(psi, e0)
        return half * vec4(
            k[0] * stretch * stretch,
            k[1] * wp.length_sq(gamma - stretch * e0),
            k[2] * wp.length_sq(psi - twist * e0),
            k[3] * twist * twist,
        )

    @wp.func
    def bond_dashpots(c: vec4, d: vec3, dv: vec3, wi: vec3, wj: vec3):
        """Force and moment like those of `bond_loads`; dv = v_j - v_i."""
        by_square = one / wp.dot(d, d)
        slip = dv - half * wp.cross(wi + wj, d)
        turn = wj - wi
        along = (c[0] - c[1]) * by_square * wp.dot(slip, d)
        twist = (c[3] - c[2]) * by_square * wp.dot(turn, d)
        return c[1] * slip + along * d, c[2] * turn + twist * d

    return bond_loads, bond_energies, bond_dashpots
