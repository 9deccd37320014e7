"""Rows of contact relaxed by what they do to each other: C++ text of a solve in one part.

When a row first takes another force, what a unit of it does to the balance of every row of its two
fibers is stored. From then on a relaxation is a sum over few rows, those that it puts out of
balance queue up, and the fibers do not move before all rows are within the tolerance; then their
motion is added up anew, and the balances that it leaves are looked at.
Measured, us of a solve, 1000 rods with 1200 rows, mean of strains 4-7, 28-31, 44-47: 229 where
fibers move at once, 178 so.
Source: `native_relaxation`; a coupling n_q.(z_q by a unit force of r), an entry of J S J^T.
Symbols: `balance` e of a row but for what its own softness adds; `touch` coupling and row.
Limits: no friction, whose forces have directions that change. Couplings that do not fit are
    computed whenever they are needed.
"""

HOT_NUMBERS = 4  # of every row: balance, force, low, step
TOUCHES = 16  # couplings per row that there is room for
TOUCH_NUMBERS = 2

TEXT = """
    struct Hot { T balance, force, low, step; };
    struct Touch { T by; int row; };
    static_assert(sizeof(Hot) <= HOT_NUMBERS * sizeof(T), "");
    static_assert(sizeof(Touch) <= TOUCH_NUMBERS * sizeof(T), "");
    Hot* const hots = (Hot*)d.row_hot.data;
    Touch* const touches = (Touch*)d.touches.data;
    int* const touch_at = d.touch_at.data;  // first and one behind the last; -1: not stored
    const int room = (int)(d.touches.shape[0] / TOUCH_NUMBERS);
    int used = 0;
    // the motion of all fibers by the forces of the rows, added up anew
    auto move_all = [&]() {
        __builtin_memset(motion, 0, still * sizeof(T));
        for (int r = 0; r < count; ++r) {
            const T force = rows[r].force;
            if (force == T(0)) continue;
            if (rows[r].at_i != still) push(states[r].fiber_i, r, 0, force);
            if (rows[r].at_j != still) push(states[r].fiber_j, r, 1, force);
        }
    };
    auto soft_of = [&](int r) -> bool { return wet && states[r].soft > T(0); };
    auto moved_by = [&](int r) -> T {
        const Row& row = rows[r];
        const Q* const i = (const Q*)(motion + row.at_i);
        const Q* const j = (const Q*)(motion + row.at_j);
        const Q v = j[0] + row.t * (j[1] - j[0]) - i[0] - row.s * (i[1] - i[0]);
        return row.normal[0] * v[0] + row.normal[1] * v[1] + row.normal[2] * v[2];
    };
    auto balance_of = [&](int r) -> T {
        T e = hots[r].balance;
        if (wet) e += states[r].soft * hots[r].force;
        if (yields && !soft_of(r)) e += opening(r, hots[r].force);
        return e;
    };
    auto fault_of = [&](int r, T e) -> T {
        return hots[r].force == T(0) && !soft_of(r) ? -e : wp::abs(e);
    };
    auto each_coupling = [&](int r, auto tell) {
        const int on[2] = {states[r].fiber_i, states[r].fiber_j};
        for (int side = 0; side < 2; ++side) {
            if ((side == 0 ? rows[r].at_i : rows[r].at_j) == still) continue;
            const auto reply = reply_of(on[side], r, side);
            each_end(on[side], [&](int q, int end) {
                const T e = felt(reply, on[side], q, end);
                tell(q, end == 0 ? -e : e);
            });
        }
    };
    auto prepare = [&](int r) {
        Hot& hot = hots[r];
        T diagonal = T(0);
        const int first = used;
        bool fits = true;
        each_coupling(r, [&](int q, T by) {
            if (q == r) {
                diagonal += by;
                return;
            }
            fits = fits && used < room;
            if (fits) touches[used++] = Touch{by, q};
        });
        if (!fits) used = first;
        touch_at[2 * r] = fits ? first : -1;
        touch_at[2 * r + 1] = used;
        const T soft = states[r].soft, all = diagonal + (soft > T(0) ? soft : softness(r));
        hot.step = all > T(0) ? T(over) / all : T(0);
        if (!(all > T(0))) hot.low = T(broken);  // nothing that it touches can move
        if (soft > T(0)) hot.low = diagonal > T(0) ? small * (all / diagonal) : T(broken);
    };
    long long relaxed = 0;
    // a few rows that are nearly the same take more, and cost nothing
    const long long limit = (long long)d.most * (count > 100 ? count : 100);
    unsigned char* const queued = d.row_queued.data;
    int* const queue = d.row_queue.data;
    int held = 0, head = 0;
    auto visit_later = [&](int q) {
        if (queued[q] || !(fault_of(q, balance_of(q)) > hots[q].low)) return;
        queued[q] = 1;
        const int at = head + held++;
        queue[at < count ? at : at - count] = q;
    };
    auto relax = [&](int r, T part, bool queues) {
        Hot& hot = hots[r];
        const T e = balance_of(r), size = fault_of(r, e);
        if (relaxed >= limit || !(size > part * hot.low)) return;
        if (hot.step < T(0)) {
            prepare(r);
            if (!(size > part * hot.low)) return;
        }
        const T force = hot.force - hot.step * e;
        const T next = states[r].soft == T(0) && force < T(0) ? T(0) : force;
        const T change = next - hot.force;
        relaxed += size > hot.low;
        if (change == T(0)) return;
        hot.force = next;
        auto touch = [&](int q, T by) {
            hots[q].balance += by * change;
            if (queues) visit_later(q);
        };
        const T all = hot.step > T(0) ? T(over) / hot.step : T(0);
        const T own = states[r].soft > T(0) ? states[r].soft : softness(r);
        hot.balance += (all - own) * change;
        if (queues) visit_later(r);
        if (touch_at[2 * r] < 0) {
            each_coupling(r, [&](int q, T by) { if (q != r) touch(q, by); });
            return;
        }
        for (int k = touch_at[2 * r]; k < touch_at[2 * r + 1]; ++k)
            touch(touches[k].row, touches[k].by);
    };
    move_all();
    for (int r = 0; r < count; ++r) {
        const T low = states[r].low >= T(broken) ? T(broken) : small;
        hots[r] = Hot{rows[r].normal[3] + moved_by(r), rows[r].force, low, T(-1)};
        queued[r] = 0;
    }
    for (int r = 0; r < count; ++r) relax(r, T(fine), false);
    for (int r = 0; r < count; ++r) visit_later(r);
    T fault = T(0);
    while (true) {
        while (held > 0 && relaxed < limit) {
            const int r = queue[head];
            head = head + 1 == count ? 0 : head + 1;
            --held;
            queued[r] = 0;
            relax(r, T(1), true);
        }
        for (int r = 0; r < count; ++r) rows[r].force = hots[r].force;
        move_all();
        fault = T(0);
        for (int r = 0; r < count; ++r) {
            Hot& hot = hots[r];
            hot.balance = rows[r].normal[3] + moved_by(r);
            if (hot.low >= T(broken)) continue;
            const T e = balance_of(r), size = fault_of(r, e);
            T mine = size > T(0) ? size : T(0);
            if (hot.step > T(0)) mine *= T(1) - states[r].soft * hot.step / T(over);
            if (!(mine < T(broken)) || e != e) mine = T(broken);
            fault = wp::max(fault, mine);
            if (mine > T(d.tolerance) && mine < T(broken)) visit_later(r);
        }
        // what small changes have added up to on rows that nobody visited again
        if (held == 0 || relaxed >= limit) break;
    }
    d.best.data[1] = fault;
    if (fault > T(d.tolerance)) ++d.control.data[unsolved];
    d.control.data[next_updates] = (int)((relaxed + count - 1) / count);
    return;
"""


def coupling_text() -> str:
    """The solve; behind `reply_of(f, r, side)`, `felt(reply, f, q, end)` and `push`."""
    text = TEXT.replace("HOT_NUMBERS", str(HOT_NUMBERS))
    return text.replace("TOUCH_NUMBERS", str(TOUCH_NUMBERS))
