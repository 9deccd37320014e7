"""Normal contact of one pair of segments, by the nodes of these two alone.

A patch within both segments is the contact of Hertz where they are nearest; else the pair has its
share of the patch. Where one of them ends its fiber, the larger energy of that share and of the
round tip counts, which is continuous as well.
Source: laws `capsule_contact` and `capsule_patch`.
"""

from functools import cache

import warp as wp

from warpfiber.laws.capsule_contact import SMALLEST_SINE, make_capsule_contact
from warpfiber.laws.capsule_patch import (
    BOTH_WAYS,
    PARALLEL,
    TURNING_SINE,
    make_capsule_patch,
)
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct, pair_group_struct
from warpfiber.passes.pairs import END_TOLERANCE
from warpfiber.passes.ring_nodes import make_ring_nodes


@cache
def make_capsule_touch(name: str, closed: bool = False):
    """`normal_contact`: what springs of a pair do; nothing without energy.

    (part along the normal, stiffness, s, t), (depth for memories, stiffness for dashpots, energy,
    distance at s and t), the normal there, the force on i at s, its reverse on j at t; what the
    first node of i feels besides, its reverse the second one; the same of j.
    """
    p = precision(name)
    real, vec2, vec3, vec4 = p.real, p.vec2, p.vec3, p.vec4
    BondGroup, PairGroup = bond_group_struct(name), pair_group_struct(name)
    has_before, has_after, _, _, _, _ = make_ring_nodes(closed)
    _, hertz_factor = make_capsule_contact(name)
    side_share, tip_share = make_capsule_patch(name)
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    near, least_sine2, both_ways = (
        real(END_TOLERANCE[name]),
        real(SMALLEST_SINE**2),
        real(BOTH_WAYS),
    )
    turning2, tiny = real(TURNING_SINE**2), real(1.0e-30)
    by_least = real(SMALLEST_SINE**-2)
    parallel2 = real(PARALLEL[name] ** 2)
    two_thirds, two_fifths = real(2.0 / 3.0), real(0.4)

    @wp.func
    def is_tip(g: BondGroup, at: wp.int32, s: real) -> wp.bool:
        """Whether the nearer end of a segment ends its fiber."""
        ring = g.closed * (g.segments + 1)
        if s < half:
            return not has_before(at, ring)
        return not has_after(at, g.segments, ring)

    @wp.func
    def normal_contact(
        g: PairGroup,
        gi: BondGroup,
        gj: BondGroup,
        at_i: wp.int32,
        at_j: wp.int32,
        delta: vec3,
        a: vec3,
        b: vec3,
        st: vec2,
        gap: vec3,
    ):
        """Of segments nearest at st, within reach there; gap from the point of i to that of j."""
        reach = g.reach
        la = wp.length(a)
        lb = wp.length(b)
        by_both = one / (la * lb)
        by_la = lb * by_both
        by_lb = la * by_both
        along_a = by_la * a
        along_b = by_lb * b
        signed = wp.dot(along_a, along_b)
        cosine = wp.min(wp.abs(signed), one)
        cross2 = wp.length_sq(wp.cross(along_a, along_b))
        form = hertz_factor(g.crossed * wp.max(cross2, least_sine2))
        rigidity = g.stiffness * form[0]
        forward = signed >= zero
        across_b = wp.where(forward, one, -one) * along_b
        w = across_b - along_a
        # 1 / (1 + cosine), 1 / w^2, 1 / sin^2 by one division
        ww = wp.max(wp.dot(w, w), parallel2)
        by_ends = one / ((one + cosine) * ww)
        # a wider angle stores less: d ln P = -2 cos d cos / sin^2
        angle = wp.where(cross2 > turning2, two * signed * by_ends, zero)
        twist = -two * form[1] * angle
        inside = wp.min(wp.min(st[0], one - st[0]) * la, wp.min(st[1], one - st[1]) * lb)
        # half of the patch along either fiber is its root
        patch2 = reach * reach - wp.dot(gap, gap)
        inside2 = two * inside * inside * wp.max(one - cosine, near)
        if inside2 > patch2 and inside > near * wp.max(la, lb):
            distance = wp.length(gap)
            depth = wp.max(reach - distance, zero)
            by_sine2 = wp.where(cross2 > least_sine2, two * by_ends, by_least)
            stiffness = two * rigidity * wp.sqrt(depth * by_sine2)
            size = two_thirds * stiffness * depth
            energy = two_fifths * size * depth
            twist *= energy
            n = (one / distance) * gap
            return (
                vec4(size, stiffness, st[0], st[1]),
                vec4(depth, stiffness, energy, distance),
                n,
                -size * n,
                (twist * by_la) * (along_b - signed * along_a),
                (twist * by_lb) * (along_a - signed * along_b),
            )

        twist -= angle  # of the way across
        wider = by_ends * ww
        by_ww = by_ends * (one + cosine)
        first = wp.where(cosine >= both_ways, one, half + cosine)
        leading = zero
        if cosine < both_ways:
            leading = one / first
        sigma = wp.where(forward, one, -one)
        energy, stiffness, damped, s, t, deep, by_delta, by_a, by_b = side_share(
            delta,
            along_a,
            across_b,
            la,
            lb,
            by_la,
            sigma * by_lb,
            reach,
            first * rigidity,
            wider,
            by_ww,
            leading,
            forward,
        )
        s *= by_la
        t *= sigma * by_lb
        if cosine < both_ways:
            # slices the other way have e and w in each other's place
            rest = wp.max(one - first, tiny)
            e_more, k_more, d_more, s_more, t_more, deep_more, by_d, by_i, by_j = side_share(
                delta,
                along_a,
                -across_b,
                la,
                lb,
                by_la,
                -sigma * by_lb,
                reach,
                rest * rigidity,
                two * by_ww,
                half * wider,
                one / rest,
                not forward,
            )
            energy += e_more
            part = e_more / wp.max(energy, tiny)
            s += part * (by_la * s_more - s)
            t -= part * (sigma * by_lb * t_more + t)
            stiffness += k_more
            damped += d_more
            deep = wp.max(deep, deep_more)
            by_delta += by_d
            by_a += by_i
            by_b += by_j
        twist *= energy
        by_a += (twist * by_la) * (along_b - signed * along_a)
        by_b += (twist * by_lb) * (along_a - signed * along_b)

        is_tip_i = is_tip(gi, at_i, st[0])
        is_tip_j = is_tip(gj, at_j, st[1])
        if is_tip_i or is_tip_j:
            tip_s = wp.where(st[0] < half, zero, one)
            tip_t = wp.where(st[1] < half, zero, one)
            if is_tip_i:
                start = delta - (tip_s * la) * along_a
                e_tip, k_tip, d_tip, t_tip, deep_tip, by_d, by_j = tip_share(
                    start, along_b, lb, reach, g.round_i
                )
                if e_tip > energy:
                    energy = e_tip
                    stiffness = k_tip
                    damped = d_tip
                    s = tip_s
                    t = t_tip * by_lb
                    deep = deep_tip
                    by_delta = by_d
                    by_a = -tip_s * by_d
                    by_b = by_j
            if is_tip_j:
                start = -delta - (tip_t * lb) * along_b
                e_tip, k_tip, d_tip, s_tip, deep_tip, by_d, by_i = tip_share(
                    start, along_a, la, reach, g.round_j
                )
                if e_tip > energy:
                    energy = e_tip
                    stiffness = k_tip
                    damped = d_tip
                    s = s_tip * by_la
                    t = tip_t
                    deep = deep_tip
                    by_delta = -by_d
                    by_a = by_i
                    by_b = -tip_t * by_d
            if is_tip_i and is_tip_j:
                c = delta + (tip_t * lb) * along_b - (tip_s * la) * along_a
                apart = wp.length(c)
                deep_tip = wp.max(reach - apart, zero)
                k_tip = two * g.round_both * wp.sqrt(deep_tip)
                push = two_thirds * k_tip * deep_tip
                if two_fifths * push * deep_tip > energy:
                    energy = two_fifths * push * deep_tip
                    stiffness = k_tip
                    damped = k_tip
                    s = tip_s
                    t = tip_t
                    deep = deep_tip
                    by_delta = (-push / apart) * c
                    by_a = -tip_s * by_delta
                    by_b = tip_t * by_delta

        between = delta + (t * lb) * along_b - (s * la) * along_a
        apart = wp.length(between)
        n = (one / apart) * between
        return (
            vec4(wp.max(-wp.dot(by_delta, n), zero), stiffness, s, t),
            vec4(deep, damped, energy, apart),
            n,
            by_delta,
            by_a + s * by_delta,
            by_b - t * by_delta,
        )

    return normal_contact
