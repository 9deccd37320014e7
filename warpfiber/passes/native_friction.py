"""Friction of a relaxation: C++ text of what a row with a tangential force has more.

After its normal force every row takes the tangential force that is right for it alone: the one
within the disc |F| <= mu f that leaves no slip, or else on its edge and against the slip that it
leaves. That is the smallest of a quadratic form on a disc,
        S(F) = S_0 + D F = -lambda F,  lambda >= 0,  lambda (mu f - |F|) = 0
found in the principal directions of D by Newton's rule for 1/|F(lambda)|, which rises to the root.
Source: block Gauss-Seidel of Coulomb's law; law `surface_slip`; More & Sorensen 1983 for the disc.
Symbols: S slip over the step in the plane of the contact, D what a unit force does to it, a 2x2
    matrix with principal numbers `soft` and directions turned by (`cosine`, `sine`); `first`,
    `second` unit vectors of the plane, behind them the slip without any force; arm (a/l) p, behind
    it (a/l) n.p; roll a n x p. The angle of a fiber about its axis is the fourth number of its
    first node in `motion`. The fault of a row is the slip |D dF| that its next force would undo.
Limits: rows with a compliance have no friction.
"""

RUB_NUMBERS = 36  # of every row, at most

# `column(f, r, side, c)`: motion of fiber f by a unit force of row r along its direction c.
RUB_NAMES = """
    struct Side { Q arm, roll; };
    struct Rub {
        Q first, second;
        Side side[2];
        T force[2], soft[2], cosine, sine, mu;
        int spin[2];
    };
    static_assert(sizeof(Rub) <= RUB_NUMBERS * sizeof(T), "");
    Rub* const rubs = (Rub*)d.row_rub.data;
    auto dot3 = [](const Q& a, const Q& b) -> T { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
    auto cross3 = [](const Q& a, const Q& b) -> Q {
        return Q{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
                 T(0)};
    };
    // the part of its force that Coulomb's law leaves a row, known up to the tolerance else
    auto rub_share = [&](int r) -> T {
        const Rub& rub = rubs[r];
        const T limit = rub.mu * rows[r].force;
        const T size2 = rub.force[0] * rub.force[0] + rub.force[1] * rub.force[1];
        return size2 > limit * limit ? limit / wp::sqrt(size2) : T(1);
    };
    // force on the surface at one side of a row along a direction: on both nodes, and the couple
    struct Pull { Q whole, couple; T torque; };
    auto pull_of = [&](int r, int side, const Q& along) -> Pull {
        const Side& on = rubs[r].side[side];
        const Q n = {rows[r].normal[0], rows[r].normal[1], rows[r].normal[2], T(0)};
        const Q t = {along[0], along[1], along[2], T(0)};
        return Pull{side == 0 ? -t : t, dot3(on.arm, t) * n - on.arm[3] * t, dot3(on.roll, t)};
    };
    // slip that the motion of a fiber leaves at one side of a row; `at`, `spin`: places in it
    auto slip_by = [&](int r, int side, const T* mine, int at, int spin) -> Q {
        const Row& row = rows[r];
        const Side& on = rubs[r].side[side];
        const Q* const z = (const Q*)(mine + at);
        const Q turn = z[1] - z[0], move = z[0] + (side == 0 ? row.s : row.t) * turn;
        const Q lever = dot3(row.normal, turn) * on.arm - on.arm[3] * turn + mine[spin] * on.roll;
        return side == 0 ? lever - move : lever + move;
    };
"""

# In the stage ROWS, for a row of fibers f and states[r].fiber_j.
RUB_READY = """
            {
                Rub& rub = rubs[r];
                const Q n = {row.normal[0], row.normal[1], row.normal[2], T(0)};
                const int segments[2] = {d.row_i.data[given], d.row_j.data[given]};
                const int on[2] = {f, state.fiber_j}, at[2] = {row.at_i, row.at_j};
                rub.mu = state.soft > T(0) ? T(0)
                    : (segments[1] < 0 ? d.wall_friction : d.friction);
                rub.soft[0] = rub.soft[1] = T(-1);
                Q along = n;
                for (int side = 0; side < 2; ++side) {
                    rub.side[side] = Side{};
                    rub.spin[side] = at[side] == still ? still : d.fiber_at.data[on[side]] + 3;
                    if (segments[side] < 0) continue;
                    const int node = d.segment_node.data[segments[side]];
                    const auto& x0 = d.node_start.data[node];
                    const auto& x1 = d.node_start.data[node + 1];
                    const Q edge = {x1[0] - x0[0], x1[1] - x0[1], x1[2] - x0[2], T(0)};
                    const T length = wp::sqrt(dot3(edge, edge));
                    const T radius = d.groups.data[d.fiber_group.data[on[side]]].radius;
                    const Q axis = edge * (T(1) / length);
                    if (side == 0) along = axis;
                    rub.side[side].arm = axis * (radius / length);
                    rub.side[side].arm[3] = dot3(n, axis) * (radius / length);
                    rub.side[side].roll = radius * cross3(n, axis);
                }
                Q flat = along - dot3(along, n) * n;
                if (dot3(flat, flat) < T(0.01)) {
                    const int axis = wp::abs(n[0]) < T(0.5) ? 0 : 1;
                    Q other = {T(0), T(0), T(0), T(0)};
                    other[axis] = T(1);
                    flat = other - n[axis] * n;
                }
                rub.first = flat * (T(1) / wp::sqrt(dot3(flat, flat)));
                rub.second = cross3(n, rub.first);
                const auto& slip = d.row_slip.data[given];
                const auto& last = d.row_friction.data[given];
                const Q s = {slip[0], slip[1], slip[2], T(0)};
                const Q b = {last[0], last[1], last[2], T(0)};
                rub.force[0] = dot3(b, rub.first);
                rub.force[1] = dot3(b, rub.second);
                rub.first[3] = dot3(s, rub.first);
                rub.second[3] = dot3(s, rub.second);
                const T share = rub_share(r);
                rub.force[0] *= share;
                rub.force[1] *= share;
            }
"""

# After `column`.
RUB_FORCES = """
    auto rub_push = [&](int f, int r, int side, T one, T two) {
        T* const mine = motion + d.fiber_at.data[f];
        const T by[2] = {one, two};
        for (int c = 0; c < 2; ++c) {
            if (by[c] == T(0)) continue;
            const T* const column = rub_column(f, r, side, c);
            for (int k = 0; k < size_of(f); ++k) mine[k] += by[c] * column[k];
        }
    };
    auto rub_prepare = [&](int r) {
        const Row& row = rows[r];
        Rub& rub = rubs[r];
        const int on[2] = {states[r].fiber_i, states[r].fiber_j}, at[2] = {row.at_i, row.at_j};
        T by[2][2] = {{T(0), T(0)}, {T(0), T(0)}};
        for (int c = 0; c < 2; ++c)
            for (int side = 0; side < 2; ++side) {
                if (at[side] == still) continue;
                const T* const column = rub_column(on[side], r, side, c);
                for (int end = 0; end < 2; ++end) {  // a fiber may meet itself, or its own image
                    if (on[end] != on[side]) continue;
                    const int from = d.fiber_at.data[on[end]];
                    const Q slip = slip_by(r, end, column, at[end] - from, rub.spin[end] - from);
                    by[c][0] += dot3(slip, rub.first);
                    by[c][1] += dot3(slip, rub.second);
                }
            }
        const T cross = T(0.5) * (by[0][1] + by[1][0]), half = T(0.5) * (by[0][0] - by[1][1]);
        const T size = wp::sqrt(half * half + cross * cross), mean = T(0.5) * (by[0][0] + by[1][1]);
        // (cos, sin) of half the angle of (half, cross)
        rub.cosine = size > T(0) ? wp::sqrt(T(0.5) * (T(1) + wp::abs(half) / size)) : T(1);
        rub.sine = size > T(0) ? T(0.5) * cross / (size * rub.cosine) : T(0);
        if (half < T(0)) {
            const T kept = rub.cosine;
            rub.cosine = wp::abs(rub.sine);
            rub.sine = cross < T(0) ? -kept : kept;
        }
        const T least = T(1e-6) * mean;
        rub.soft[0] = mean + size;
        rub.soft[1] = mean - size > least ? mean - size : least;
    };
    // change of the two forces of a row that is right for it alone; the slip that it undoes
    struct Step { T one, two, size; };
    auto rub_step = [&](int r) -> Step {
        const Row& row = rows[r];
        Rub& rub = rubs[r];
        const T limit = rub.mu * row.force;
        if (rub.mu == T(0) || states[r].low >= T(broken)) return Step{T(0), T(0), T(0)};
        if (limit == T(0) && rub.force[0] == T(0) && rub.force[1] == T(0))
            return Step{T(0), T(0), T(0)};
        if (rub.soft[0] < T(0)) rub_prepare(r);
        const Q moved = slip_by(r, 0, motion, row.at_i, rub.spin[0])
            + slip_by(r, 1, motion, row.at_j, rub.spin[1]);
        const T one = rub.first[3] + dot3(moved, rub.first);
        const T two = rub.second[3] + dot3(moved, rub.second);
        const T u = rub.cosine * one + rub.sine * two, v = rub.cosine * two - rub.sine * one;
        const T fu = rub.cosine * rub.force[0] + rub.sine * rub.force[1];
        const T fv = rub.cosine * rub.force[1] - rub.sine * rub.force[0];
        const T du = rub.soft[0], dv = rub.soft[1], u0 = u - du * fu, v0 = v - dv * fv;
        T lambda = T(0), nu = -u0 / du, nv = -v0 / dv;
        T size2 = nu * nu + nv * nv;
        if (size2 > limit * limit) {
            for (int k = 0; limit > T(0) && k < 50; ++k) {
                const T size = wp::sqrt(size2);
                if (!(size > limit * (T(1) + T(RUB_EPS)))) break;
                const T q = nu * nu / (du + lambda) + nv * nv / (dv + lambda);
                lambda += size2 / q * (size - limit) / limit;
                nu = -u0 / (du + lambda);
                nv = -v0 / (dv + lambda);
                size2 = nu * nu + nv * nv;
            }
            const T share = size2 > T(0) ? limit / wp::sqrt(size2) : T(0);
            nu *= share;
            nv *= share;
        }
        const T cu = nu - fu, cv = nv - fv;
        const T size = wp::sqrt(du * du * cu * cu + dv * dv * cv * cv);
        return Step{rub.cosine * cu - rub.sine * cv, rub.sine * cu + rub.cosine * cv, size};
    };
"""

# `press` is the relaxation of the normal force.
RUB_RELAX = """
    auto relax = [&](int r, T part) -> bool {
        const bool pressed = press(r, part);
        const Step step = rub_step(r);
        if (!(step.size > part * small)) return pressed;
        Rub& rub = rubs[r];
        rub.force[0] += step.one;
        rub.force[1] += step.two;
        if (rows[r].at_i != still) rub_push(states[r].fiber_i, r, 0, step.one, step.two);
        if (rows[r].at_j != still) rub_push(states[r].fiber_j, r, 1, step.one, step.two);
        if (!(step.size > small)) return pressed;
        ++relaxed;
        return true;
    };
"""

RUB_ADD = """
            if (rubs[r].force[0] != T(0) || rubs[r].force[1] != T(0)) {
                const T share = rub_share(r);
                rub_push(f, r, side, share * rubs[r].force[0], share * rubs[r].force[1]);
            }
"""

RUB_FAULT = """
            const T slipped = rub_step(r).size;
            mine = wp::max(mine, slipped == slipped ? slipped : T(broken));
"""

RUB_LEAVE = """
        for (int k = 0; k < owned(f); ++k) {
            const Rub& rub = rubs[row_first(f) + k];
            const T share = rub_share(row_first(f) + k);
            const T one = share * rub.force[0], two = share * rub.force[1];
            for (int c = 0; c < 3; ++c)
                d.row_friction.data[row_given(f) + k][c] = one * rub.first[c] + two * rub.second[c];
        }
"""

# On the nodes k and k + 1 of fiber f from one side of row r.
RUB_NODES = """
            const Rub& rub = rubs[r];
            const Q flat = rub.force[0] * rub.first + rub.force[1] * rub.second;
            const Pull pull = pull_of(r, side, rub_share(r) * flat);
            for (int c = 0; c < 3; ++c) {
                d.node_push.data[k][c] += (T(1) - share) * pull.whole[c] - pull.couple[c];
                d.node_push.data[k + 1][c] += share * pull.whole[c] + pull.couple[c];
            }
"""


def rubbing(text: str, name: str, friction: bool) -> str:
    """The text of a relaxation with what it has more with friction, or without that."""
    parts = {
        "READY_FRICTION": RUB_READY,
        "ADD_FRICTION": RUB_ADD,
        "RELAX_FRICTION": RUB_RELAX,
        "FAULT_FRICTION": RUB_FAULT,
        "LEAVE_FRICTION": RUB_LEAVE,
        "PUSH_FRICTION": RUB_NODES,
        "PRESS": "press",
        "RUB_NUMBERS": str(RUB_NUMBERS),
        "RUB_EPS": {"float32": "1e-5", "float64": "1e-10"}[name],
    }
    for key, more in parts.items():
        alone = "relax" if key == "PRESS" else ""
        text = text.replace(key, more if friction else alone)
    return text
