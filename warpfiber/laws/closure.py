"""How the forces on the few nodes of a reduced fiber move the fiber made of touching beads.

Source: `paper`: Sasayama & Inagaki 2018, Eqs. (5)-(15). `consistent`: Galerkin projection of the
    beads' equation of motion on linear segments, A dv/dt = ..., with the tridiagonal A below.
Symbols: M = N_R + 1 (real, >= 1), N_seg segments, N_tot = N_seg M + 1 beads, n_i unit vectors of
    the segments, N1, N2, N3_i sums of them (Eqs. 9-11), alpha and beta correction factors.
Limits: the published beta^R of the distributed forces projects the lever of a force on the
    direction to the center: exact for straight fibers, a few percent off for bent ones with few
    segments. It can become negative when an inner node comes near the center.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


def galerkin_entries(spacing: float) -> tuple[float, float, float]:
    """End, inner and off-diagonal entry of A = sum_k w_k w_k^T for the spacing M."""
    end = (spacing + 1.0) * (2.0 * spacing + 1.0) / (6.0 * spacing)
    return end, 2.0 * end - 1.0, (spacing**2 - 1.0) / (6.0 * spacing)


def galerkin_inverse_pivots(spacing: float, segments: int) -> list[float]:
    """Inverse pivots of the Thomas elimination of A, one per node of a fiber."""
    end, inner, off = galerkin_entries(spacing)
    pivots: list[float] = []
    for i in range(segments + 1):
        diagonal = end if i in (0, segments) else inner
        pivots.append(1.0 / (diagonal - (off * off * pivots[-1] if pivots else 0.0)))
    return pivots


@cache
def make_closure(name):
    """The published factors and the split of a force along and across the line to the center."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    one, two, three, six = real(1.0), real(2.0), real(3.0), real(6.0)
    tiny = real(p.eps)

    @wp.func
    def split_force(force: vec3, radial: vec3, along: real, across: real) -> vec3:
        """Eqs. (14), (15); a node on the center has no direction and takes `across` alone."""
        rr = wp.dot(radial, radial)
        if rr < tiny:
            return across * force
        parallel = (wp.dot(force, radial) / rr) * radial
        return along * parallel + across * (force - parallel)

    @wp.func
    def translation_factor(spacing: real, segments: real) -> real:
        """alpha^T of Eq. (5)."""
        return (segments + one) / (segments * spacing + one)

    @wp.func
    def distributed_translation_factor(spacing: real, segments: real, is_end: wp.bool) -> real:
        """beta^T of Eq. (6)."""
        if is_end:
            return (spacing + one) * (segments + one) / (two * (segments * spacing + one))
        return spacing * (segments + one) / (segments * spacing + one)

    @wp.func
    def end_rotation_factor(spacing: real, segments: real, total: vec3, n: vec3) -> real:
        """beta^R / alpha^R of an end node, Eq. (8); total = N1 or N2, n its segment's direction."""
        reduced = spacing - one
        lever = (three * spacing / (segments + one)) * total - reduced * n
        scale = (reduced + two) * (segments + one) / (six * spacing)
        return scale * wp.dot(lever, total) / wp.dot(total, total)

    @wp.func
    def inner_rotation_factor(spacing: real, offset: vec3, kink: vec3) -> real:
        """beta^R / alpha^R of an inner node, Eq. (8); offset = N3_i, kink = n_i - n_(i-1)."""
        oo = wp.dot(offset, offset)
        if oo < tiny:
            return spacing
        reduced = spacing - one
        lever = (six * spacing * spacing) * offset + (reduced * (reduced + two)) * kink
        return wp.dot(lever, offset) / (six * spacing * oo)

    return (
        split_force,
        translation_factor,
        distributed_translation_factor,
        end_rotation_factor,
        inner_rotation_factor,
    )
