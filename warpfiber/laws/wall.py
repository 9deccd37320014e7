"""Repulsion of a node by a plane wall.

Source: mirror image of the node in the wall under the law of `repulsion`: F = D0 exp(-G0 (y/a - 1))
    for y <= 1.0005 a. Not in Sasayama & Inagaki 2018, who do not give a wall law.
Symbols: y distance of the node from the wall.
Limits: no lubrication with walls; a wall is flat, so a straight segment touches it at a node first.
"""

from functools import cache

import warp as wp

from warpfiber.laws.repulsion import RANGE, make_repulsion
from warpfiber.model import precision


@cache
def make_wall(name):
    """`wall_push(D0, G0, y, a)` -> size of the force away from the wall."""
    real = precision(name).real
    reach = real(RANGE)
    repulsion_size, _ = make_repulsion(name)

    @wp.func
    def wall_push(strength: real, decay: real, y: real, radius: real) -> real:
        if y > reach * radius:
            return real(0.0)
        return repulsion_size(strength, decay, y, radius)

    return wall_push
