"""Geometry of many listed pairs at a time, as C++ text: what the blocks over pairs share.

Source: closest points as in `row_geometry.make_closest_points`.
Symbols: D, a, b of a pair at the start of a step, w, wa, wb their motion, an image with its box
    vector at both times.
"""

from warpfiber.passes.native import lane_types
from warpfiber.passes.pairs import IMAGE_BITS, NO_IMAGE
from warpfiber.passes.row_geometry import PARALLEL

# Rows (x, y, z, unused) of a pair as they lie in memory, then transposed to a vector per component;
# the second node of a segment is read from its end, so that nothing behind the last is touched.
ROWS = """
    typedef T R __attribute__((ext_vector_type(4)));
    auto load = [](const T* p) -> R { R r; __builtin_memcpy(&r, p, sizeof(r)); return r; };
    auto transposed = [](const R* m) -> V3 {
        V3 p;
        for (int q = 0; q < W; q += 4) {
            const R lo0 = __builtin_shufflevector(m[q], m[q + 1], 0, 4, 2, 6);
            const R hi0 = __builtin_shufflevector(m[q], m[q + 1], 1, 5, 3, 7);
            const R lo1 = __builtin_shufflevector(m[q + 2], m[q + 3], 0, 4, 2, 6);
            const R hi1 = __builtin_shufflevector(m[q + 2], m[q + 3], 1, 5, 3, 7);
            const R x = __builtin_shufflevector(lo0, lo1, 0, 1, 4, 5);
            const R y = __builtin_shufflevector(hi0, hi1, 0, 1, 4, 5);
            const R z = __builtin_shufflevector(lo0, lo1, 2, 3, 6, 7);
            __builtin_memcpy((T*)&p.x + q, &x, sizeof(x));
            __builtin_memcpy((T*)&p.y + q, &y, sizeof(y));
            __builtin_memcpy((T*)&p.z + q, &z, sizeof(z));
        }
        return p;
    };
    auto larger = [](V u, V v) -> V { return u > v ? u : v; };
"""
PAIRS = """
    auto clipped = [](V u) -> V {
        u = u > V(T(0)) ? u : V(T(0));
        return u < V(T(1)) ? u : V(T(1));
    };
    auto box = [&](const auto& lattice, int code) -> R {
        const T x = T((code & MASK) - HALF), y = T(((code >> BITS) & MASK) - HALF);
        const T z = T(((code >> (2 * BITS)) & MASK) - HALF);
        const auto& m = lattice.data[0];
        R r = R(T(0));
        for (int c = 0; c < 3; ++c) r[c] = m.data[c][0] * x + m.data[c][1] * y + m.data[c][2] * z;
        return r;
    };
    const T* const back = (const T*)node_back.data;
    const T* const now = (const T*)node_pos.data;
    // D, a, b at the start, w, wa, wb, of pairs anywhere in the list
    struct Motion { V3 d, a, b, w, wa, wb; };
    auto motion_of = [&](const int* pairs) -> Motion {
        R ra[W], rb[W], rd[W], rw[W], rwa[W], rwb[W];
        for (int l = 0; l < W; ++l) {
            const int pair = pairs[l];
            const long long i = 3ll * segment_node.data[pair_i.data[pair]];
            const long long j = 3ll * segment_node.data[pair_j.data[pair]];
            const R xi = load(back + i), xj = load(back + j);
            const R xi1 = load(back + i + 2).yzww, xj1 = load(back + j + 2).yzww;
            const R mi = load(now + i) - xi, mj = load(now + j) - xj;
            ra[l] = xi1 - xi;
            rb[l] = xj1 - xj;
            rd[l] = xj - xi;
            rw[l] = mj - mi;
            rwa[l] = load(now + i + 2).yzww - xi1 - mi;
            rwb[l] = load(now + j + 2).yzww - xj1 - mj;
            const int code = pair_image.data[pair];
            if (PERIODIC && code != NONE) {
                const R shift = box(lattice_back, code);
                rd[l] += shift;
                rw[l] += box(lattice_now, code) - shift;
            }
        }
        return Motion{transposed(rd), transposed(ra), transposed(rb),
                      transposed(rw), transposed(rwa), transposed(rwb)};
    };
    const V least = V(T(1e-30));
    struct Place { V s, t; };
    auto closest = [&](const Motion& m, V aa, V bb) -> Place {
        const V3 n = m.a.cross(m.b);
        const V area2 = n.dot(n), ab = m.a.dot(m.b);
        V s = clipped(m.d.cross(m.b).dot(n) / larger(area2, least));
        s = area2 >= T(PARALLEL) * aa * bb ? s : V(T(0.5));
        const V t = clipped((s * ab - m.d.dot(m.b)) / bb);
        return Place{clipped((t * ab + m.d.dot(m.a)) / aa), t};
    };
"""


def row_lanes(name: str) -> str:
    """Types, and `load` and `transposed` of rows of three numbers."""
    return lane_types(name) + ROWS


def pair_lanes(name: str, periodic: bool) -> str:
    """`motion_of(pairs)`, `closest(motion, a.a, b.b)`: of W pairs anywhere in the list."""
    text = PAIRS
    for key, value in {
        "MASK": (1 << IMAGE_BITS) - 1,
        "HALF": 1 << (IMAGE_BITS - 1),
        "BITS": IMAGE_BITS,
        "PERIODIC": str(periodic).lower(),
        "NONE": NO_IMAGE,
        "PARALLEL": repr(PARALLEL),
    }.items():
        text = text.replace(key, str(value))
    return row_lanes(name) + text
