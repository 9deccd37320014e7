"""C++ text of the SIMD sweep over listed pairs of bonded spheres (`native_capsules`).

Distances of LANES near pairs at a time; pairs within reach are collected, those whose patch reaches
beyond a segment apart, and have the law of contact LANES at a time, normal (`native_capsule_law`)
and tangential as in `capsule_pairs` and `friction`. What waits for its law is fetched into the
cache meanwhile. A memory that must be handed over is looked for pair by pair: that is rare.
Symbols: as in `capsule_pairs`; T real, V vector of T, k places in the list, `at` among near pairs.
"""

from warpfiber.laws.hertz import DASHPOT
from warpfiber.model import HALT, precision
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.contact_losses import RECORD
from warpfiber.passes.native import lane_types
from warpfiber.passes.native_capsule_hits import SWEEP
from warpfiber.passes.native_capsule_law import NORMAL, SHARES, SPRINGS, contact_constants
from warpfiber.passes.native_capsule_powers import POWERS
from warpfiber.passes.native_capsule_rows import DISTANCE, image_constants, row_source

# Pairs in both precisions: two registers of eight numbers hide each other's latency.
LANES = 16
PARTS = 2  # of the list; as many workers share a sweep
TIP_BITS = 2  # of a segment in `near_i`, below its first node: first, last one of its fiber
AHEAD = 4  # blocks of pairs whose nodes are fetched
RUNS = 6  # laws of one kind in a row: they stay in the cache of instructions
FAR = 16  # the same of the list itself
READ_AHEAD = (1 + AHEAD) * LANES  # what the lists of pairs have room for behind their end
KEEPS_LOADS, KEEPS_RECORD = 1, 2  # what is stored by pair; see `contact_losses`
LINE = 8  # numbers per node and part: force, moment, two of no use; the first line is of zeros


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
        "TIP_BITS": TIP_BITS,
        "AHEAD": AHEAD,
        "FAR": FAR,
        "RUN": RUNS * LANES,
        "SLOT_HALT": HALT,
        "KEEPS_LOADS": KEEPS_LOADS,
        "KEEPS_RECORD": KEEPS_RECORD,
        "RECORD": RECORD,
    }
    numbers |= image_constants()
    lines += [f"constexpr int {key} = {value};" for key, value in numbers.items()]
    return "\n".join(lines)


# What a pair that begins to act takes over (`contact_memory.neighbors_memory`).
_HAND_OVER = """
    const int now = (int)step[0], last = now - 1;
    // a pair has both steps beside each other, in one cache line
    T* const kept_now = (T*)pair_memory + 4 * (now & 1);
    const T* const kept_last = (const T*)pair_memory + 4 * (last & 1);
    int* const written_now = pair_step + (now & 1);
    const int* const written_last = pair_step + (last & 1);
    auto memory_of = [&](int i, int j, int image) -> int {
        for (int k = out_start[i]; k < out_start[i + 1]; ++k)
            if (pair_j[k] == j && pair_image[k] == image && written_last[2L * k] == last) return k;
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
            if (found >= 0 && kept_last[8L * found + 3] != T(0)) return found;
        }
        return -1;
    };
"""

# Pairs within reach, the near ones `ats`, of which the first `count` count.
_LAW = """
    auto law = [&](auto kind, const int* ats, const T* ss, const T* ts, int count)
        __attribute__((noinline)) {
        typedef decltype(kind) KIND;
        int ks[W], node_i[W], node_j[W];
        I code_i, code_j, images;
        for (int l = 0; l < W; ++l) {
            const int at = ats[l], of_i = near_i[at], of_j = near_j[at];
            ks[l] = near_pair[at];
            ((int*)&code_i)[l] = of_i;
            ((int*)&code_j)[l] = of_j;
            ((int*)&images)[l] = near_image[at];
            node_i[l] = of_i >> TIP_BITS;
            node_j[l] = of_j >> TIP_BITS;
        }
        auto of = [](const T* from) -> V {
            V v;
            __builtin_memcpy(&v, from, sizeof(V));
            return v;
        };
        Springs mixed;
        if (!one_group)
            mixed = springs_of(
                typename KIND::Tips(), [&](int side, auto field) -> V {
                    const int* const owner = side == 0 ? pair_i : pair_j;
                    V v;
                    for (int l = 0; l < W; ++l)
                        ((T*)&v)[l] = field(groups[fiber_group[segment_fiber[owner[ks[l]]]]]);
                    return v;
                });
        const Springs& g = one_group ? alike : mixed;
        V3 a, b, delta;
        edges(node_i, node_j, a, b, delta);
        add_images(images, delta);
        const M tip0_i = tipped(code_i, 1), tip1_i = tipped(code_i, 2);
        const M tip0_j = tipped(code_j, 1), tip1_j = tipped(code_j, 2);
        V s = of(ss), t = of(ts);
        NORMAL
        const unsigned mine = bits(share.energy > T(0)) & ((1u << count) - 1u);
        if (mine == 0) return;

        const V arm_i = T(0.5) * (distance + g.lever), arm_j = distance - arm_i;
        V size = force;
        V3 drag = nothing3, path = nothing3;
        if constexpr (HAS_DASHPOT || HAS_FRICTION) {
            // differences and sums before rows are turned: two of them instead of eight
            auto between = [&](const auto& of, const int* nodes, const V& part, int l) -> T4 {
                T4 start, end;
                two_rows((const T*)of, nodes[l], start, end);
                return start + (end - start) * ((const T*)&part)[l];
            };
            const V3 apart = turn([&](int l) -> T4 {
                return between(node_velocity, node_i, s, l) - between(node_velocity, node_j, t, l);
            });
            const V3 spun = turn([&](int l) -> T4 {
                return between(node_spin, node_i, s, l) + between(node_spin, node_j, t, l);
            });
            // spins of both times their arms, which differ where radii do
            V3 rolled = spun * (T(0.5) * distance);
            if (!one_group)
                rolled = rolled + turn([&](int l) -> T4 {
                    return between(node_spin, node_i, s, l) - between(node_spin, node_j, t, l);
                }) * (T(0.5) * g.lever);
            const V3 slip = apart + rolled.cross(n);
            const V approach = slip.dot(n);
            const V rest_s = T(1) - s, rest_t = T(1) - t;
            const V mass = T(1) / (rest_s * rest_s * (tip0_i ? g.tip_i : g.in_i)
                + s * s * (tip1_i ? g.tip_i : g.in_i)
                + rest_t * rest_t * (tip0_j ? g.tip_j : g.in_j)
                + t * t * (tip1_j ? g.tip_j : g.in_j));
            const V resistance = DASHPOT * beta * root(damped * mass);
            if constexpr (HAS_DASHPOT) {
                size = larger(size + resistance * approach, V(T(0)));
            }
            if constexpr (HAS_FRICTION) {
                const V k = g.shear_part * stiffness;
                const V3 slide = slip - n * approach;
                const V twist = T(0.5) * dt * spun.dot(n);
                const V far_i = e.la * smaller(s, rest_s), far_j = e.lb * smaller(t, rest_t);
                T4 kept[W];
                T before_of[W];
                __builtin_memset(kept, 0, sizeof(kept));
                __builtin_memset(before_of, 0, sizeof(before_of));
                for (unsigned left = mine; left != 0; left &= left - 1) {
                    const int l = __builtin_ctz(left);
                    int from = ks[l];
                    if (__builtin_expect(written_last[2L * from] != last, 0)) {
                        const int i = pair_i[from], j = pair_j[from];
                        const T s_l = ((const T*)&s)[l], t_l = ((const T*)&t)[l];
                        const int tips_i = ~((const int*)&code_i)[l];
                        const int tips_j = ~((const int*)&code_j)[l];
                        const int to_i = s_l < T(0.5) ? -(tips_i & 1) : tips_i >> 1 & 1;
                        const int to_j = t_l < T(0.5) ? -(tips_j & 1) : tips_j >> 1 & 1;
                        from = neighbors_memory(
                            from, i + to_i, j + to_j, ((const T*)&far_i)[l], ((const T*)&far_j)[l]);
                        if (from < 0) continue;
                    }
                    __builtin_memcpy(&kept[l], kept_last + 8L * from, sizeof(T4));
                    before_of[l] = kept_last[8L * from + 3];
                }
                const V3 h = turn([&](int l) -> T4 { return kept[l]; });
                const V before = of(before_of);
                V3 flat = h - n * h.dot(n);
                flat = flat + n.cross(flat) * twist;
                // as long as it was, but shorter where the contact is deeper
                const M deeper = depth > before;
                const V scale2 = h.dot(h) * (deeper ? before : V(T(1)))
                    / (larger(flat.dot(flat), V(SMALL * SMALL)) * (deeper ? depth : V(T(1))));
                const V scale = before > T(0) ? root(scale2) : V(T(0));
                path = flat * scale + slide * dt;
                drag = nothing3 - path * k - slide * (resistance * g.root_shear);
                const V whole = root(drag.dot(drag)), limit = friction * size;
                const M slides = whole > limit;
                const V pulled = larger(whole, V(TINY)), in_both = T(1) / (pulled * k);
                drag = drag * (slides ? limit * k * in_both : V(T(1)));
                const V back = -pulled * in_both;
                path = V3{slides ? drag.x * back : path.x, slides ? drag.y * back : path.y,
                          slides ? drag.z * back : path.z};
            }
        }
        const V3 whole = drag - n * (size - force) + share.by_delta;
        const V3 moment = n.cross(drag);
        T8 rows[4][W];
        // two numbers more: of the memory, which is turned with them
        auto load_row = [&](int m, const V3& force_there, V part, V more, V last) {
            const V lever = part * (m < 2 ? arm_i : arm_j);
            const V numbers[8] = {
                force_there.x, force_there.y, force_there.z,
                moment.x * lever, moment.y * lever, moment.z * lever, more, last};
            turn_back(numbers, rows[m]);
        };
        load_row(0, whole * (T(1) - s) + couple_i, T(1) - s, path.x, path.y);
        load_row(1, whole * s - couple_i, s, path.z, depth);
        load_row(2, couple_j - whole * (T(1) - t), T(1) - t, V(T(0)), V(T(0)));
        load_row(3, nothing3 - couple_j - whole * t, t, V(T(0)), V(T(0)));
        // not read again from memory behind every store
        T8* const lines = load_lines, * const own = load;
        wp::uint8* const touched = touch;
        T* const memory_now = kept_now;
        int* const step_now = written_now;
        const long before = part_line;
        for (unsigned left = mine; left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            auto add = [&](int node, T8 values) {
                // the line of a node without loads yet is not the first one, which is of zeros
                own[node] = lines[(before + node) * touched[node]] + values;
                touched[node] = 1;
            };
            add(node_i[l], rows[0][l]);
            add(node_i[l] + 1, rows[1][l]);
            add(node_j[l], rows[2][l]);
            add(node_j[l] + 1, rows[3][l]);
            const long k = ks[l];
            if constexpr (HAS_FRICTION) {
                __builtin_memcpy(memory_now + 8 * k, (const T*)&rows[0][l] + 6, 2 * sizeof(T));
                __builtin_memcpy(memory_now + 8 * k + 2, (const T*)&rows[1][l] + 6, 2 * sizeof(T));
                step_now[2 * k] = now;
            }
            if (keeps) {
                auto lane = [&](const V& v) -> T { return ((const T*)&v)[l]; };
                pair_acts[k] = 1;
                if (keeps & KEEPS_LOADS) {
                    T* f = (T*)pair_force + 3 * k;
                    T* arms = (T*)pair_arms + 4 * k;
                    for (int c = 0; c < 3; ++c) f[c] = lane((&whole.x)[c]);
                    arms[0] = lane(s);
                    arms[1] = lane(t);
                    arms[2] = lane(arm_i);
                    arms[3] = lane(arm_j);
                }
                if (keeps & KEEPS_RECORD) {
                    T* record = (T*)pair_record + 4 * RECORD * k;
                    const T8 acting = {lane(n.x), lane(n.y), lane(n.z), lane(size - force),
                                       lane(drag.x), lane(drag.y), lane(drag.z), lane(arm_i)};
                    const T4 where = {lane(s), lane(t), lane(arm_j), T(0)};
                    __builtin_memcpy(record, &acting, sizeof(T8));
                    __builtin_memcpy(record + 8, &where, sizeof(T4));
                }
            }
        }
    };
"""


def capsule_sweep_source(name: str, features: CapsuleFeatures, arrays: list[str]) -> str:
    """Body of a function with the arguments of the sweep, `arrays` those that are arrays."""
    law = _LAW.replace("NORMAL", NORMAL)
    addresses = ", ".join(f"{array} = {array}.data" for array in arrays)
    return f"""
    const int node_count = place.shape[0];
    const bool one_group = groups.shape[0] == 1;
    auto sweep = [=, {addresses}]() __attribute__((noinline)) {{
    #pragma clang fp contract(fast)
    {lane_types(name, LANES)}
    {capsule_constants(name, features)}
    {contact_constants(name)}
    if (status[SLOT_HALT] != 0) return;
    const V3 nothing3 = same3(0, 0, 0);
    {row_source()}
    typedef bool B __attribute__((ext_vector_type(W)));
    auto bits = [](M m) -> unsigned {{
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(m, B));
    }};
    auto tipped = [](I code, int tip) -> M {{
        return __builtin_convertvector((code & tip) != 0, M);
    }};
    T8* const load_lines = (T8*)contact_load;
    const long part_line = 1 + (long)node_count * part;
    T8* const load = load_lines + part_line;
    wp::uint8* const touch = contact_touch + (long)node_count * part;
    {POWERS}
    {SHARES}
    {SPRINGS}
    {_HAND_OVER}
    {DISTANCE}
    {law}
    {SWEEP}
    }};
    sweep();
    """
