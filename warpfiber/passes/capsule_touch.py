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
    TURNING_SINE,
    make_capsule_patch,
    patch_share_struct,
)
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.pairs import END_TOLERANCE
from warpfiber.passes.ring_nodes import make_ring_nodes


@cache
def make_capsule_touch(name: str, closed: bool = False):
    """`normal_contact`: what springs of a pair do; nothing without energy.

    (part along the normal, stiffness, s, t), (depth for memories, stiffness for dashpots, energy),
    and rows: the force on i at s, its reverse on j at t; what the first node of i feels besides,
    its reverse the second one; the same of j.
    """
    p = precision(name)
    real, vec2, vec3, vec4 = p.real, p.vec2, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    PatchShare = patch_share_struct(name)
    has_before, has_after, _, _, _, _ = make_ring_nodes(closed)
    curvatures, hertz_factor = make_capsule_contact(name)
    side_share, tip_share = make_capsule_patch(name)
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    near, least_sine, both_ways = real(END_TOLERANCE[name]), real(SMALLEST_SINE), real(BOTH_WAYS)
    turning, tiny = real(TURNING_SINE), real(1.0e-30)
    two_thirds, two_fifths = real(2.0 / 3.0), real(0.4)

    @wp.func
    def point_share(
        delta: vec3, a: vec3, b: vec3, s: real, t: real, depth: real, stiffness: real
    ) -> PatchShare:
        """Hertz at s and t, with the stiffness there."""
        c = delta + t * b - s * a
        share = PatchShare()
        share.stiffness = stiffness
        share.damped = stiffness
        share.energy = two_fifths * two_thirds * stiffness * depth * depth
        share.s = s
        share.t = t
        share.depth = depth
        share.by_delta = (-two_thirds * stiffness * depth / wp.length(c)) * c
        share.by_a = -s * share.by_delta
        share.by_b = t * share.by_delta
        return share

    @wp.func
    def larger(kept: PatchShare, other: PatchShare) -> PatchShare:
        if other.energy > kept.energy:
            return other
        return kept

    @wp.func
    def shared_side(
        delta: vec3, a: vec3, b: vec3, reach: real, modulus: real, ki: real, kj: real
    ) -> PatchShare:
        """Of slices across one mean direction or both."""
        signed = wp.dot(a, b) / (wp.length(a) * wp.length(b))
        cosine = wp.abs(signed)
        sigma = wp.where(signed < zero, -one, one)
        ways = wp.where(cosine >= both_ways, 1, 2)
        share = PatchShare()
        for way in range(ways):
            weight = wp.where(ways == 1, one, half + cosine)
            slope = wp.where(ways == 1, zero, one)
            if way == 1:
                weight = one - weight
                sigma = -sigma
            more = side_share(delta, a, b, reach, modulus, ki, kj, sigma, weight, slope)
            energy = share.energy + more.energy
            part = more.energy / wp.max(energy, tiny)
            share.s += part * (more.s - share.s)
            share.t += part * (more.t - share.t)
            share.energy = energy
            share.stiffness += more.stiffness
            share.damped += more.damped
            share.depth = wp.max(share.depth, more.depth)
            share.by_delta += more.by_delta
            share.by_a += more.by_a
            share.by_b += more.by_b
        return share

    @wp.func
    def tips(
        kept: PatchShare,
        is_tip_i: wp.bool,
        is_tip_j: wp.bool,
        s: real,
        t: real,
        delta: vec3,
        a: vec3,
        b: vec3,
        reach: real,
        modulus: real,
        ki: real,
        kj: real,
    ) -> PatchShare:
        """The largest of a share and of those of a tip of i at s, of j at t, and of both."""
        share = kept
        if is_tip_i:
            form = hertz_factor(curvatures(1, ki, kj, one))
            tip = tip_share(delta - s * a, b, reach, modulus * form[0])
            tip.s = s
            tip.by_a = -s * tip.by_delta
            share = larger(share, tip)
        if is_tip_j:
            form = hertz_factor(curvatures(2, ki, kj, one))
            tip = tip_share(-delta - t * b, a, reach, modulus * form[0])
            tip.s = tip.t
            tip.t = t
            tip.by_a = tip.by_b
            tip.by_b = -t * tip.by_delta
            tip.by_delta = -tip.by_delta
            share = larger(share, tip)
        if is_tip_i and is_tip_j:
            depth = reach - wp.length(delta + t * b - s * a)
            if depth > zero:
                form = hertz_factor(curvatures(3, ki, kj, one))
                stiffness = two * modulus * form[0] * wp.sqrt(depth)
                share = larger(share, point_share(delta, a, b, s, t, depth, stiffness))
        return share

    @wp.func
    def normal_contact(
        gi: BondGroup,
        gj: BondGroup,
        at_i: wp.int32,
        at_j: wp.int32,
        delta: vec3,
        a: vec3,
        b: vec3,
        st: vec2,
    ):
        """Of segments nearest at st and within reach there."""
        reach = gi.radius + gj.radius
        modulus = one / (gi.compliance + gj.compliance)
        ki = one / gi.radius
        kj = one / gj.radius
        la = wp.length(a)
        lb = wp.length(b)
        distance = wp.length(delta + st[1] * b - st[0] * a)
        depth = wp.max(reach - distance, zero)
        signed = wp.dot(a, b) / (la * lb)
        # half of the patch along either fiber
        patch = wp.sqrt(depth * (reach + distance) / (two * wp.max(one - wp.abs(signed), near)))
        patch = wp.max(patch, near * wp.max(la, lb))
        inside = wp.min(wp.min(st[0], one - st[0]) * la, wp.min(st[1], one - st[1]) * lb)
        share = PatchShare()
        if inside > patch:
            sine = wp.max(wp.length(wp.cross(a, b)) / (la * lb), least_sine)
            form = hertz_factor(curvatures(0, ki, kj, sine))
            stiffness = two * modulus * form[0] * wp.sqrt(depth)
            share = point_share(delta, a, b, st[0], st[1], depth, stiffness)
            if sine > turning:
                # a wider angle stores less: d ln P = -2 cos d cos / sin^2
                twist = -two * form[1] * share.energy * signed / (sine * sine)
                share.by_a += (twist / la) * (b / lb - (signed / la) * a)
                share.by_b += (twist / lb) * (a / la - (signed / lb) * b)
        else:
            share = shared_side(delta, a, b, reach, modulus, ki, kj)
            ring_i = gi.closed * (gi.segments + 1)
            ring_j = gj.closed * (gj.segments + 1)
            s = wp.where(st[0] < half, zero, one)
            t = wp.where(st[1] < half, zero, one)
            is_tip_i = not has_before(at_i, ring_i)
            if s > zero:
                is_tip_i = not has_after(at_i, gi.segments, ring_i)
            is_tip_j = not has_before(at_j, ring_j)
            if t > zero:
                is_tip_j = not has_after(at_j, gj.segments, ring_j)
            share = tips(share, is_tip_i, is_tip_j, s, t, delta, a, b, reach, modulus, ki, kj)
        n = wp.normalize(delta + share.t * b - share.s * a)
        size = wp.max(-wp.dot(share.by_delta, n), zero)
        return (
            vec4(size, share.stiffness, share.s, share.t),
            vec3(share.depth, share.damped, share.energy),
            wp.matrix_from_rows(
                share.by_delta,
                share.by_a + share.s * share.by_delta,
                share.by_b - share.t * share.by_delta,
            ),
        )

    return normal_contact
