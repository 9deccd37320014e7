"""C++ text that SIMD blocks share: vector types, a transpose in registers, three-vectors of lanes.

A SIMD block is a `wp.func_native`, for the CPU only: clang vector types with plain arithmetic, one
lane per item, no intrinsics. Every block repeats laws that stay in Warp and is tested against them.
"""

from warpfiber.model import precision

# From so many nodes on they do not stay in a cache. What comes is asked for into the second cache:
# the first one waits on few lines at a time and stands still when more are asked for. Measured with
# 1,000,000 segments, ns per segment, pairs and nodes: 30 and 28 unasked, 19 and 23 into the first
# cache, 10 and 18 into the second (6 and 12 with 20,000). With that fibers sorted by place (9, 20),
# large pages (9, 19), and both sweeps in one along the fibers gain nothing more; fibers numbered in
# no order take 14 and 23.
PREFETCH_NODES = 100_000
# The same for several workers: half of what one of them reads was last written by another, on some
# machines 170 ns away. Alone, pairs that stay in a cache would take an eighth longer so.
PREFETCH_SHARED = 1_000
LANES = {"float32": 16, "float64": 8}  # 64 bytes


def lane_types(name: str, lanes: int | None = None) -> str:
    """Real T, vector V of W lanes, U the same at any address, mask M, vector triple V3."""
    real = {"float32": "float", "float64": "double"}[precision(name).name]
    return f"""
    using T = {real};
    constexpr int W = {lanes or LANES[name]};
    typedef T V __attribute__((ext_vector_type(W)));
    typedef T U __attribute__((ext_vector_type(W), aligned(sizeof(T))));
    typedef decltype(V() < V()) M;
    struct V3 {{
        V x, y, z;
        V3 operator+(const V3& b) const {{ return {{x + b.x, y + b.y, z + b.z}}; }}
        V3 operator-(const V3& b) const {{ return {{x - b.x, y - b.y, z - b.z}}; }}
        V3 operator*(V s) const {{ return {{x * s, y * s, z * s}}; }}
        V dot(const V3& b) const {{ return x * b.x + y * b.y + z * b.z; }}
        V3 cross(const V3& b) const {{
            return {{y * b.z - z * b.y, z * b.x - x * b.z, x * b.y - y * b.x}};
        }}
    }};
    auto same3 = [](T x, T y, T z) -> V3 {{ return V3{{V(x), V(y), V(z)}}; }};
    auto any = [](M m) -> bool {{ return __builtin_reduce_or(m) != 0; }};
"""


def transpose(lanes: int, rows: str = "r", kind: str = "V") -> str:
    """Statements that transpose the square `rows[lanes]` of vectors in place, log2(lanes) stages.

    A stage with distance h swaps the off-diagonal h x h parts of every 2h x 2h part.
    """
    lines = []
    distance = 1
    while distance < lanes:
        for i in range(lanes):
            if i & distance:
                continue
            low = [n if not n & distance else lanes + n - distance for n in range(lanes)]
            high = [n + distance if not n & distance else lanes + n for n in range(lanes)]
            a, b = f"{rows}[{i}]", f"{rows}[{i + distance}]"
            lines.append(
                f"{{ {kind} a = {a}, b = {b};"
                f" {a} = __builtin_shufflevector(a, b, {', '.join(map(str, low))});"
                f" {b} = __builtin_shufflevector(a, b, {', '.join(map(str, high))}); }}"
            )
        distance *= 2
    return "\n".join(lines)


# Between arrays of c numbers per node, fibers anywhere, and c vectors per node: squares of W
# numbers of W fibers. The last square of a fiber overlaps the one before.
def transfers(kind: str, lanes: int) -> str:
    """`load_V` and `store_V` of vectors of this kind, for the `first` nodes of `own` fibers."""
    turn = transpose(lanes, kind=kind)
    return f"""
    auto load_{kind} = [&](int c, {kind}* to, const auto* from) __attribute__((noinline)) {{
        const int size = c * nodes;
        decltype(from) row[W];
        #pragma unroll
        for (int l = 0; l < W; ++l) row[l] = from + (long)c * first[l];
        for (int next = 0; next < size; next += W) {{
            const int at = next < size - W ? next : size - W;
            {kind} r[W];
            #pragma unroll
            for (int l = 0; l < W; ++l) __builtin_memcpy(&r[l], row[l] + at, sizeof({kind}));
            {turn}
            #pragma unroll
            for (int l = 0; l < W; ++l) to[at + l] = r[l];
        }}
    }};
    auto store_{kind} = [&](int c, auto* to, const {kind}* from) __attribute__((noinline)) {{
        const int size = c * nodes;
        decltype(to) row[W];
        #pragma unroll
        for (int l = 0; l < W; ++l) row[l] = to + (long)c * first[l];
        const bool all = own == W;
        for (int next = 0; next < size; next += W) {{
            const int at = next < size - W ? next : size - W;
            {kind} r[W];
            #pragma unroll
            for (int l = 0; l < W; ++l) r[l] = from[at + l];
            {turn}
            #pragma unroll
            for (int l = 0; l < W; ++l)
                if (all || l < own) __builtin_memcpy(row[l] + at, &r[l], sizeof({kind}));
        }}
    }};
"""
