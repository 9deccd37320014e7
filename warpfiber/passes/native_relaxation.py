"""Rows of contact relaxed one after the other, fiber by fiber: a solve for the CPU.

A fiber whose rows are out of balance is visited: each of its rows whose fault is not small takes
the force that balances it alone. That moves its two fibers at once, and both queue up to be visited
again. So work is spent only where forces still change: after a warm start a row is looked at twice
or thrice, where passes over all rows (`dual_rows`) repeat for the slowest cluster. Cells of one
part without friction: `native_row_coupling`, of rods where all is hard: `native_rod_sweeps`.

Many fibers are cut into parts, slabs of the cell across the axis along which fibers reach least.
Parts relax their own rows side by side, then one thread all that are left, those between parts
first. Which parts there are depends on the fibers alone, so the result does not on the workers.

Source: projected Gauss-Seidel, over-relaxed, in the order of the queue: the dual objective falls
    with every relaxation, in any order.
        f <- max(0, f - OVER e/(D + C)),  D exact
        e = b + n.(z_j(t) - z_i(s)),  z(s) = (1 - s) z_k + s z_k+1
    Rows of compliance C (lubrication) as in `dual_rows`; the exponential law, whose compliance
    changes with f, takes the largest. Friction: `native_friction`.
Symbols: e balance of a row, a length; z motion of node k by all forces, four numbers (the last one
    the impulse of the segment before it); `low` the largest e of either sign for which nobody is
    visited again, SHARE of the tolerance; in the first look at all rows, which costs little, only
    those with less than FINE of it keep their force.
"""

from warpfiber.laws.repulsion import RANGE
from warpfiber.model import precision
from warpfiber.passes.dual_rows import BROKEN, NEXT_UPDATES, UNSOLVED
from warpfiber.passes.native_friction import RUB_FORCES, RUB_NAMES, rubbing
from warpfiber.passes.native_row_coupling import coupling_text
from warpfiber.passes.native_row_order import BEGIN_TEXT, NAMES, ROWS_TEXT, named

OVER = 1.2
SHARE, SHARE_RUBBING = 0.9, 0.5
FINE = 0.02
# stages of a solve; all but BEGIN and REST by as many threads as parts
BEGIN, ROWS, PARTS, REST, END = range(5)
# visits ahead: who is visited after so many has its list and motion, its rows, and the motions of
# its partners fetched
FAR, NEAR, NEXT = 6, 4, 2
LOOKS = 3  # at the rows of a fiber in one visit, while they are at hand

# y(f) as in `laws.contact_compliance`, and its largest slope; contact: the sum of two radii.
OPENING = {
    "hard": """
    auto opening = [&](int r, T f) -> T { return T(0); };
    auto softness = [&](int r) -> T { return T(0); };
""",
    "linear": """
    auto opening = [&](int r, T f) -> T { return f / d.stiffness; };
    auto softness = [&](int r) -> T { return T(1) / d.stiffness; };
""",
    "exponential": """
    const T least = wp::exp(-d.decay * T(edge));
    auto radius_of = [&](int f) -> T { return d.groups.data[d.fiber_group.data[f]].radius; };
    auto contact_of = [&](int r) -> T {
        const int i = states[r].fiber_i, j = states[r].fiber_j;
        return j < 0 ? T(2) * radius_of(i) : radius_of(i) + radius_of(j);
    };
    auto opening = [&](int r, T f) -> T {
        const T contact = contact_of(r), ratio = f / d.stiffness;
        return ratio <= least ? -T(edge) * contact : contact / d.decay * wp::log(ratio);
    };
    auto softness = [&](int r) -> T { return contact_of(r) / (d.decay * least * d.stiffness); };
""",
}

# The motion of the fibers of a part by the forces of all their rows, added up anew.
# `push(f, r, side, change)` moves fiber f by a change of the force of row r.
ADD_UP = """
    auto add_up = [&]() {
    for (int q = d.part_start.data[part]; q < d.part_start.data[part + 1]; ++q) {
        const int f = d.fiber_order.data[q];
        T* const mine = motion + d.fiber_at.data[f];
        for (int c = 0; c < size_of(f); ++c) mine[c] = T(0);
        if (is_fixed(f)) continue;
        each_end(f, [&](int r, int side) {
            if (rows[r].force != T(0)) push(f, r, side, rows[r].force);
ADD_FRICTION        });
    }
    };
"""

# In PARTS the rows within a part, in REST all of them. `diagonal_of(r)`: D of a row.
RELAX = """
    const bool whole = stage == REST_STAGE;
    const int first = whole ? 0 : d.part_start.data[part];
    const int held_most = (whole ? fibers : d.part_start.data[part + 1]) - first;
    const int low_at = whole || held_most == 0 ? 0 : d.fiber_at.data[d.fiber_order.data[first]];
    int high_at = still;
    if (!whole && part + 1 < d.parts && first + held_most < fibers)
        high_at = d.fiber_at.data[d.fiber_order.data[first + held_most]];
    auto inside = [&](const Row& row) -> bool {
        return (row.at_i == still || (row.at_i >= low_at && row.at_i < high_at))
            && (row.at_j == still || (row.at_j >= low_at && row.at_j < high_at));
    };
    auto balance_of = [&](int r) -> T {
        const Row& row = rows[r];
        const Q* const i = (const Q*)(motion + row.at_i);
        const Q* const j = (const Q*)(motion + row.at_j);
        const Q v = j[0] + row.t * (j[1] - j[0]) - i[0] - row.s * (i[1] - i[0]);
        const T moved = row.normal[0] * v[0] + row.normal[1] * v[1] + row.normal[2] * v[2];
        T e = row.normal[3] + moved;
        if (wet) e += states[r].soft * row.force;
        if (yields && !(wet && states[r].soft > T(0))) e += opening(r, row.force);
        return e;
    };
    auto is_open = [&](int r) -> bool {
        return rows[r].force == T(0) && !(wet && states[r].soft > T(0));
    };
    auto prepare = [&](int r) {
        State& state = states[r];
        if (state.low >= T(broken)) return;
        const T diagonal = diagonal_of(r);
        const T all = diagonal + (state.soft > T(0) ? state.soft : softness(r));
        state.step = all > T(0) ? T(over) / all : T(0);
        state.low = all > T(0) ? small : T(broken);  // else nothing that it touches can move
        if (state.soft > T(0)) state.low = diagonal > T(0) ? small * (all / diagonal) : T(broken);
    };
    long long relaxed = 0;
    // a few rows that are nearly the same take more, and cost nothing
    const long long limit = (long long)d.most * (count > 100 ? count : 100);
    // with more than a part of `low`; whether it had more than that
    auto PRESS = [&](int r, T part) -> bool {
        const T e = balance_of(r);
        const T size = is_open(r) ? -e : wp::abs(e);
        if (!(size > part * small)) return false;
        State& state = states[r];
        if (state.step < T(0)) prepare(r);
        if (!(size > part * state.low)) return false;
        Row& row = rows[r];
        const T force = row.force - state.step * e;
        const T next = state.soft == T(0) && force < T(0) ? T(0) : force;
        const T change = next - row.force;
        row.force = next;
        if (change != T(0)) {
            if (row.at_i != still) push(state.fiber_i, r, 0, change);
            if (row.at_j != still) push(state.fiber_j, r, 1, change);
        }
        if (!(size > state.low)) return false;
        ++relaxed;
        return true;
    };
RELAX_FRICTION    int* const queue = d.queue.data + first;
    int held = 0, head = 0;
    auto visit_later = [&](int f) {
        if (f < 0 || d.fiber_queued.data[f]) return;
        d.fiber_queued.data[f] = 1;
        const int at = head + held++;
        queue[at < held_most ? at : at - held_most] = f;
    };
    auto look_at = [&](int r, T part) {
        if (relaxed >= limit || (!whole && !inside(rows[r])) || !relax(r, part)) return;
        visit_later(states[r].fiber_i);
        visit_later(states[r].fiber_j);
    };
    // What a visit reads is anywhere in memory, but who is visited next is known.
    auto ahead = [&](int places) -> int {
        const int at = head + places;
        return queue[at < held_most ? at : at - held_most];
    };
    auto fetch = [&]() {
        if (held > FAR) {
            const int f = ahead(FAR);
            for (int k = d.in_start.data[f]; k < d.in_start.data[f + 1]; k += 16)
                __builtin_prefetch(d.in_row.data + k);
            for (int c = 0; c < size_of(f); c += 8)
                __builtin_prefetch(motion + d.fiber_at.data[f] + c);
        }
        if (held > NEAR)
            each_end(ahead(NEAR), [&](int r, int) { __builtin_prefetch(rows + r); });
        if (held > NEXT)
            each_end(ahead(NEXT), [&](int r, int side) {
                const T* const other = motion + (side == 0 ? rows[r].at_j : rows[r].at_i);
                __builtin_prefetch(other);
                __builtin_prefetch(other + 7);
            });
    };
    auto visit_all = [&]() {
        while (held > 0 && relaxed < limit) {
            fetch();
            const int f = queue[head];
            head = head + 1 == held_most ? 0 : head + 1;
            --held;
            d.fiber_queued.data[f] = 0;
            for (int look = 0; look < LOOKS; ++look) {
                const long long before = relaxed;
                each_end(f, [&](int r, int) { look_at(r, T(1)); });
                if (relaxed == before) break;
            }
        }
    };
    if (!whole) {
        for (int q = 0; q < held_most; ++q) {
            const int f = d.fiber_order.data[first + q];
            for (int r = row_first(f); r < row_last(f); ++r) look_at(r, T(fine));
        }
        visit_all();
        for (; held > 0; --held) {
            d.fiber_queued.data[queue[head]] = 0;
            head = head + 1 == held_most ? 0 : head + 1;
        }
        d.part_relaxed.data[part] = relaxed;
        return;
    }
    for (int p = 0; p < d.parts; ++p) relaxed += d.part_relaxed.data[p];
    if (d.parts > 1)
        for (int r = 0; r < count; ++r) {
            const int i = states[r].fiber_i, j = states[r].fiber_j;
            if (i >= 0 && j >= 0 && d.fiber_part.data[i] != d.fiber_part.data[j])
                look_at(r, T(fine));
        }
    T fault = T(0);
    while (true) {
        visit_all();
        fault = T(0);
        for (int r = 0; r < count; ++r) {
            const State& state = states[r];
            if (state.low >= T(broken)) continue;
            const T e = balance_of(r);
            T mine = is_open(r) ? (e < T(0) ? -e : T(0)) : wp::abs(e);
            if (state.step > T(0)) mine *= T(1) - state.soft * state.step / T(over);
            if (!(mine < T(broken)) || e != e) mine = T(broken);
FAULT_FRICTION            fault = wp::max(fault, mine);
            if (mine > T(d.tolerance) && mine < T(broken)) look_at(r, T(1));
        }
        // what small changes have added up to on rows that nobody visited again
        if (held == 0 || relaxed >= limit) break;
    }
    d.best.data[1] = fault;
    if (fault > T(d.tolerance)) ++d.control.data[unsolved];
    d.control.data[next_updates] = (int)((relaxed + count - 1) / count);
"""

# What was added and taken away along the way leaves rounding, so before this it is added up anew.
# `leave(f, its motion)` beside.
LEAVE = """
    for (int q = d.part_start.data[part]; q < d.part_start.data[part + 1]; ++q) {
        const int f = d.fiber_order.data[q];
        for (int k = 0; k < owned(f); ++k)
            d.row_force.data[row_given(f) + k] = rows[row_first(f) + k].force;
LEAVE_FRICTION        const T* const mine = motion + d.fiber_at.data[f];
        const int node = d.fiber_node_start.data[f];
        const int nodes = d.fiber_node_start.data[f + 1] - node;
        for (int k = 0; k < nodes; ++k)
            for (int c = 0; c < 3; ++c) d.node_shift.data[node + k][c] = mine[4 * k + c];
        leave(f, mine);
        if (d.node_push.shape[0] == 0) continue;
        for (int k = 0; k < nodes; ++k) d.node_push.data[node + k] = {};
        each_end(f, [&](int r, int side) {
            const Row& row = rows[r];
            const int at = side == 0 ? row.at_i : row.at_j;
            if (row.force == T(0) || at == still) return;
            const int k = node + (at - d.fiber_at.data[f]) / 4;
            const T share = side == 0 ? row.s : row.t, sign = side == 0 ? T(-1) : T(1);
            for (int c = 0; c < 3; ++c) {
                const T push = sign * row.force * row.normal[c];
                d.node_push.data[k][c] += (T(1) - share) * push;
                d.node_push.data[k + 1][c] += share * push;
            }
PUSH_FRICTION        });
    }
    return;
"""


def relaxation_text(
    name: str,
    law: str,
    fibers: str,
    types: str = "",
    friction: str | None = None,
    hard: str = "",
) -> str:
    """C++ text of a stage of a solve.

    `fibers`: size_of, ready, push, diagonal_of and leave; `types`: of its vectors; `friction`:
    rub_column of these fibers, where rows have friction; `hard`: all stages but BEGIN of a cell in
    one part whose rows are neither compliant nor rub, in place of these here.
    """
    real = {"float32": "float", "float64": "double"}[precision(name).name]
    # a friction force that is not looked at again keeps the limit of an earlier normal force
    share = SHARE if friction is None else SHARE_RUBBING
    numbers = f"""
    {types or f"typedef {real} T;"}
    constexpr double over = {OVER!r}, share = {share!r}, fine = {FINE!r};
    constexpr double broken = {BROKEN!r};
    constexpr double edge = {RANGE - 1.0!r};
    constexpr bool yields = {str(law != "hard").lower()};
    constexpr int next_updates = {NEXT_UPDATES}, unsolved = {UNSOLVED};
"""
    coupled = "" if friction is not None else f"if (coupled) {{ {coupling_text()} }}"
    stages = f"""
    if (stage == {BEGIN}) {{ {BEGIN_TEXT} }}
    {f"if (!wet && d.parts == 1 && d.node_push.shape[0] == 0) {{ {hard} }}" if hard else ""}
    if (stage == {ROWS}) {{ {ROWS_TEXT} }}
    {ADD_UP}
    const bool coupled = {str(friction is None).lower()} && d.parts == 1;
    if (stage == {REST} && coupled) return;
    if (stage != {REST} && !coupled) add_up();
    if (stage == {END}) {{ {LEAVE} }}
    {coupled}
    {RELAX}
"""
    begin, behind = NAMES + OPENING[law], ""
    if friction is not None:
        begin, behind = begin + RUB_NAMES, friction + RUB_FORCES
    text = named(rubbing(numbers + begin + fibers + behind + stages, name, friction is not None))
    for key, value in {
        "REST_STAGE": REST,
        "ROWS_STAGE": ROWS,
        "END_STAGE": END,
        "FAR": FAR,
        "NEAR": NEAR,
        "NEXT": NEXT,
        "LOOKS": LOOKS,
    }.items():
        text = text.replace(key, str(value))
    return text
