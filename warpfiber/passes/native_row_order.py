"""Rows of contact in the order of a relaxation: C++ text of its first two stages.

Fibers are put in order along one axis and cut into parts with about as many ends of rows; rows are
those of the fibers in this order, each with where the motions of its two fibers are.
Source: `native_relaxation`.
Symbols: d the struct of `relaxation_work`; a row is `given` in the order of `contact_rows`.
"""

BINS = 1024  # of places between which fibers are cut into parts
ROW_NUMBERS, STATE_NUMBERS = 9, 5  # of every row, at most
STILL = 32  # numbers behind all motions, which stay 0: of walls and of fibers that are held

# Rows are numbered in the order of the fibers here: own ones of fiber f from row_first(f) to
# row_last(f), as they are from row_given(f) on; those that it is the partner of are in `in_row`.
# Its motion: `size_of(f)` numbers from fiber_at[f] on.
NAMES = """
    typedef T Q __attribute__((ext_vector_type(4), aligned(sizeof(T))));
    struct Row { Q normal; T s, t, force; int at_i, at_j; };  // behind the normal its base
    struct State { T low, step, soft; int fiber_i, fiber_j; };
    static_assert(sizeof(Row) <= ROW_NUMBERS * sizeof(T), "");
    static_assert(sizeof(State) <= STATE_NUMBERS * sizeof(T), "");
    Row* const rows = (Row*)d.row_place.data;
    State* const states = (State*)d.row_state.data;
    T* const motion = d.motion.data;
    const int fibers = d.fibers, count = d.row_count.data[0];
    const int still = (int)d.motion.shape[0] - STILL;
    const T small = T(share * d.tolerance);
    const bool wet = d.part_start.data[d.parts + 1] != 0;  // some rows have a compliance
    auto row_given = [&](int f) -> int {
        return d.row_out_start.data[d.fiber_node_start.data[f] - f];
    };
    auto owned = [&](int f) -> int {
        return d.row_out_start.data[d.fiber_node_start.data[f + 1] - f - 1] - row_given(f);
    };
    auto partner = [&](int given) -> int {
        const int segment = d.row_j.data[given];
        return segment < 0 ? -1 : d.segment_fiber.data[segment];
    };
    auto row_first = [&](int f) -> int { return d.fiber_row.data[f]; };
    auto row_last = [&](int f) -> int { return d.fiber_row.data[f] + owned(f); };
    auto is_fixed = [&](int f) -> bool {
        return f < 0 || (d.fiber_frozen.shape[0] > 0 && d.fiber_frozen.data[f]);
    };
    // each row end of fiber f: its own rows, then those that it is the partner of
    auto each_end = [&](int f, auto look) {
        // read before anything is written, which might be any of them
        const int first = row_first(f), last = row_last(f);
        const int in_first = d.in_start.data[f], in_last = d.in_start.data[f + 1];
        const int* const in_row = d.in_row.data;
        for (int r = first; r < last; ++r) look(r, 0);
        for (int k = in_first; k < in_last; ++k) look(in_row[k], 1);
    };
"""

# Order of the fibers, parts, places of the motions, rows by partner. In order along the axis of the
# cuts what is near in the cell is near in memory.
BEGIN_TEXT = """
    int& some_wet = d.part_start.data[d.parts + 1];
    some_wet = 0;
    for (int r = 0; r < count; ++r) some_wet |= d.row_compliance.data[r] != T(0);
    int* const in_end = d.in_start.data + 1;
    for (int f = 0; f < fibers + 2; ++f) d.in_start.data[f] = 0;
    for (int r = 0; r < count; ++r)
        if (partner(r) >= 0) ++in_end[partner(r) + 1];
    for (int f = 0; f < fibers; ++f) in_end[f + 1] += in_end[f];
    // in_end[f]: where the rows of f begin, until they are filled in
    d.end_start.data[0] = 0;
    for (int f = 0; f < fibers; ++f)
        d.end_start.data[f + 1] = d.end_start.data[f] + owned(f) + in_end[f + 1] - in_end[f];
    auto middle = [&](int f, int axis) -> double {
        const int first = d.fiber_node_start.data[f], last = d.fiber_node_start.data[f + 1] - 1;
        return 0.5 * (d.node_start.data[first][axis] + d.node_start.data[last][axis]);
    };
    int along = 0;
    double low = 0.0, high = 0.0, least_reach = 0.0;
    for (int axis = 0; axis < 3 && d.parts > 1; ++axis) {
        double from = middle(0, axis), to = from, reach = 0.0;
        for (int f = 0; f < fibers; ++f) {
            const double x = middle(f, axis);
            from = x < from ? x : from;
            to = x > to ? x : to;
            const double half = x - d.node_start.data[d.fiber_node_start.data[f]][axis];
            reach += half < 0.0 ? -half : half;
        }
        // a cut through a periodic axis needs another one
        reach = (1.0 + d.wraps[axis]) * reach / (to > from ? to - from : 1e-30);
        if (axis > 0 && reach >= least_reach) continue;
        along = axis;
        low = from;
        high = to;
        least_reach = reach;
    }
    auto bin_of = [&](int f) -> int {
        const int bin = high > low ? (int)((middle(f, along) - low) / (high - low) * BINS) : 0;
        return bin < 0 ? 0 : (bin < BINS ? bin : BINS - 1);
    };
    if (d.parts > 1) {
        int bin_at[BINS + 1] = {0};
        for (int f = 0; f < fibers; ++f) ++bin_at[bin_of(f) + 1];
        for (int bin = 0; bin < BINS; ++bin) bin_at[bin + 1] += bin_at[bin];
        for (int f = 0; f < fibers; ++f) d.fiber_order.data[bin_at[bin_of(f)]++] = f;
    } else {
        for (int f = 0; f < fibers; ++f) d.fiber_order.data[f] = f;
    }
    const long long whole = fibers + d.end_start.data[fibers];
    long long sum = 0;
    int at = 0, row = 0;
    for (int p = 0; p <= d.parts; ++p) d.part_start.data[p] = fibers;
    for (int q = 0; q < fibers; ++q) {
        const int f = d.fiber_order.data[q];
        const int weight = 1 + d.end_start.data[f + 1] - d.end_start.data[f];
        const int p = d.parts > 1 ? (int)((2 * sum + weight) * d.parts / (2 * whole)) : 0;
        sum += weight;
        for (int k = p; k >= 0 && d.part_start.data[k] > q; --k) d.part_start.data[k] = q;
        d.fiber_part.data[f] = p;
        d.fiber_at.data[f] = at;
        d.fiber_row.data[f] = row;
        at += size_of(f);
        for (int given = row_given(f), last = given + owned(f); given < last; ++given, ++row)
            if (partner(given) >= 0) d.in_row.data[in_end[partner(given)]++] = row;
    }
    return;
"""

# Rows of the fibers of a part; `ready(f)` beside.
ROWS_TEXT = """
    for (int q = d.part_start.data[part]; q < d.part_start.data[part + 1]; ++q) {
        const int f = d.fiber_order.data[q];
        d.fiber_queued.data[f] = 0;
        ready(f);
        int given = row_given(f);
        for (int r = row_first(f); r < row_last(f); ++r, ++given) {
            Row& row = rows[r];
            State& state = states[r];
            const auto& n = d.row_normal.data[given];
            state.soft = d.row_compliance.data[given];
            row.normal = Q{n[0], n[1], n[2], d.row_base.data[given]};
            row.s = d.row_s.data[given];
            row.t = d.row_t.data[given];
            row.force = d.row_force.data[given];
            if (state.soft == T(0) && row.force < T(0)) row.force = T(0);
            auto place = [&](int g, int segment) -> int {
                if (is_fixed(g)) return still;
                const int node = d.segment_node.data[segment] - d.fiber_node_start.data[g];
                return d.fiber_at.data[g] + 4 * node;
            };
            state.fiber_i = f;
            state.fiber_j = partner(given);
            row.at_i = place(f, d.row_i.data[given]);
            row.at_j = place(state.fiber_j, d.row_j.data[given]);
            // D when the row is first relaxed; nothing moves between two that are held
            const bool held = row.at_i == still && row.at_j == still;
            state.low = held && !yields && state.soft == T(0) ? T(broken) : T(0);
            state.step = T(-1);
READY_FRICTION        }
    }
    return;
"""


def named(text: str) -> str:
    """The text with the numbers above."""
    numbers = {
        "ROW_NUMBERS": ROW_NUMBERS,
        "STATE_NUMBERS": STATE_NUMBERS,
        "STILL": STILL,
        "BINS": BINS,
    }
    for key, value in numbers.items():
        text = text.replace(key, str(value))
    return text
