"""Structs of the bonded spheres that are made once per precision.

No `from __future__ import annotations` here: Warp reads the annotations of a struct as objects.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import precision


@cache
def bond_group_struct(name: str) -> Any:
    """Warp struct of the constants that nodes and bonds of one group share, in run units."""
    real, vec3, vec4 = precision(name).real, precision(name).vec3, precision(name).vec4

    @wp.struct
    class BondGroup:
        radius: real  # a
        stiffness: vec4  # K of stretching, shear, bending, twist
        dashpots: vec4  # the same of the dashpots
        mass: real  # of an inner node
        end_mass: real
        inertia: real  # J of an inner node
        end_inertia: real
        weight: vec3  # acceleration by gravity, less buoyancy
        wall_modulus: real  # E* against a rigid wall
        compliance: real  # (1 - nu^2) / E_c
        shear_compliance: real  # (2 - nu) / G_c
        segments: wp.int32
        torn_length: real  # a longer bond is no physical state
        closed: wp.int32  # 1: a bond joins the last node to the first

    return BondGroup


@cache
def pair_group_struct(name: str) -> Any:
    """Warp struct of what two groups whose fibers meet share, in run units; i is the first one."""
    real = precision(name).real

    @wp.struct
    class PairGroup:
        reach: real  # sum of the radii
        crossed: real  # x of `capsule_contact` where fibers cross at a right angle
        stiffness: real  # E* sqrt(S / 2) of cylinders
        round_i: real  # E* f of the end of i on j, of j on i, of two ends
        round_j: real
        round_both: real
        shear_part: real  # tangential stiffness over the normal one
        root_shear: real

    return PairGroup


@cache
def node_struct(name: str) -> Any:
    """Warp struct of one node on its way through a step."""
    vec3, vec4 = precision(name).vec3, precision(name).vec4

    @wp.struct
    class Node:
        x: wp.vec3d
        v: vec3
        q: vec4
        w: vec3

    return Node
