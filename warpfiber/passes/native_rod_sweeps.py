"""Hard contact rows of rods, all in one part: C++ text of a solve of which every row is short.

A row reads and moves eight numbers of each of its two rods, scaled so that it needs the same eight
for both: its balance is their product, its change their multiple. So a pass over all rows costs
little, and most are balanced after SWEEPS of them; then those that are not queue up, and after one
is relaxed the other rows of its two rods that it put out of balance.
Measured, us of a solve, 1000 rods with 1100 to 1250 rows, mean of strains 0-60: 194 by couplings,
110 so; of over-relaxed sweeps one leaves 525 rows in the queue, two 308, three 168, four 100, where
every other sweep goes backwards three 312.

Source: `native_relaxation`; J S J^T = A A^T with the rows of A as below, S the mobility.
Symbols: N = -n on i, n on j; l = 2 s - 1; p direction of the rod,
    A = (sqrt(push) N, 0, sqrt(twist) l (N - (p.N) p), 0)
    of either rod, z = sum of f A over its rows: m = sqrt(push) z_0..2, d = sqrt(twist) z_4..6.
Limits: no friction, no row with a compliance, no law: those are relaxed by `native_row_coupling`.
"""

SWEEPS = 3
SWEEP_NUMBERS = 21  # of every row, at most

# In place of the stages of a relaxation; behind `named` text of rows and the rods.
TEXT = """
    typedef T E __attribute__((ext_vector_type(8), aligned(sizeof(T))));
    struct Sweep { E on_i, on_j; T base, force, step; int i, j; };
    static_assert(sizeof(Sweep) <= SWEEP_NUMBERS * sizeof(T), "");
    Sweep* const sweeps = (Sweep*)row_sweeps.data;
    E* const moves = (E*)motion;  // of every rod, then of what is held
    auto total = [](E x) -> T {
        const Q half = x.lo + x.hi;
        return half[0] + half[1] + half[2];
    };
    if (stage == ROWS_STAGE) {
        __builtin_memset(motion, 0, (fibers + 1) * sizeof(E));
        int last_group = -1;
        for (int f = 0; f < fibers; ++f) {
            const int group = d.fiber_group.data[f];
            if (group == last_group) {
                rods[f] = Rod{axis_of(f), rods[f - 1].push, rods[f - 1].twist};
                continue;
            }
            last_group = group;
            ready(f);
            rods[f].push = wp::sqrt(rods[f].push);
            rods[f].twist = wp::sqrt(rods[f].twist);
        }
        for (int r = 0; r < count; ++r) {
            Sweep& row = sweeps[r];
            const auto& given = d.row_normal.data[r];
            const Q n = {given[0], given[1], given[2], T(0)};
            auto side = [&](int f, Q towards, T share) -> E {
                E all = E(T(0));
                if (is_fixed(f)) return all;
                const Q axis = rods[f].axis;
                all.lo = rods[f].push * towards;
                all.hi = (rods[f].twist * (T(2) * share - T(1)))
                    * (towards - dot(axis, towards) * axis);
                return all;
            };
            const int f = d.segment_fiber.data[d.row_i.data[r]], g = partner(r);
            row.on_i = side(f, -n, d.row_s.data[r]);
            row.on_j = side(g, n, d.row_t.data[r]);
            row.i = is_fixed(f) ? fibers : f;
            row.j = is_fixed(g) ? fibers : g;
            // a rod may meet its own image
            const E both = f == g ? row.on_i + row.on_j : row.on_i;
            const T diagonal = total(both * both)
                + (f == g ? T(0) : total(row.on_j * row.on_j));
            row.step = diagonal > T(0) ? T(over) / diagonal : T(0);
            row.base = d.row_base.data[r];
            const T force = d.row_force.data[r];
            row.force = force > T(0) ? force : T(0);
            moves[row.i] += row.force * row.on_i;
            moves[row.j] += row.force * row.on_j;
        }
        return;
    }
    if (stage == REST_STAGE) return;
    if (stage == END_STAGE) {
        for (int r = 0; r < count; ++r) d.row_force.data[r] = sweeps[r].force;
        for (int f = 0; f < fibers; ++f) {
            const Q middle = rods[f].push * moves[f].lo, turn = rods[f].twist * moves[f].hi;
            const Q first = middle - turn, last = middle + turn;
            for (int c = 0; c < 3; ++c) {
                d.node_shift.data[2 * f][c] = first[c];
                d.node_shift.data[2 * f + 1][c] = last[c];
            }
        }
        return;
    }
    auto balance_of = [&](const Sweep& row) -> T {
        return row.base + total(moves[row.i] * row.on_i + moves[row.j] * row.on_j);
    };
    // none where nothing can give way
    auto fault_at = [&](const Sweep& row, T e) -> T {
        return row.step == T(0) ? T(0) : (row.force > T(0) ? wp::abs(e) : -e);
    };
    auto relax = [&](Sweep& row) -> T {  // by how much it was out of balance
        const T e = balance_of(row), next = row.force - row.step * e;
        const T force = next > T(0) ? next : T(0), change = force - row.force;
        const T fault = fault_at(row, e);
        row.force = force;
        moves[row.i] += change * row.on_i;
        moves[row.j] += change * row.on_j;
        return fault;
    };
    auto fault_of = [&](const Sweep& row) -> T { return fault_at(row, balance_of(row)); };
    long long relaxed = 0;
    // a few rows that are nearly the same take more, and cost nothing
    const long long limit = (long long)d.most * (count > 100 ? count : 100);
    unsigned char* const queued = d.row_queued.data;
    int* const queue = d.row_queue.data;
    int held = 0, head = 0;
    auto visit_later = [&](int r) {
        if (queued[r]) return;
        queued[r] = 1;
        const int at = head + held++;
        queue[at < count ? at : at - count] = r;
    };
    auto look_at = [&](int r) {
        if (fault_of(sweeps[r]) > small) visit_later(r);
    };
    for (int sweep = 0; sweep < SWEEPS && relaxed < limit; ++sweep)
        for (int r = 0; r < count; ++r) relaxed += relax(sweeps[r]) > small;
    for (int r = 0; r < count; ++r) queued[r] = 0;
    for (int r = 0; r < count; ++r) look_at(r);
    T fault = T(0);
    while (true) {
        while (held > 0 && relaxed < limit) {
            const int r = queue[head];
            head = head + 1 == count ? 0 : head + 1;
            --held;
            queued[r] = 0;
            if (!(relax(sweeps[r]) > small)) continue;
            ++relaxed;
            const int on[2] = {sweeps[r].i, sweeps[r].j};
            for (int side = 0; side < 2; ++side)
                if (on[side] < fibers) each_end(on[side], [&](int q, int) { look_at(q); });
        }
        // what was added and taken away along the way leaves rounding
        __builtin_memset(motion, 0, (fibers + 1) * sizeof(E));
        for (int r = 0; r < count; ++r) {
            if (sweeps[r].force == T(0)) continue;
            moves[sweeps[r].i] += sweeps[r].force * sweeps[r].on_i;
            moves[sweeps[r].j] += sweeps[r].force * sweeps[r].on_j;
        }
        fault = T(0);
        for (int r = 0; r < count; ++r) {
            const T size = fault_of(sweeps[r]);
            const T mine = size < T(broken) ? wp::max(size, T(0)) : T(broken);
            fault = wp::max(fault, mine);
            if (mine > T(d.tolerance) && mine < T(broken)) visit_later(r);
        }
        if (held == 0 || relaxed >= limit) break;
    }
    d.best.data[1] = fault;
    if (fault > T(d.tolerance)) ++d.control.data[unsolved];
    d.control.data[next_updates] = (int)((relaxed + count - 1) / count);
    return;
"""


def sweeps_text() -> str:
    """The solve; behind the names of `native_row_order`, `ready`, `rods` and `dot`."""
    text = TEXT.replace("SWEEP_NUMBERS", str(SWEEP_NUMBERS))
    return text.replace("SWEEPS", str(SWEEPS))
