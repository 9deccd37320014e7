"""C++ text of the SIMD sweep over listed pairs of bonded spheres (`native_capsules`).

Distances of eight listed pairs at a time; pairs within reach are collected and have the law of
contact eight at a time, normal (`native_capsule_law`) and tangential as in `capsule_pairs` and
`friction`. A memory that must be handed over is looked for pair by pair: that is rare.
Symbols: as in `capsule_pairs`; T real, V vector of T, k places in the list.
"""

from warpfiber.laws.hertz import DASHPOT
from warpfiber.model import HALT, precision
from warpfiber.passes.capsule_pairs import CapsuleFeatures
from warpfiber.passes.native import lane_types
from warpfiber.passes.native_capsule_law import NORMAL, POWERS, contact_constants
from warpfiber.passes.native_capsule_rows import DISTANCE, image_constants, row_source

# Pairs in both precisions: two registers of eight numbers hide each other's latency.
LANES = 16
PARTS = 2  # of the list; as many workers share a sweep
LINE = 8  # numbers per node and part: force, moment, two unused


def capsule_constants(name: str, features: CapsuleFeatures) -> str:
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
    }
    numbers |= image_constants()
    lines += [f"constexpr int {key} = {value};" for key, value in numbers.items()]
    return "\n".join(lines)


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
        T tips[4][W];
        for (int l = 0; l < W; ++l) {
            const int i = pair_i[ks[l]], j = pair_j[ks[l]];
            const long at_i = node_i[l] = segment_node[i], at_j = node_j[l] = segment_node[j];
            const int tip_i = segment_tips[i], tip_j = segment_tips[j];
            const int first_i = tip_i & 1, last_i = tip_i >> 1;
            const int first_j = tip_j & 1, last_j = tip_j >> 1;
            const P4 xi = place_row(at_i), xi1 = place_row(at_i + 1);
            const P4 xj = place_row(at_j), xj1 = place_row(at_j + 1);
            rows_a[l] = xi1 - xi;
            rows_b[l] = xj1 - xj;
            rows_d[l] = xj - xi;
            rows_bi[l] = xi - place_row(at_i - 1 + first_i);
            rows_ai[l] = place_row(at_i + 2 - last_i) - xi1;
            rows_bj[l] = xj - place_row(at_j - 1 + first_j);
            rows_aj[l] = place_row(at_j + 2 - last_j) - xj1;
            tips[0][l] = T(first_i);
            tips[1][l] = T(last_i);
            tips[2][l] = T(first_j);
            tips[3][l] = T(last_j);
        }
        if constexpr (HAS_DASHPOT || HAS_FRICTION)  // needed when the normal law is done
            for (int l = 0; l < W; ++l)
                for (int end = 0; end < 2; ++end) {
                    const long far = 3L * (node_j[l] + end);
                    __builtin_prefetch((const T*)node_velocity + far);
                    __builtin_prefetch((const T*)node_spin + far);
                    __builtin_prefetch(load + (long)LINE * (node_j[l] + end), 1);
                }
        if constexpr (HAS_FRICTION)
            for (int l = 0; l < W; ++l) {
                __builtin_prefetch(kept_last + 4L * ks[l]);
                __builtin_prefetch(kept_now + 4L * ks[l], 1);
            }
        auto of = [](const T* from) -> V {
            V v;
            __builtin_memcpy(&v, from, sizeof(V));
            return v;
        };
        // a constant of the group of one fiber of every pair
        auto constant = [&](const int* owner, auto field) -> V {
            if (one_group) return V(T(0)) + field(groups[0]);
            V v;
            for (int l = 0; l < W; ++l)
                ((T*)&v)[l] = field(groups[fiber_group[segment_fiber[owner[ks[l]]]]]);
            return v;
        };
        #define OF(owner, name) constant(owner, [](const auto& g) -> T { return g.name; })
        const V3 a = turn(rows_a), b = turn(rows_b);
        V3 delta = turn(rows_d);
        add_images(ks, delta);
        const V3 back_i = turn(rows_bi), ahead_i = turn(rows_ai);
        const V3 back_j = turn(rows_bj), ahead_j = turn(rows_aj);
        const M tip0_i = of(tips[0]) > T(0), tip1_i = of(tips[1]) > T(0);
        const M tip0_j = of(tips[2]) > T(0), tip1_j = of(tips[3]) > T(0);
        const V radius_i = OF(pair_i, radius), radius_j = OF(pair_j, radius);
        const V compliance_i = OF(pair_i, compliance), compliance_j = OF(pair_j, compliance);
        V s = of(ss), t = of(ts);
        NORMAL
        const M acts = force > T(0);
        typedef bool B __attribute__((ext_vector_type(W)));
        const B bits = __builtin_convertvector(acts, B);
        const unsigned mine = __builtin_bit_cast(unsigned short, bits) & ((1u << count) - 1u);
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
                const V3 start = turn(r);
                for (int l = 0; l < W; ++l) r[l] = real_row(of, node[l] + 1);
                return start * (T(1) - part) + turn(r) * part;
            };
            const V3 vi = between((const T*)node_velocity, node_i, s);
            const V3 vj = between((const T*)node_velocity, node_j, t);
            const V3 wi = between((const T*)node_spin, node_i, s);
            const V3 wj = between((const T*)node_spin, node_j, t);
            const V3 slip = vi - vj + (wi * arm_i + wj * arm_j).cross(n);
            const V approach = slip.dot(n);
            const V rest_s = T(1) - s, rest_t = T(1) - t;
            const V in_i = OF(pair_i, mass), in_j = OF(pair_j, mass);
            const V tip_i = OF(pair_i, closed ? g.mass : g.end_mass);
            const V tip_j = OF(pair_j, closed ? g.mass : g.end_mass);
            const V mass = T(1) / (rest_s * rest_s / (tip0_i ? tip_i : in_i)
                + s * s / (tip1_i ? tip_i : in_i) + rest_t * rest_t / (tip0_j ? tip_j : in_j)
                + t * t / (tip1_j ? tip_j : in_j));
            if constexpr (HAS_DASHPOT) {
                const V resistance = DASHPOT * beta * root(stiffness * mass);
                size = larger(size + resistance * approach, V(T(0)));
            }
            if constexpr (HAS_FRICTION) {
                const V shear = OF(pair_i, shear_compliance) + OF(pair_j, shear_compliance);
                const V k = T(4) * (compliance_i + compliance_j) / shear * stiffness;
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
                        const int to_i = s_l < T(0.5) ? -(tips[0][l] == T(0))
                                                      : (tips[1][l] == T(0));
                        const int to_j = t_l < T(0.5) ? -(tips[2][l] == T(0))
                                                      : (tips[3][l] == T(0));
                        from = neighbors_memory(
                            from, i + to_i, j + to_j, ((const T*)&far_i)[l], ((const T*)&far_j)[l]);
                        if (from < 0) continue;
                    }
                    for (int m = 0; m < 4; ++m) kept[m][l] = kept_last[4L * from + m];
                }
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
        V numbers[8] = {
            whole.x, whole.y, whole.z, moment.x * arm_i, moment.y * arm_i, moment.z * arm_i};
        numbers[6] = numbers[7] = V(T(0));
        T8 on_i[W], on_j[W];
        turn_back(numbers, on_i);
        for (int c = 0; c < 3; ++c) numbers[c] = -numbers[c];
        numbers[3] = moment.x * arm_j;
        numbers[4] = moment.y * arm_j;
        numbers[5] = moment.z * arm_j;
        turn_back(numbers, on_j);
        for (unsigned left = mine; left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            auto add = [&](int node, T8 values) {
                typedef T U8 __attribute__((ext_vector_type(8), aligned(sizeof(T))));
                *(U8*)(load + (long)LINE * node) += values;
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
    const int begin = out_start[part_start[part]], end = begin + near_count[part];
    constexpr int ROOM = 2 * W;
    int hit_k[ROOM], hits = 0;
    T hit_s[ROOM], hit_t[ROOM];
    for (int first = begin; first < end; first += W) {
        const int count = end - first < W ? end - first : W;
        int ks[W], from_i[W], from_j[W];
        for (int l = 0; l < W; ++l) {
            const int at = first + (l < count ? l : count - 1);
            ks[l] = near_pair[at];
            from_i[l] = near_i[at];
            from_j[l] = near_j[at];
            pair_acts[ks[l]] = 0;
        }
        V s, t;
        const V3 c = closest(ks, from_i, from_j, s, t);
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
    addresses = ", ".join(f"{array} = {array}.data" for array in arrays)
    return f"""
    const int kept_size = pair_step.shape[1], node_count = place.shape[0];
    const bool one_group = groups.shape[0] == 1;
    auto sweep = [=, {addresses}]() __attribute__((noinline)) {{
    #pragma clang fp contract(fast)
    {lane_types(name, LANES)}
    {capsule_constants(name, features)}
    {contact_constants(name)}
    if (status[SLOT_HALT] != 0) return;
    const V3 nothing3 = same3(0, 0, 0);
    T* const load = contact_load + (long)LINE * node_count * part;
    {row_source()}
    {POWERS}
    {_HAND_OVER}
    {DISTANCE}
    {law}
    {_SWEEP}
    }};
    sweep();
    """
