"""Rows of contact relaxed one after the other, fiber by fiber: a serial solve for the CPU.

A fiber whose rows are out of balance is visited: each of its rows whose fault is not small takes
the force that balances it alone. That moves its two fibers at once, and both queue up to be visited
again. So work is spent only where forces still change: after a warm start a row is looked at twice
or thrice, where passes over all rows (`dual_rows`) repeat for the slowest cluster. One thread, so
that the result does not depend on the workers.

Source: projected Gauss-Seidel, over-relaxed, in the order of the queue: the dual objective falls
    with every relaxation, in any order.
        f <- max(0, f - OVER e/(D + C)),  D exact
    Rows of compliance C (lubrication) as in `dual_rows`; the exponential law, whose compliance
    changes with f, takes the largest.
Symbols: e balance of a row, a length; `low` the largest e of either sign for which nobody is
    visited again, SHARE of the tolerance; in the first look at all rows, which costs little, only
    those with less than FINE of it keep their force.
"""

from warpfiber.laws.repulsion import RANGE
from warpfiber.model import precision
from warpfiber.passes.dual_rows import BROKEN, NEXT_UPDATES, UNSOLVED

OVER = 1.2
SHARE = 0.5
FINE = 0.02

# y(f) as in `laws.contact_compliance`, and its largest slope; contact: the sum of two radii.
OPENING = {
    "hard": """
    auto opening = [&](int r, T f) -> T { return T(0); };
    auto softness = [&](int r) -> T { return T(0); };
""",
    "linear": """
    auto opening = [&](int r, T f) -> T { return f / stiffness; };
    auto softness = [&](int r) -> T { return T(1) / stiffness; };
""",
    "exponential": """
    const T least = wp::exp(-decay * T(edge));
    auto contact_of = [&](int r) -> T {
        const int j = row_j.data[r];
        const T mine = groups.data[fiber_group.data[segment_fiber.data[row_i.data[r]]]].radius;
        if (j < 0) return T(2) * mine;
        return mine + groups.data[fiber_group.data[segment_fiber.data[j]]].radius;
    };
    auto opening = [&](int r, T f) -> T {
        const T contact = contact_of(r), ratio = f / stiffness;
        return ratio <= least ? -T(edge) * contact : contact / decay * wp::log(ratio);
    };
    auto softness = [&](int r) -> T { return contact_of(r) / (decay * least * stiffness); };
""",
}

# What a solve needs of every row. `prepare(r, D)` after its force; then `balance_of(r)` is e
# without what the row itself yields, `move(r, change)` moves its fibers by a change of the force.
ROWS = """
    struct Row { T low, step, soft, force; };
    Row* const state = (Row*)row_state.data;
    const T small = T(share * tolerance);
    auto start_force = [&](int r) {
        const T soft = row_compliance.data[r], force = row_force.data[r];
        state[r].soft = soft;
        state[r].force = soft == T(0) && force < T(0) ? T(0) : force;
    };
    auto prepare = [&](int r, T diagonal) {
        Row& row = state[r];
        const T whole = diagonal + (row.soft > T(0) ? row.soft : softness(r));
        row.step = whole > T(0) ? T(over) / whole : T(0);
        row.low = whole > T(0) ? small : T(broken);  // else nothing that it touches can move
        if (row.soft > T(0)) row.low = diagonal > T(0) ? small * (whole / diagonal) : T(broken);
    };
    // D only when the row is first relaxed; until then it may move unless `fixed`
    auto prepare_later = [&](int r, bool fixed) {
        state[r].low = fixed && !yields && state[r].soft == T(0) ? T(broken) : T(0);
        state[r].step = T(-1);
    };
"""

# Rows of fiber f: own ones from row_first(f) to row_last(f), those as a partner in `in_row`.
RELAX = """
    auto whole_balance = [&](int r) -> T {
        const Row& row = state[r];
        const T e = balance_of(r) + row.soft * row.force;
        return yields && row.soft == T(0) ? e + opening(r, row.force) : e;
    };
    long long relaxed = 0;
    // a few rows that are nearly the same take more, and cost nothing
    const long long limit = (long long)most * (count > 100 ? count : 100);
    // with more than a part of `low`; whether it had more than that
    auto relax = [&](int r, T part) -> bool {
        Row& row = state[r];
        const T e = whole_balance(r);
        const T size = row.force == T(0) && row.soft == T(0) ? -e : wp::abs(e);
        if (!(size > part * row.low)) return false;
        if (row.step < T(0)) {
            if (!(size > part * small)) return false;
            prepare(r, diagonal_of(r));
        }
        const T force = row.force - row.step * e;
        const T next = row.soft == T(0) && force < T(0) ? T(0) : force;
        const T change = next - row.force;
        row.force = next;
        if (change != T(0)) move(r, change);
        if (!(size > row.low)) return false;
        ++relaxed;
        return true;
    };
    int held = 0, head = 0;
    auto visit_later = [&](int f) {
        if (f < 0 || fiber_queued.data[f]) return;
        fiber_queued.data[f] = 1;
        const int at = head + held++;
        queue.data[at < fibers ? at : at - fibers] = f;
    };
    auto look_at = [&](int r, T part) {
        if (relaxed >= limit || !relax(r, part)) return;
        visit_later(row_fiber(r, 0));
        visit_later(row_fiber(r, 1));
    };
    for (int f = 0; f < fibers; ++f) fiber_queued.data[f] = 0;
    for (int r = 0; r < count; ++r) look_at(r, T(fine));
    T fault = T(0);
    while (true) {
        while (held > 0 && relaxed < limit) {
            const int f = queue.data[head];
            head = head + 1 == fibers ? 0 : head + 1;
            --held;
            fiber_queued.data[f] = 0;
            for (int r = row_first(f); r < row_last(f); ++r) look_at(r, T(1));
            for (int k = in_start.data[f]; k < in_start.data[f + 1]; ++k) 
                look_at(in_row.data[k], T(1));
        }
        fault = T(0);
        for (int r = 0; r < count; ++r) {
            const Row& row = state[r];
            if (row.low >= T(broken)) continue;
            const T e = whole_balance(r);
            T mine = row.force == T(0) && row.soft == T(0) ? (e < T(0) ? -e : T(0)) : wp::abs(e);
            if (row.step > T(0)) mine *= T(1) - row.soft * row.step / T(over);
            if (!(mine < T(broken)) || e != e) mine = T(broken);
            fault = wp::max(fault, mine);
            if (mine > T(tolerance) && mine < T(broken)) look_at(r, T(1));
        }
        // what small changes have added up to on rows that nobody visited again
        if (held == 0 || relaxed >= limit) break;
    }
    for (int r = 0; r < count; ++r) row_force.data[r] = state[r].force;
    best.data[1] = fault;
    if (fault > T(tolerance)) ++control.data[unsolved];
    control.data[next_updates] = (relaxed + count - 1) / count;
"""

# Rows by partner, in the order of the rows: `partner(r)` is the fiber or -1.
INCOMING = """
    int* const in_end = in_start.data + 1;
    for (int f = 0; f < fibers + 2; ++f) in_start.data[f] = 0;
    for (int r = 0; r < count; ++r)
        if (partner(r) >= 0) ++in_end[partner(r) + 1];
    for (int f = 0; f < fibers; ++f) in_end[f + 1] += in_end[f];
    for (int r = 0; r < count; ++r)
        if (partner(r) >= 0) in_row.data[in_end[partner(r)]++] = r;
"""


def relaxation_texts(name: str, law: str) -> tuple[str, str, str]:
    """C++ text: of the rows, their index by partner, and the solve."""
    real = {"float32": "float", "float64": "double"}[precision(name).name]
    numbers = f"""
    typedef {real} T;
    constexpr double over = {OVER!r}, share = {SHARE!r}, fine = {FINE!r};
    constexpr double broken = {BROKEN!r};
    constexpr double edge = {RANGE - 1.0!r};
    constexpr bool yields = {str(law != "hard").lower()};
    constexpr int next_updates = {NEXT_UPDATES}, unsolved = {UNSOLVED};
"""
    return numbers + OPENING[law] + ROWS, INCOMING, RELAX
