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
    radius. Across a bend in the plane of D slices of neighbors leave out or share a wedge; polygons
    stand for bent fibers to that order.
"""

import math
from functools import cache

import warp as wp

from warpfiber.laws.capsule_contact import SMALLEST_SINE, make_capsule_contact
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
def patch_share_struct(name):
    """Energy of a share with its gradient, and where it acts."""
    p = precision(name)

    @wp.struct
    class PatchShare:
        energy: p.real
        stiffness: p.real
        damped: p.real  # stiffness that dashpots feel
        s: p.real
        t: p.real
        depth: p.real  # the same for neighbors that share a patch
        by_delta: p.vec3
        by_a: p.vec3
        by_b: p.vec3

    return PatchShare


@cache
def make_capsule_patch(name):
    """`side_share` of two segments, `tip_share` of a point and a segment."""
    p = precision(name)
    real, vec2, vec3, vec4 = p.real, p.vec2, p.vec3, p.vec4
    PatchShare = patch_share_struct(name)
    curvatures, hertz_factor = make_capsule_contact(name)
    zero, half, one, two, four = (real(x) for x in (0.0, 0.5, 1.0, 2.0, 4.0))
    power, tiny, least = real(2.5), real(1.0e-30), real(SMALLEST_SINE)
    turning, further = real(TURNING_SINE), real(0.5 * BEYOND)
    near, parallel2 = real(PARALLEL[name]), real(PARALLEL[name] ** 2)
    outermost, inner, outer = real(math.sqrt(0.6)), real(4.0 / 9.0), real(5.0 / 18.0)

    @wp.func
    def overlap_at(q: real, slope: real, vv: real, x: real) -> real:
        """B^2 - D^2 a way x from where it is q."""
        return q - (two * slope + vv * x) * x

    @wp.func
    def slices(q: real, slope: real, vv: real, u_h: real, u1: real, u2: real) -> vec4:
        """Integrals of o^2, o, o u, o u^2 with o of `overlap_at`: three Gauss points are exact."""
        total = vec4()
        for k in range(3):
            u = half * (u1 + u2) + real(k - 1) * outermost * half * (u2 - u1)
            o = overlap_at(q, slope, vv, u - u_h)
            g = (u2 - u1) * wp.where(k == 1, inner, outer) * o
            total += vec4(g * o, g, g * u, g * u * u)
        return total

    @wp.func
    def overlapping(q: real, slope: real, vv: real) -> vec2:
        """How far from u_h slices overlap, without differences of numbers that are nearly equal."""
        root = wp.sqrt(slope * slope + vv * q)
        return vec2(-q / wp.max(root - slope, tiny), q / wp.max(root + slope, tiny))

    @wp.func
    def touched_part(u1: real, u2: real, reached: vec2, length: real) -> real:
        """Of the patch, or of the segment if that is shorter."""
        return (u2 - u1) / wp.min(reached[1] - reached[0], length)

    @wp.func
    def beyond_zero(x: real) -> real:
        """1 beyond, 0 before; half where ends face each other and rounding would decide."""
        return wp.where(x > near, one, wp.where(x < -near, zero, half))

    @wp.func
    def side_share(
        delta: vec3,
        a: vec3,
        b: vec3,
        reach: real,
        modulus: real,
        ki: real,
        kj: real,
        sigma: real,
        weight: real,
        weight_slope: real,
    ) -> PatchShare:
        """Of slices across the mean direction of a and sigma b; weight_slope: dw / d cosine."""
        share = PatchShare()
        la = wp.length(a)
        lb = wp.length(b)
        along_a = a / la
        along_b = (sigma / lb) * b
        cosine = wp.min(wp.dot(along_a, along_b), one)
        twice = wp.sqrt(two * (one + cosine))
        middle = (along_a + along_b) / twice
        bm = wp.dot(b, middle)
        t0 = -wp.dot(delta, middle) / bm
        ratio = sigma * la / lb
        d0 = delta + t0 * b
        dv = ratio * b - a
        # parts of a beside the ends of b
        begin = -t0 / ratio
        end = (one - t0) / ratio
        first = wp.min(begin, end)
        last = wp.max(begin, end)
        low = wp.max(zero, first)
        high = wp.min(one, last)
        if high <= low:
            return share
        vv = wp.dot(dv, dv)
        dd = wp.dot(d0, dv)
        deepest = half * (low + high)
        if vv > parallel2 * la * la:
            deepest = -dd / vv
        beyond = further * (one + lb / la)
        ahead = wp.min(zero, first) - beyond
        behind = wp.max(one, last) + beyond
        u_h = wp.clamp(deepest, ahead, behind)
        nearest = d0 + u_h * dv
        h = wp.length(nearest)
        if h >= reach:
            return share
        n = nearest / h
        q = (reach - h) * (reach + h)
        slope = wp.dot(nearest, dv)
        reached = overlapping(q, slope, vv)
        u1 = wp.max(low, u_h + reached[0])
        u2 = wp.min(high, u_h + reached[1])
        if u2 - u1 <= near:  # ends that face each other share nothing yet
            return share
        sums = slices(q, slope, vv, u_h, u1, u2)
        cross = wp.length(wp.cross(along_a, along_b))
        sine = wp.max(cross, least)
        form = hertz_factor(curvatures(0, ki, kj, sine))
        wide = reach + h
        # y = 2 tan(angle / 2) times the way along m
        rigid = weight * modulus * form[0] * (two * sine / twice) * la
        scale = half * rigid / (wide * wide * wp.sqrt(wide))
        energy = scale * sums[0]
        share.energy = energy
        share.stiffness = rigid * (u2 - u1) / wp.sqrt(wide)
        share.damped = share.stiffness * touched_part(u1, u2, reached, half * (one + lb / la))
        share.s = sums[2] / wp.max(sums[1], tiny)
        share.t = t0 + share.s * ratio
        share.depth = reach - h

        # dE at fixed u, by t_0 and by the ratio of lengths
        pull = -four * scale
        whole = pull * (sums[1] * d0 + sums[2] * dv)
        moment = pull * (sums[2] * d0 + sums[3] * dv)
        by_h = (-power * energy / wide) * n
        g_delta = whole + by_h
        g_a = -moment - u_h * by_h
        g_b = t0 * whole + ratio * moment + (t0 + u_h * ratio) * by_h
        g_t0 = wp.dot(g_delta, b)
        g_ratio = wp.dot(moment + u_h * by_h, b)
        # ends of b move along a
        moved = zero
        moved_part = zero
        stretched = zero
        if u2 >= high:
            o = overlap_at(q, slope, vv, u2 - u_h)
            cut = beyond_zero(one - last) * scale * o * o
            moved += cut
            moved_part += cut * u2
        if u1 <= low:
            o = overlap_at(q, slope, vv, u1 - u_h)
            cut = beyond_zero(first) * scale * o * o
            moved -= cut
            moved_part -= cut * u1
        held = wp.dot(by_h, dv)
        if deepest < ahead:
            stretched += further * held
            moved += beyond_zero(-first) * held
            moved_part += beyond_zero(-first) * held * first
        if deepest > behind:
            stretched -= further * held
            moved += beyond_zero(last - one) * held
            moved_part += beyond_zero(last - one) * held * last
        g_ratio += stretched * sigma / (ratio * ratio)
        g_t0 -= moved / ratio
        g_ratio -= moved_part / ratio
        # angle: f, w and the way across
        g_cosine = weight_slope / weight - half / (one + cosine)
        if cross > turning:
            g_cosine -= (two * form[1] + one) * cosine / (sine * sine)
        g_cosine *= energy
        g_a += (energy / la + g_ratio * sigma / lb) * along_a
        g_a += (g_cosine / la) * (along_b - cosine * along_a)
        g_b -= (g_ratio * ratio / (lb * lb)) * b
        g_b += (g_cosine * sigma / lb) * (along_a - cosine * along_b)
        # slices turn with m
        g_t0 /= -bm
        g_delta += g_t0 * middle
        g_b += (g_t0 * t0) * middle
        turned = (g_t0 / twice) * d0
        g_a += (turned - wp.dot(turned, along_a) * along_a) / la
        g_b += (sigma / lb) * (turned - wp.dot(turned, along_b) * along_b)
        share.by_delta = g_delta
        share.by_a = g_a
        share.by_b = g_b
        return share

    @wp.func
    def tip_share(delta: vec3, b: vec3, reach: real, rigidity: real) -> PatchShare:
        """Of a tip and the segment b that begins at delta from it; rigidity = E* f."""
        share = PatchShare()
        bb = wp.dot(b, b)
        t_h = wp.clamp(-wp.dot(delta, b) / bb, zero, one)
        nearest = delta + t_h * b
        h = wp.length(nearest)
        if h >= reach:
            return share
        q = (reach - h) * (reach + h)
        slope = wp.dot(nearest, b)
        reached = overlapping(q, slope, bb)
        t1 = wp.max(zero, t_h + reached[0])
        t2 = wp.min(one, t_h + reached[1])
        sums = slices(q, slope, bb, t_h, t1, t2)
        wide = reach + h
        rigid = rigidity * wp.sqrt(bb)
        scale = half * rigid / (wide * wide * wp.sqrt(wide))
        energy = scale * sums[0]
        share.energy = energy
        share.stiffness = rigid * (t2 - t1) / wp.sqrt(wide)
        share.damped = share.stiffness * touched_part(t1, t2, reached, one)
        share.t = sums[2] / wp.max(sums[1], tiny)
        share.depth = reach - h
        by_h = (-power * energy / (wide * h)) * nearest
        pull = -four * scale
        share.by_delta = pull * (sums[1] * delta + sums[2] * b) + by_h
        share.by_b = pull * (sums[2] * delta + sums[3] * b) + t_h * by_h + (energy / bb) * b
        return share

    return side_share, tip_share
