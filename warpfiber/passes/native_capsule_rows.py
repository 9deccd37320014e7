"""C++ text that brings numbers of many places in arrays into lanes, and back (`native_capsules`).

A row has the numbers of one place as they lie in memory; vectors have one number of all lanes. Rows
are transposed by eight in registers. Also the closest points of segments, in the order of
operations of `segment_distance`.
"""

from warpfiber.passes.native import transpose
from warpfiber.passes.pairs import IMAGE_BITS


def image_constants() -> dict[str, int]:
    """How images of pairs are packed."""
    half = 1 << (IMAGE_BITS - 1)
    return {"BITS": IMAGE_BITS, "MASK": 2 * half - 1, "HALF": half}


_ROWS = """
    typedef double P4 __attribute__((ext_vector_type(4)));
    typedef T T4 __attribute__((ext_vector_type(4)));
    // of a node and the next one, from two overlapping loads; the fourth numbers mean nothing
    auto two_rows = [](const auto* from, long node, auto& row, auto& next) {
        __builtin_memcpy(&row, from + 3 * node, sizeof(row));
        __builtin_memcpy(&next, from + 3 * node + 2, sizeof(next));
        next = __builtin_shufflevector(next, next, 1, 2, 3, 3);
    };
    typedef T T8 __attribute__((ext_vector_type(8)));
    auto eight = [](const auto* r, auto& x, auto& y, auto& z) {
        auto lo0 = __builtin_shufflevector(r[0], r[1], 0, 4, 1, 5);
        auto hi0 = __builtin_shufflevector(r[0], r[1], 2, 6, 3, 7);
        auto lo1 = __builtin_shufflevector(r[2], r[3], 0, 4, 1, 5);
        auto hi1 = __builtin_shufflevector(r[2], r[3], 2, 6, 3, 7);
        auto lo2 = __builtin_shufflevector(r[4], r[5], 0, 4, 1, 5);
        auto hi2 = __builtin_shufflevector(r[4], r[5], 2, 6, 3, 7);
        auto lo3 = __builtin_shufflevector(r[6], r[7], 0, 4, 1, 5);
        auto hi3 = __builtin_shufflevector(r[6], r[7], 2, 6, 3, 7);
        auto lo = __builtin_shufflevector(lo0, lo1, 0, 1, 4, 5, 2, 3, 6, 7);
        auto up = __builtin_shufflevector(lo2, lo3, 0, 1, 4, 5, 2, 3, 6, 7);
        auto z0 = __builtin_shufflevector(hi0, hi1, 0, 1, 4, 5);
        auto z1 = __builtin_shufflevector(hi2, hi3, 0, 1, 4, 5);
        x = __builtin_shufflevector(lo, up, 0, 1, 2, 3, 8, 9, 10, 11);
        y = __builtin_shufflevector(lo, up, 4, 5, 6, 7, 12, 13, 14, 15);
        z = __builtin_shufflevector(z0, z1, 0, 1, 2, 3, 4, 5, 6, 7);
    };
    // of the rows of all lanes, straight from registers: what was stored in halves of a register
    // cannot be loaded as a whole one before it is in the cache
    auto turn = [&](auto row) -> V3 {
        V3 out;
        #pragma unroll
        for (int h = 0; h < W / 8; ++h) {
            decltype(row(0)) r[8];
            #pragma unroll
            for (int l = 0; l < 8; ++l) r[l] = row(8 * h + l);
            auto x = __builtin_shufflevector(r[0], r[0], 0, 0, 0, 0, 0, 0, 0, 0);
            auto y = x, z = x;
            eight(r, x, y, z);
            ((T8*)&out.x)[h] = __builtin_convertvector(x, T8);
            ((T8*)&out.y)[h] = __builtin_convertvector(y, T8);
            ((T8*)&out.z)[h] = __builtin_convertvector(z, T8);
        }
        return out;
    };
    // eight numbers of every lane as a row of each
    auto turn_back = [](const V* numbers, T8* rows) {
        for (int h = 0; h < W / 8; ++h) {
            T8 r[8];
            for (int c = 0; c < 8; ++c) r[c] = ((const T8*)(numbers + c))[h];
            TRANSPOSE
            for (int l = 0; l < 8; ++l) rows[8 * h + l] = r[l];
        }
    };
    typedef int I __attribute__((ext_vector_type(W)));
    auto add_images = [&](I code, V3& delta) {
        if constexpr (IS_PERIODIC) {
            auto number = [&](int bits) -> V {
                return __builtin_convertvector(((code >> bits) & MASK) - HALF, V);
            };
            const V n0 = number(0), n1 = number(BITS), n2 = number(2 * BITS);
            const auto& L = lattice[0].data;
            delta.x += L[0][0] * n0 + L[0][1] * n1 + L[0][2] * n2;
            delta.y += L[1][0] * n0 + L[1][1] * n1 + L[1][2] * n2;
            delta.z += L[2][0] * n0 + L[2][1] * n1 + L[2][2] * n2;
        }
    };
"""


# Distance vector and closest points of pairs of segments that begin at nodes, products of their
# edges.
DISTANCE = """
    auto edges = [&](const int* node_i, const int* node_j, V3& a, V3& b, V3& delta) {
        const double* const x = (const double*)place;
        auto edge = [&](int node) -> P4 {
            P4 start, end;
            two_rows(x, node, start, end);
            return end - start;
        };
        auto start = [&](int node) -> P4 {
            P4 row;
            __builtin_memcpy(&row, x + 3L * node, sizeof(P4));
            return row;
        };
        a = turn([&](int l) -> P4 { return edge(node_i[l]); });
        b = turn([&](int l) -> P4 { return edge(node_j[l]); });
        delta = turn([&](int l) -> P4 { return start(node_j[l]) - start(node_i[l]); });
    };
    auto closest = [&](I images, const int* node_i, const int* node_j, V& s, V& t,
                       V& aa, V& bb, V& ab) -> V3 {
        V3 a, b, delta;
        edges(node_i, node_j, a, b, delta);
        add_images(images, delta);
        aa = larger(a.dot(a), V(TINY));
        bb = larger(b.dot(b), V(TINY));
        ab = a.dot(b);
        const V da = delta.dot(a), db = delta.dot(b);
        const V both = aa * bb, den = larger(both - ab * ab, EPS * both);
        const V in_all = T(1) / (both * den);
        s = clamp01((da * bb - db * ab) * (both * in_all));
        t = clamp01((s * ab - db) * (aa * den * in_all));
        s = clamp01((t * ab + da) * (bb * den * in_all));
        return delta + b * t - a * s;
    };
"""


def row_source() -> str:
    """Rows, their transposes, and the shifts of images."""
    return _ROWS.replace("TRANSPOSE", transpose(8, kind="T8"))
