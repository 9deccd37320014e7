"""Structs that are made once per precision.

No `from __future__ import annotations` here: Warp reads the annotations of a struct as objects.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import precision


@cache
def group_struct(name: str) -> Any:
    """Warp struct of the constants that all fibers of one group share, in run units."""
    real, vec3 = precision(name).real, precision(name).vec3

    @wp.struct
    class Group:
        radius: real  # a
        rest: real  # l = 2 a M, rest length of a segment
        spacing: real  # M = N_R + 1, segment length in diameters
        stretching: real  # k_s = pi a E / (2 M)
        compliance: real  # 1 / k_s, 0 for segments that keep their length
        bending: real  # k_b = pi a^3 E_b / (8 M)
        mass: real  # m of one bead
        drag: real  # zeta = 6 pi eta a
        torque: real  # 8 pi eta a^3
        weight: real  # w_p of an inner segment, beads
        weight_excess: real  # what the first and the last segment carry more
        body_force: vec3  # gravity minus buoyancy of one bead
        coupling: real  # off-diagonal of the Galerkin matrix A
        pivot_start: wp.int32  # where this group's Thomas pivots start
        segments: wp.int32  # N_seg
        inner_beads: wp.int32  # imaginary beads inside a segment, lubrication only
        bead_weight: real  # real beads that one imaginary bead stands for

    return Group
