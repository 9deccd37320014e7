"""C++ text of the SIMD sweep over listed pairs of bonded spheres (`native_capsules`).

Distances of eight listed pairs at a time; pairs within reach are collected and have the law of
contact eight at a time, normal (`native_capsule_law`) and tangential as in `capsule_pairs` and
`friction`. A memory that must be handed over is looked for pair by pair: that is rare.
Symbols: as in `capsule_pairs`; T real, V vector of T, k places in the list.
"""

from warpfiber.laws.hertz import DASHPOT
from warpfiber.model import HALT, PAIR_COUNT, precision
from warpfiber.passes.capsule_pairs import CapsuleFeatures
from warpfiber.passes.native import lane_types, transpose
from warpfiber.passes.native_capsule_law import NORMAL, POWERS, contact_constants
from warpfiber.passes.pairs import IMAGE_BITS, NO_IMAGE

LANES = 8  # pairs, and fibers of `native_bonds`, in both precisions
PARTS = 2  # of the list; as many workers share a sweep
LINE = 8  # numbers per node and part: force, moment, two unused


def _constants(name: str, features: CapsuleFeatures) -> str:
    """Features and numbers that are fixed when the sweep is compiled."""
    flags = {
        "IS_PERIODIC": features.periodic,
        "HAS_DASHPOT": features.dashpot,
        "HAS_FRICTION": features.friction,
    }
    lines = [f"constexpr bool {key} = {str(value).lower()};" for key, value in flags.items()]
    lines.append(f"constexpr T DASHPOT = T({DASHPOT!r}), EPS = T({precision(name).eps!r});")
    numbers = {
        "PARTS": PARTS,
        "LINE": LINE,
        "SLOT_HALT": HALT,
        "SLOT_COUNT": PAIR_COUNT,
        "NO_IMAGE": NO_IMAGE,
        "BITS": IMAGE_BITS,
        "MASK": (1 << IMAGE_BITS) - 1,
        "HALF": 1 << (IMAGE_BITS - 1),
    }
    lines += [f"constexpr int {key} = {value};" for key, value in numbers.items()]
    return "\n".join(lines)


# Three numbers of eight places in an array, as three vectors.
_ROWS = """
    typedef double P __attribute__((ext_vector_type(W)));
    typedef double P4 __attribute__((ext_vector_type(4)));
    typedef T T4 __attribute__((ext_vector_type(4)));
    struct P3 { P x, y, z; };
    auto place_row = [&](long node) -> P4 {
        const double* x = (const double*)place + 3 * node;
        return P4{x[0], x[1], x[2], x[2]};
    };
    auto real_row = [](const T* from, long at) -> T4 {
        const T* x = from + 3 * at;
        return T4{x[0], x[1], x[2], x[2]};
    };
    #define TURN(X3, r) \\
        auto lo0 = __builtin_shufflevector(r[0], r[1], 0, 4, 1, 5); \\
        auto hi0 = __builtin_shufflevector(r[0], r[1], 2, 6, 3, 7); \\
        auto lo1 = __builtin_shufflevector(r[2], r[3], 0, 4, 1, 5); \\
        auto hi1 = __builtin_shufflevector(r[2], r[3], 2, 6, 3, 7); \\
        auto lo2 = __builtin_shufflevector(r[4], r[5], 0, 4, 1, 5); \\
        auto hi2 = __builtin_shufflevector(r[4], r[5], 2, 6, 3, 7); \\
        auto lo3 = __builtin_shufflevector(r[6], r[7], 0, 4, 1, 5); \\
        auto hi3 = __builtin_shufflevector(r[6], r[7], 2, 6, 3, 7); \\
        auto lo = __builtin_shufflevector(lo0, lo1, 0, 1, 4, 5, 2, 3, 6, 7); \\
        auto up = __builtin_shufflevector(lo2, lo3, 0, 1, 4, 5, 2, 3, 6, 7); \\
        auto z0 = __builtin_shufflevector(hi0, hi1, 0, 1, 4, 5); \\
        auto z1 = __builtin_shufflevector(hi2, hi3, 0, 1, 4, 5); \\
        return X3{ \\
            __builtin_shufflevector(lo, up, 0, 1, 2, 3, 8, 9, 10, 11), \\
            __builtin_shufflevector(lo, up, 4, 5, 6, 7, 12, 13, 14, 15), \\
            __builtin_shufflevector(z0, z1, 0, 1, 2, 3, 4, 5, 6, 7)};
    auto turn_V = [](const T4* r) -> V3 { TURN(V3, r) };
    auto turn_P = [](const P4* r) -> P3 { TURN(P3, r) };
    #undef TURN
    auto narrow = [&](const P4* rows) -> V3 {
        const P3 u = turn_P(rows);
        return V3{
            __builtin_convertvector(u.x, V), __builtin_convertvector(u.y, V),
            __builtin_convertvector(u.z, V)};
    };
    typedef int I __attribute__((ext_vector_type(W)));
    auto add_images = [&](const int* ks, V3& delta) {
        if constexpr (IS_PERIODIC) {
            I code;
            for (int l = 0; l < W; ++l) ((int*)&code)[l] = pair_image[ks[l]];
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

# What a pair that begins to act takes over (`contact_memory.neighbors_memory`).
_HAND_OVER = """
    const int now = (int)step[0], last = now - 1;
    T* const kept_now = (T*)pair_memory + 4L * kept_size * (now & 1);
    const T* const kept_last = (const T*)pair_memory + 4L * kept_size * (last & 1);
    int* const written_now = pair_step + (long)kept_size * (now & 1);
    const int* const written_last = pair_step + (long)kept_size * (last & 1);
    auto memory_of = [&](int i, int j, int image) -> int {
        for (int k = out_start[i]; k < out_start[i + 1]; ++k)
            if (pair_j[k] == j && pair_image[k] == image && written_last[k] == last) return k;
        return -1;
    };
    auto neighbors_memory = [&](int k, int on_i, int on_j, T far_i, T far_j) -> int {
        const int i = pair_i[k], j = pair_j[k], image = pair_image[k];
        for (int turn = 0; turn < 3; ++turn) {
            int p = on_i, q = on_j;
            if (turn < 2) {
                if ((turn == 0) == (far_i <= far_j)) q = j;
                else p = i;
            }
            if (p == i && q == j) continue;
            const int found = memory_of(p, q, image);
            if (found >= 0 && kept_last[4L * found + 3] != T(0)) return found;
        }
        return -1;
    };
"""

# Eight pairs within reach, of which the first `count` count.
_LAW = """
    auto law = [&](const int* ks, const T* ss, const T* ts, int count) __attribute__((noinline)) {
        P4 rows_a[W], rows_b[W], rows_d[W], rows_bi[W], rows_ai[W], rows_bj[W], rows_aj[W];
        int node_i[W], node_j[W];
        T numbers[14][W];
        for (int l = 0; l < W; ++l) {
            const int i = pair_i[ks[l]], j = pair_j[ks[l]];
            node_i[l] = segment_node[i];
            node_j[l] = segment_node[j];
            const int fiber_i = segment_fiber[i], fiber_j = segment_fiber[j];
            const auto& gi = groups[fiber_group[fiber_i]];
            const auto& gj = groups[fiber_group[fiber_j]];
            const int at_i = node_i[l] - fiber_node_start[fiber_i];
            const int at_j = node_j[l] - fiber_node_start[fiber_j];
            const bool first_i = at_i == 0, last_i = at_i == gi.segments - 1;
            const bool first_j = at_j == 0, last_j = at_j == gj.segments - 1;
            const P4 xi = place_row(node_i[l]), xi1 = place_row(node_i[l] + 1);
            const P4 xj = place_row(node_j[l]), xj1 = place_row(node_j[l] + 1);
            rows_a[l] = xi1 - xi;
            rows_b[l] = xj1 - xj;
            rows_d[l] = xj - xi;
            rows_bi[l] = xi - place_row(node_i[l] - !first_i);
            rows_ai[l] = place_row(node_i[l] + 1 + !last_i) - xi1;
            rows_bj[l] = xj - place_row(node_j[l] - !first_j);
            rows_aj[l] = place_row(node_j[l] + 1 + !last_j) - xj1;
            numbers[0][l] = T(first_i);
            numbers[1][l] = T(last_i);
            numbers[2][l] = T(first_j);
            numbers[3][l] = T(last_j);
            numbers[4][l] = gi.radius;
            numbers[5][l] = gj.radius;
            numbers[6][l] = gi.compliance;
            numbers[7][l] = gj.compliance;
            numbers[8][l] = gi.shear_compliance + gj.shear_compliance;
            numbers[9][l] = first_i && !gi.closed ? gi.end_mass : gi.mass;
            numbers[10][l] = last_i && !gi.closed ? gi.end_mass : gi.mass;
            numbers[11][l] = first_j && !gj.closed ? gj.end_mass : gj.mass;
            numbers[12][l] = last_j && !gj.closed ? gj.end_mass : gj.mass;
        }
        auto number = [&](int n) -> V {
            V v;
            __builtin_memcpy(&v, numbers[n], sizeof(V));
            return v;
        };
        const V3 a = narrow(rows_a), b = narrow(rows_b);
        V3 delta = narrow(rows_d);
        add_images(ks, delta);
        const V3 back_i = narrow(rows_bi), ahead_i = narrow(rows_ai);
        const V3 back_j = narrow(rows_bj), ahead_j = narrow(rows_aj);
        const M tip0_i = number(0) > T(0), tip1_i = number(1) > T(0);
        const M tip0_j = number(2) > T(0), tip1_j = number(3) > T(0);
        const V radius_i = number(4), radius_j = number(5);
        const V compliance_i = number(6), compliance_j = number(7);
        V s, t;
        __builtin_memcpy(&s, ss, sizeof(V));
        __builtin_memcpy(&t, ts, sizeof(V));
        NORMAL
        const M acts = force > T(0);
        typedef bool B __attribute__((ext_vector_type(W)));
        const B bits = __builtin_convertvector(acts, B);
        const unsigned mine = __builtin_bit_cast(unsigned char, bits) & ((1u << count) - 1u);
        if (mine == 0) return;

        const V3 c = delta + b * t - a * s;
        const V distance = root(c.dot(c));
        const V3 n = c * (T(1) / distance);
        const V arm_i = T(0.5) * (distance + radius_i - radius_j), arm_j = distance - arm_i;
        V size = force;
        V3 drag = same3(0, 0, 0);
        T h_out[4][W];
        if constexpr (HAS_DASHPOT || HAS_FRICTION) {
            T4 r[W];
            auto between = [&](const T* of, const int* node, V part) -> V3 {
                for (int l = 0; l < W; ++l) r[l] = real_row(of, node[l]);
                const V3 start = turn_V(r);
                for (int l = 0; l < W; ++l) r[l] = real_row(of, node[l] + 1);
                return start * (T(1) - part) + turn_V(r) * part;
            };
            const V3 vi = between((const T*)node_velocity, node_i, s);
            const V3 vj = between((const T*)node_velocity, node_j, t);
            const V3 wi = between((const T*)node_spin, node_i, s);
            const V3 wj = between((const T*)node_spin, node_j, t);
            const V3 slip = vi - vj + (wi * arm_i + wj * arm_j).cross(n);
            const V approach = slip.dot(n);
            const V rest_s = T(1) - s, rest_t = T(1) - t;
            const V mass = T(1) / (rest_s * rest_s / number(9) + s * s / number(10)
                + rest_t * rest_t / number(11) + t * t / number(12));
            if constexpr (HAS_DASHPOT) {
                const V resistance = DASHPOT * beta * root(stiffness * mass);
                size = larger(size + resistance * approach, V(T(0)));
            }
            if constexpr (HAS_FRICTION) {
                const V k = T(4) * (compliance_i + compliance_j) / number(8) * stiffness;
                const V3 slide = slip - n * approach;
                const V turn = T(0.5) * dt * (wi + wj).dot(n);
                const V far_i = la * smaller(s, rest_s), far_j = lb * smaller(t, rest_t);
                T kept[4][W];
                __builtin_memset(kept, 0, sizeof(kept));
                for (unsigned left = mine; left != 0; left &= left - 1) {
                    const int l = __builtin_ctz(left);
                    int from = ks[l];
                    if (__builtin_expect(written_last[from] != last, 0)) {
                        const int i = pair_i[from], j = pair_j[from];
                        const T s_l = ((const T*)&s)[l], t_l = ((const T*)&t)[l];
                        const int to_i = s_l < T(0.5) ? -(numbers[0][l] == T(0))
                                                      : (numbers[1][l] == T(0));
                        const int to_j = t_l < T(0.5) ? -(numbers[2][l] == T(0))
                                                      : (numbers[3][l] == T(0));
                        from = neighbors_memory(
                            from, i + to_i, j + to_j, ((const T*)&far_i)[l], ((const T*)&far_j)[l]);
                        if (from < 0) continue;
                    }
                    for (int m = 0; m < 4; ++m) kept[m][l] = kept_last[4L * from + m];
                }
                auto of = [](const T* from) -> V {
                    V v;
                    __builtin_memcpy(&v, from, sizeof(V));
                    return v;
                };
                const V3 h = {of(kept[0]), of(kept[1]), of(kept[2])};
                const V before = of(kept[3]);
                V3 flat = h - n * h.dot(n);
                flat = flat + n.cross(flat) * turn;
                V scale = root(h.dot(h)) / larger(root(flat.dot(flat)), V(TINY));
                scale = depth > before ? scale * root(before / depth) : scale;
                scale = before > T(0) ? scale : V(T(0));
                V3 path = flat * scale + slide * dt;
                const V resistance = DASHPOT * beta * root(k * mass);
                drag = nothing3 - path * k - slide * resistance;
                const V whole = root(drag.dot(drag)), limit = friction * size;
                const M slides = whole > limit;
                const V part = slides ? limit / larger(whole, V(TINY)) : V(T(1));
                drag = drag * part;
                const V back = T(-1) / k;
                path = V3{slides ? drag.x * back : path.x, slides ? drag.y * back : path.y,
                          slides ? drag.z * back : path.z};
                __builtin_memcpy(h_out[0], &path.x, sizeof(V));
                __builtin_memcpy(h_out[1], &path.y, sizeof(V));
                __builtin_memcpy(h_out[2], &path.z, sizeof(V));
                __builtin_memcpy(h_out[3], &depth, sizeof(V));
            }
        }
        const V3 whole = drag - n * size;
        const V3 moment = n.cross(whole);
        V on_i[W] = {
            whole.x, whole.y, whole.z, moment.x * arm_i, moment.y * arm_i, moment.z * arm_i};
        V on_j[W] = {
            -whole.x, -whole.y, -whole.z, moment.x * arm_j, moment.y * arm_j, moment.z * arm_j};
        on_i[6] = on_i[7] = on_j[6] = on_j[7] = V(T(0));
        TURN_I
        TURN_J
        for (unsigned left = mine; left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            auto add = [&](int node, V values) {
                U* to = (U*)(load + (long)LINE * node);
                *to += values;
            };
            const T s_l = ((const T*)&s)[l], t_l = ((const T*)&t)[l];
            add(node_i[l], on_i[l] * (T(1) - s_l));
            add(node_i[l] + 1, on_i[l] * s_l);
            add(node_j[l], on_j[l] * (T(1) - t_l));
            add(node_j[l] + 1, on_j[l] * t_l);
            const long k = ks[l];
            pair_acts[k] = 1;
            if constexpr (HAS_FRICTION) {
                for (int p = 0; p < 4; ++p) kept_now[4 * k + p] = h_out[p][l];
                written_now[k] = now;
            }
            if (keeps) {
                T* f = (T*)pair_force + 3 * k;
                T* m = (T*)pair_moment + 3 * k;
                T* arms = (T*)pair_arms + 4 * k;
                for (int c = 0; c < 3; ++c) {
                    f[c] = ((const T*)(&whole.x + c))[l];
                    m[c] = ((const T*)(&moment.x + c))[l];
                }
                arms[0] = s_l;
                arms[1] = t_l;
                arms[2] = ((const T*)&arm_i)[l];
                arms[3] = ((const T*)&arm_j)[l];
            }
        }
    };
"""

_SWEEP = """
    const int total = status[SLOT_COUNT];
    const int begin = (int)((long)total * part / PARTS);
    const int end = (int)((long)total * (part + 1) / PARTS);
    if (begin == end) return;
    constexpr int ROOM = 2 * W;
    int hit_k[ROOM], hits = 0;
    T hit_s[ROOM], hit_t[ROOM];
    __builtin_memset(pair_acts + begin, 0, end - begin);
    P4 rows_a[W], rows_b[W], rows_d[W];
    for (int first = begin; first < end; first += W) {
        const int count = end - first < W ? end - first : W;
        int ks[W];
        for (int l = 0; l < W; ++l) {
            const int k = ks[l] = first + (l < count ? l : count - 1);
            const int node_i = segment_node[pair_i[k]], node_j = segment_node[pair_j[k]];
            const P4 xi = place_row(node_i), xj = place_row(node_j);
            rows_a[l] = place_row(node_i + 1) - xi;
            rows_b[l] = place_row(node_j + 1) - xj;
            rows_d[l] = xj - xi;
        }
        const V3 a = narrow(rows_a), b = narrow(rows_b);
        V3 delta = narrow(rows_d);
        add_images(ks, delta);
        const V aa = larger(a.dot(a), V(TINY)), bb = larger(b.dot(b), V(TINY));
        const V ab = a.dot(b), da = delta.dot(a), db = delta.dot(b);
        const V den = larger(aa * bb - ab * ab, EPS * aa * bb);
        V s = clamp01((da * bb - db * ab) / den);
        const V t = clamp01((s * ab - db) / bb);
        s = clamp01((t * ab + da) / aa);
        const V3 c = delta + b * t - a * s;
        const M near = c.dot(c) < largest_reach * largest_reach;
        // without branches: about every second pair is a hit
        for (int l = 0; l < W; ++l) {
            hit_k[hits] = ks[l];
            hit_s[hits] = s[l];
            hit_t[hits] = t[l];
            hits += near[l] ? (l < count) : 0;
        }
        if (hits >= W) {
            law(hit_k, hit_s, hit_t, W);
            hits -= W;
            for (int l = 0; l < hits; ++l) {
                hit_k[l] = hit_k[W + l];
                hit_s[l] = hit_s[W + l];
                hit_t[l] = hit_t[W + l];
            }
        }
    }
    if (hits > 0) {
        for (int l = hits; l < W; ++l) {
            hit_k[l] = hit_k[0];
            hit_s[l] = hit_s[0];
            hit_t[l] = hit_t[0];
        }
        law(hit_k, hit_s, hit_t, hits);
    }
"""


def capsule_sweep_source(name: str, features: CapsuleFeatures, arrays: list[str]) -> str:
    """Body of a function with the arguments of the sweep, `arrays` those that are arrays."""
    law = _LAW.replace("NORMAL", NORMAL)
    for key, rows in (("TURN_I", "on_i"), ("TURN_J", "on_j")):
        law = law.replace(key, transpose(LANES, rows))
    addresses = ", ".join(f"{array} = {array}.data" for array in arrays)
    return f"""
    const int kept_size = pair_step.shape[1], node_count = place.shape[0];
    auto sweep = [=, {addresses}]() __attribute__((noinline)) {{
    #pragma clang fp contract(fast)
    {lane_types(name, LANES)}
    {_constants(name, features)}
    {contact_constants(name)}
    if (status[SLOT_HALT] != 0) return;
    const V3 nothing3 = same3(0, 0, 0);
    T* const load = contact_load + (long)LINE * node_count * part;
    {_ROWS}
    {POWERS}
    {_HAND_OVER}
    {law}
    {_SWEEP}
    }};
    sweep();
    """
