"""What the groups of two fibers that meet have in common, told once for all pairs of segments.

Source: laws `capsule_contact` and `friction`.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.laws.capsule_contact import make_capsule_contact
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct, pair_group_struct


@cache
def make_pair_groups(name: str):
    """Kernel `pair_groups` (G, G), rows by the first fiber's group."""
    real = precision(name).real
    BondGroup, PairGroup = bond_group_struct(name), pair_group_struct(name)
    curvatures, hertz_factor = make_capsule_contact(name)
    half, one, two, four = real(0.5), real(1.0), real(2.0), real(4.0)

    @wp.func
    def tip_factor(ends: wp.int32, ra: real, rb: real) -> real:
        """f of tips."""
        sx = curvatures(ends, ra, rb)
        return hertz_factor(sx[1])[0] * wp.sqrt(two * ra * rb / (sx[0] * sx[1]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def pair_groups(groups: wp.array(dtype=BondGroup), groups_out: wp.array2d(dtype=PairGroup)):
        i, j = wp.tid()
        gi = groups[i]
        gj = groups[j]
        g = PairGroup()
        modulus = one / (gi.compliance + gj.compliance)
        g.reach = gi.radius + gj.radius
        g.crossed = curvatures(0, gi.radius, gj.radius)[1]
        g.stiffness = modulus * wp.sqrt(half * g.reach)
        g.round_i = modulus * tip_factor(1, gi.radius, gj.radius)
        g.round_j = modulus * tip_factor(2, gi.radius, gj.radius)
        g.round_both = modulus * tip_factor(3, gi.radius, gj.radius)
        shear = gi.shear_compliance + gj.shear_compliance
        g.shear_part = four * (gi.compliance + gj.compliance) / shear
        g.root_shear = wp.sqrt(g.shear_part)
        groups_out[i, j] = g

    return pair_groups


def make_pair_group_table(name: str, groups: Any, device: str) -> Any:
    """(G, G) of what the groups (G,) share."""
    count = len(groups)
    table = wp.zeros((count, count), dtype=pair_group_struct(name), device=device)
    kernel = make_pair_groups(name)
    wp.launch(kernel, dim=(count, count), inputs=[groups, table], device=device)
    return table
