"""Masses, stiffnesses and dashpots of the nodes and bonds of one fiber group.

Source: Xu, Ma & Guo 2023, Eqs. (3)-(10). Differences: a node has the mass of the length of fiber
    around it, not of a sphere; `bond_shear = "rbf"` adds the bending flexibility l^3 / (12 E I)
    that is left when a straight bond stands for a bent segment, which makes the nodes of a bent
    fiber exact for any number of them. Dashpots are shares of the critical one of two nodes.
Symbols: a radius, l length of a segment along the fiber, A = pi a^2, I = pi a^4 / 4, I_p = 2 I,
    G = E / (2 (1 + nu)), J = 2/5 m a^2; all SI.
Limits: J is that of a sphere also where l > 2 a, where a true slice has more; high modes differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from warpfiber.scene import FiberGroup, Scene

CAP_VOLUME = {"centerline": 0.0, "capsule": 2.0 / 3.0, "cylinder": 1.0}
"""Volume of one end by the box's volume rule, in pi a^3."""


@dataclass(frozen=True)
class BondConstants:
    """SI; tuples are (stretching, shear, bending, twist)."""

    segment_length: float
    stiffness: tuple[float, float, float, float]
    """N/m, N/m, N m, N m"""
    dashpots: tuple[float, float, float, float]
    """N s/m, N s/m, N m s, N m s"""
    mass: float
    """kg, of an inner node"""
    end_mass: float
    inertia: float
    """kg m^2"""
    end_inertia: float
    compliance: float
    """(1 - nu^2) / E_c of contacts, 1/Pa"""
    shear_compliance: float
    """(2 - nu) / G_c of contacts, 1/Pa"""

    @property
    def wall_modulus(self) -> float:
        """E* against a rigid wall, Pa."""
        return 1.0 / self.compliance


def is_closed(group: FiberGroup) -> bool:
    """Whether a bond joins the last node to the first."""
    return group.shape.kind == "ring" and group.node_file is None


def bond_constants(scene: Scene, group: FiberGroup) -> BondConstants:
    """Constants of one group whose segments are known."""
    a, nu = group.radius, group.poisson_ratio
    length = group.centerline_length / group.segments
    area, second = math.pi * a * a, 0.25 * math.pi * a**4
    shear_modulus = 0.5 * group.youngs_modulus / (1.0 + nu)
    bending = group.bending_modulus * second / length
    flexibility = length / (shear_modulus * area)
    if scene.numerics.bond_shear != "ga":
        flexibility += length**2 / (12.0 * bending)
    stiffness = (
        group.axial_modulus * area / length,
        1.0 / flexibility,
        bending,
        shear_modulus * 2.0 * second / length,
    )
    density = group.density or 0.0
    mass = density * area * length
    rule = scene.box.volume_rule if scene.box is not None else "capsule"
    end_mass = 0.5 * mass + CAP_VOLUME[rule] * math.pi * a**3 * density
    inertia = 0.4 * mass * a * a
    moved = (mass, mass, inertia, inertia)
    modulus = scene.contact.modulus or group.youngs_modulus
    return BondConstants(
        segment_length=length,
        stiffness=stiffness,
        dashpots=tuple(  # type: ignore[arg-type]
            group.bond_damping * math.sqrt(2.0 * m * k)
            for m, k in zip(moved, stiffness, strict=True)
        ),
        mass=mass,
        end_mass=end_mass,
        inertia=inertia,
        end_inertia=0.4 * end_mass * a * a,
        compliance=(1.0 - nu * nu) / modulus,
        shear_compliance=(2.0 - nu) * 2.0 * (1.0 + nu) / modulus,
    )


def fiber_mass(scene: Scene, group: FiberGroup) -> float:
    """Sum of the masses of the nodes of one fiber, kg."""
    c = bond_constants(scene, group)
    if is_closed(group):
        return c.mass * group.segments
    return c.mass * (group.segments - 1) + 2.0 * c.end_mass
