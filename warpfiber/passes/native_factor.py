"""Block elimination of fibers in vectors: C++ text of the factors of a node, a lane is a fiber.

Factors of a fiber follow from the axes of its segments and what resists their turning: four numbers
of a node instead of all its rows (`elimination`), which a solve for contact turns into the same
factors again. They take less to compute than to write and to read:
of 1000 fibers of 6 nodes 0.2 MB instead of 1.4.
Source: `chain_solve`, term by term.
Symbols: as in `chain_solve`; T, W, V, V3 from `native.lane_types`.
"""

from warpfiber.passes.native import LANES

# Of a step: behind pace, h and the group g.
NUMBERS = """
    const V h_force = pace * h, kappa = h_force * (g.bending / (g.rest * g.rest));
    const V compliance = V(g.compliance) / h_force, kappa2 = kappa * kappa;
    const T end = (g.spacing + T(1)) * (T(2) * g.spacing + T(1)) / (T(6) * g.spacing);
    const T drag_end = g.drag * end, drag_inner = g.drag * (T(2) * end - T(1));
    const V drag_off = V(g.drag * g.coupling);
    auto sym = [](const V3& d, const V3& o, const V3& v) -> V3 {
        return V3{d.x * v.x + o.x * v.y + o.y * v.z, o.x * v.x + d.y * v.y + o.z * v.z,
                  o.y * v.x + o.z * v.y + d.z * v.z};
    };
"""
# Before the first node.
BEGIN = """
        V3 n_before = nothing, pd1 = nothing, po1 = nothing, q1 = nothing, pd2 = nothing;
        V3 po2 = nothing, l0 = nothing, l1 = nothing, l2 = nothing, t1 = nothing;
        V rho_before = none, s1 = none;
"""
# Of node k, the segment behind it being n, rho: inverse block pd, po, q, s and lower rows l0 .. lt.
NODE = """
            const V drag = V(k == 0 || k == segments ? drag_end : drag_inner);
            const T below = (k >= 2 ? T(-2) : T(0)) + (k >= 1 && k < segments ? T(-2) : T(0));
            const T bend = (k >= 2 ? T(1) : T(0)) + (k >= 1 && k < segments ? T(4) : T(0))
                + (k + 2 <= segments ? T(1) : T(0));
            const V off = drag_off + kappa * below - rho_before;
            const V3 u = n_before * rho_before;
            const V3 w_0 = V3{off + u.x * n_before.x - kappa * l0.x,
                u.x * n_before.y - kappa * l1.x, u.x * n_before.z - kappa * l2.x};
            const V3 w_1 = V3{u.y * n_before.x - kappa * l0.y,
                off + u.y * n_before.y - kappa * l1.y, u.y * n_before.z - kappa * l2.y};
            const V3 w_2 = V3{u.z * n_before.x - kappa * l0.z,
                u.z * n_before.y - kappa * l1.z, off + u.z * n_before.z - kappa * l2.z};
            const V3 wt = t1 * kappa, t = sym(pd1, po1, n_before);
            l0 = sym(pd1, po1, w_0) + q1 * wt.x;
            l1 = sym(pd1, po1, w_1) + q1 * wt.y;
            l2 = sym(pd1, po1, w_2) + q1 * wt.z;
            const V3 lt = V3{w_0.dot(q1), w_1.dot(q1), w_2.dot(q1)} + wt * s1;

            const V alpha = drag + kappa * bend + rho_before + rho;
            const V3 d = V3{
                alpha - u.x * n_before.x - rho * n.x * n.x - l0.dot(w_0) - lt.x * wt.x,
                alpha - u.y * n_before.y - rho * n.y * n.y - l1.dot(w_1) - lt.y * wt.y,
                alpha - u.z * n_before.z - rho * n.z * n.z - l2.dot(w_2) - lt.z * wt.z}
                - pd2 * kappa2;
            const V3 o = V3{
                none - u.x * n_before.y - rho * n.x * n.y - l0.dot(w_1) - lt.x * wt.y,
                none - u.x * n_before.z - rho * n.x * n.z - l0.dot(w_2) - lt.x * wt.z,
                none - u.y * n_before.z - rho * n.y * n.z - l1.dot(w_2) - lt.y * wt.z}
                - po2 * kappa2;
            const V3 along = n_before + V3{l0.dot(n_before), l1.dot(n_before), l2.dot(n_before)};
            const V slack = k > 0 ? compliance + n_before.dot(t) : one;

            // inverse of [[A, along], [along^T, -slack]], as `block_inverse`
            const V xx = d.y * d.z - o.z * o.z, yy = d.x * d.z - o.y * o.y;
            const V zz = d.x * d.y - o.x * o.x, xy = o.y * o.z - o.x * d.z;
            const V xz = o.x * o.z - o.y * d.y, yz = o.x * o.y - d.x * o.z;
            const V det = d.x * xx + o.x * xy + o.y * xz;
            const V3 adj = sym(V3{xx, yy, zz}, V3{xy, xz, yz}, along);
            const V whole = slack * det + along.dot(adj);
            const V inverse_det = one / det, inverse_whole = one / whole;
            const V3 q = adj * inverse_whole;
            const V3 pd = V3{xx - adj.x * q.x, yy - adj.y * q.y, zz - adj.z * q.z} * inverse_det;
            const V3 po = V3{xy - adj.x * q.y, xz - adj.x * q.z, yz - adj.y * q.z} * inverse_det;
            const V s = none - det * inverse_whole;
"""
# To the next node.
NEXT = """
            pd2 = pd1;
            po2 = po1;
            pd1 = pd;
            po1 = po;
            q1 = q;
            s1 = s;
            t1 = t;
            n_before = n;
            rho_before = rho;
"""
FACTOR_TEXTS = {
    "FACTOR_NUMBERS": NUMBERS,
    "FACTOR_BEGIN": BEGIN,
    "FACTOR_NODE": NODE,
    "FACTOR_NEXT": NEXT,
}


def axes_stride(name: str, nodes: int) -> int:
    """Numbers of a fiber of so many nodes: axis and rho of every node, whole vectors."""
    lanes = LANES[name]
    return -(-4 * nodes // lanes) * lanes
