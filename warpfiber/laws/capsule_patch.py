"""Share of two segments in the patch where their fibers touch: energy, gradient, stiffness.

A patch is cut into slices; the energy of a pair of segments is that of the slices which cross both,
so it depends on their four nodes alone, passes to the next segments without a jump, and a patch
within both has the energy of Hertz, 8/15 E* f delta^2.5, at any angle. Forces are its exact
gradient: they can neither gain nor lose energy.
Source: Hertz with f = sqrt(R*) F_2^-1.5 (`capsule_contact`). Slices lie across the mean direction m
    of both, at equal lengths from where the endless lines pass each other. With D from one axis to
    the other in a slice and y = |dD/du| u its way across,
        E = w f E*/2 (b + h)^-2.5 integral (b^2 - D^2)^2 dy,
    h the smallest D along both and a little beyond. There are two mean directions; w leads from
    that of the smaller angle alone, up to 60 degrees, to half of each at 90. Along parallel
    cylinders this is a force of c pi/4 E* per length and overlap. A tip: slices across the other
    segment, f of hemisphere and cylinder.
Symbols: b = r_a + r_b, a and b edges, delta from start to start, D(u) = d_0 + u dv at the part u of
    a and t_0 + u ratio of b, sigma = 1 for the mean direction of a and b, -1 for that of a and -b.
Limits: sin(angle) is taken as 0.02 at least, where c = 1.17 instead of 1 of parallel cylinders;
    from there to 0.03 the energy changes with the angle without a moment. Where a patch reaches far
    into other segments these take another slice for the deepest one: second order in overlap /
    radius. Across a bend in the plane of D slices of neighbors leave out a wedge (outside) or
    share one (inside): at a node that bends by 14 degrees the force is 0.5 to 1.8 times that
    between nodes, 0.9 and 1.2 times on average along a segment; beside that plane 1.01 times.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision

# Below this angle all slices are equally deep, to rounding.
PARALLEL = {"float32": 1e-5, "float64": 1e-9}
# Below it the fit F_2 nears its zero: 100 times the energy per rad would turn fibers apart.
TURNING_SINE = 0.03
# Mean lengths beyond both segments in which the deepest slice is looked for. With more bent fibers
# that touch side by side would meet where their edges cross; with less most patches are not whole.
BEYOND = 0.25
BOTH_WAYS = 0.5  # cosine below which slices lie across both mean directions


@cache
def make_capsule_patch(name):
    """`side_share` of two segments, `tip_share` of a point and a segment.

    Both return energy, stiffness, stiffness that dashpots feel, where they act (lengths along the
    segments), depth, and the energy's gradient by delta and by the segments.
    """
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    zero, half, one, two, four = (real(x) for x in (0.0, 0.5, 1.0, 2.0, 4.0))
    third, fifth, power = real(1.0 / 3.0), real(0.2), real(2.5)
    tiny = real(1.0e-30)
    further = real(0.5 * BEYOND)
    near, parallel2 = real(PARALLEL[name]), real(PARALLEL[name] ** 2)

    @wp.func
    def overlap_at(q: real, slope: real, ww: real, x: real) -> real:
        """o = b^2 - D^2 a way x from where it is q."""
        return q - (two * slope + ww * x) * x

    @wp.func
    def slices(q: real, slope: real, ww: real, x1: real, x2: real) -> vec4:
        """Integrals of o^2, o, o x, o x^2 from x1 to x2, by the expansion of o about the middle."""
        x = half * (x1 + x2)
        r = half * (x2 - x1)
        o0 = overlap_at(q, slope, ww, x)
        o1 = -two * r * (slope + ww * x)
        o2 = -ww * r * r
        square = o0 * o0 + third * (o1 * o1 + two * o0 * o2) + fifth * o2 * o2
        whole = o0 + third * o2
        first = third * o1
        second = third * o0 + fifth * o2
        width = two * r
        return width * vec4(
            square,
            whole,
            x * whole + r * first,
            x * (x * whole + two * r * first) + r * r * second,
        )

    @wp.func
    def beyond_zero(x: real, rounding: real) -> real:
        """1 beyond, 0 before; half where ends face each other and rounding would decide."""
        return wp.where(x > rounding, one, wp.where(x < -rounding, zero, half))

    @wp.func
    def side_share(
        delta: vec3,
        along_a: vec3,
        along_b: vec3,
        la: real,
        lb: real,
        by_la: real,
        by_lb: real,
        reach: real,
        weight: real,
        wider: real,
        by_ww: real,
        leading: real,
        forward: wp.bool,
    ):
        """Of slices across e; weight = E* f sine times the part of this way; forward: sigma = 1.

        by_la = 1 / la; by_lb = sigma / lb; wider = 1 / (1 + cosine); by_ww = 1 / w^2; leading =
        d ln of that part / d cosine.
        """
        nothing = vec3(zero, zero, zero)
        e = along_a + along_b
        w = along_b - along_a
        offset = -wp.dot(delta, e) * wider
        d0 = delta + offset * along_b
        # where b begins and ends along a
        first = wp.where(forward, -offset, -offset - lb)
        last = first + lb
        low = wp.max(zero, first)
        high = wp.min(la, last)
        if high <= low:
            return zero, zero, zero, zero, zero, zero, nothing, nothing, nothing
        ww = wp.max(wp.dot(w, w), parallel2)
        deepest = wp.where(ww > parallel2, -wp.dot(d0, w) * by_ww, half * (low + high))
        beyond = further * (la + lb)
        ahead = wp.min(zero, first) - beyond
        behind = wp.max(la, last) + beyond
        u_h = wp.min(wp.max(deepest, ahead), behind)
        nearest = d0 + u_h * w
        hh = wp.dot(nearest, nearest)
        if hh >= reach * reach:
            return zero, zero, zero, zero, zero, zero, nothing, nothing, nothing
        h = wp.sqrt(hh)
        wide = reach + h
        q = (reach - h) * wide
        slope = wp.dot(nearest, w)
        # where slices overlap; along parallel segments far beyond both
        root = wp.sqrt(slope * slope + ww * q)
        begin = low - u_h
        end = high - u_h
        x1 = wp.max(begin, -(root + slope) * by_ww)
        x2 = wp.min(end, (root - slope) * by_ww)
        if x2 - x1 <= near * la:  # ends that face each other share nothing yet
            return zero, zero, zero, zero, zero, zero, nothing, nothing, nothing
        sums = slices(q, slope, ww, x1, x2)
        by_h = one / (h * wide)
        by_wide = by_h * h
        by_root = wp.sqrt(by_wide)
        # y = 2 tan(angle / 2) times the way along the mean direction
        rigid = weight * wp.sqrt(two * wider)
        scale = half * rigid * by_wide * by_wide * by_root
        energy = scale * sums[0]
        stiffness = rigid * (x2 - x1) * by_root
        whole_patch = wp.min(two * root * by_ww, half * (la + lb))
        parts = one / wp.max(whole_patch * sums[1], tiny)
        damped = stiffness * (x2 - x1) * (parts * sums[1])
        place = u_h + sums[2] * (parts * whole_patch)

        # dE by D, at U = 0 and times U; by h; by the ends of a and b
        pull = -four * scale
        deeper = (-power * energy * by_h) * nearest
        whole = (pull * sums[1]) * nearest + (pull * sums[2]) * w + deeper
        moment = (pull * sums[2]) * nearest + (pull * sums[3]) * w + u_h * whole
        o = overlap_at(q, slope, ww, x2)
        at_high = wp.where(x2 >= end, scale * o * o, zero)
        at_last = beyond_zero(la - last, near * la) * at_high
        o = overlap_at(q, slope, ww, x1)
        at_first = wp.where(x1 <= begin, scale * o * o, zero)
        at_first *= -beyond_zero(first, near * la)
        by_length_a = at_high - at_last
        held = wp.dot(deeper, w)
        # where the deepest slice is beyond both
        is_ahead = deepest < ahead
        is_behind = deepest > behind
        at_first += wp.where(is_ahead, beyond_zero(-first, near * la) * held, zero)
        ends = beyond_zero(last - la, near * la)
        at_last += wp.where(is_behind, ends * held, zero)
        by_length_a += wp.where(is_behind, (one - ends) * held, zero)
        stretched = wp.where(is_behind, further, wp.where(is_ahead, -further, zero)) * held
        by_length_a += stretched
        by_length_b = stretched + wp.where(forward, at_last, -at_first)
        # angle: weight and the way across
        by_cosine = energy * (leading - half * wider)
        # slices turn with the mean direction: d0 stays across e
        turn = -wider * (wp.dot(whole, along_b) - at_first - at_last)
        by_delta = whole + turn * e
        turned = turn * d0
        g_a = turned - moment + by_cosine * along_b
        g_b = turned + moment + by_cosine * along_a + offset * by_delta
        return (
            energy,
            stiffness,
            damped,
            place,
            offset + place,
            reach - h,
            by_delta,
            by_la * g_a + (by_length_a - by_la * wp.dot(g_a, along_a)) * along_a,
            by_lb * g_b
            + (wp.where(forward, by_length_b, -by_length_b) - by_lb * wp.dot(g_b, along_b))
            * along_b,
        )

    @wp.func
    def tip_share(delta: vec3, along: vec3, length: real, reach: real, rigidity: real):
        """Of a tip and a segment that begins at delta from it; rigidity = E* f."""
        nothing = vec3(zero, zero, zero)
        t_h = wp.min(wp.max(-wp.dot(delta, along), zero), length)
        nearest = delta + t_h * along
        hh = wp.dot(nearest, nearest)
        if hh >= reach * reach:
            return zero, zero, zero, zero, zero, nothing, nothing
        h = wp.sqrt(hh)
        wide = reach + h
        q = (reach - h) * wide
        slope = wp.dot(nearest, along)
        root = wp.sqrt(slope * slope + q)
        x1 = wp.max(-t_h, -root - slope)
        x2 = wp.min(length - t_h, root - slope)
        sums = slices(q, slope, one, x1, x2)
        by_h = one / (h * wide)
        by_wide = by_h * h
        by_root = wp.sqrt(by_wide)
        scale = half * rigidity * by_wide * by_wide * by_root
        energy = scale * sums[0]
        stiffness = rigidity * (x2 - x1) * by_root
        damped = stiffness * (x2 - x1) / wp.min(two * root, length)
        pull = -four * scale
        by_delta = (pull * sums[1] - power * energy * by_h) * nearest + (pull * sums[2]) * along
        moment = (pull * sums[2]) * nearest + (pull * sums[3]) * along + t_h * by_delta
        return (
            energy,
            stiffness,
            damped,
            t_h + sums[2] / wp.max(sums[1], tiny),
            reach - h,
            by_delta,
            (one / length) * (moment + energy * along),
        )

    return side_share, tip_share
