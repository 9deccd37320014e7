"""Numbers that follow from a scene without any run: what `check` prints, and sizes of the problem.

Source: Sasayama & Inagaki 2018 (effective stiffness, Reynolds number of a bead, Jeffery motion of
a chain of beads).
Symbols: a radius [m], d = 2a, r_f = L/d, eta viscosity [Pa s], rate [1/s], E bending modulus [Pa],
rho density [kg/m^3], V_f volume fraction.
Limits: straight fibers; the functions of a rate return None where the scene has no such flow.
"""

from __future__ import annotations

import math

from warpfiber.scene.scene import Scene
from warpfiber.scene.tables import FiberGroup

INERTIALESS = ("overdamped", "rigid_rod")
"""Methods whose fibers have no mass."""
REPULSION_REACH = 2.001
"""Center line distance in radii below which fibers repel (Sasayama & Inagaki 2018, appendix A)."""
SHORTEST_BOND = 0.5
"""Least length of a segment of bonded spheres in diameters: nodes stand at least a radius apart.

Other methods have a bead per diameter, and so segments of a diameter at least.
"""
LUBRICATION_REACH = 3.0
"""Center line distance in radii below which the fluid film between fibers acts (as above)."""


def effective_stiffness(scene: Scene, group: FiberGroup) -> float | None:
    """S_eff = pi E/(64 eta rate r_f^4): bending stiffness against flow; >> 0.04 turns rigidly."""
    if scene.flow is None or scene.flow.rate == 0.0 or group.aspect_ratio == 0.0:
        return None
    stress = scene.flow.viscosity * scene.flow.rate
    return bending_stiffness(group.bending_modulus, group.aspect_ratio, stress)


def bending_stiffness(modulus: float, aspect_ratio: float, stress: float) -> float:
    """S_eff of a bending modulus against the stress eta rate, both in Pa."""
    return math.pi * modulus / (64.0 * stress * aspect_ratio**4)


def reynolds_number(scene: Scene, group: FiberGroup) -> float | None:
    """Re = rho a^2 rate/eta of a bead: its inertia against the drag on it."""
    if scene.flow is None or scene.flow.rate == 0.0 or group.density is None:
        return None
    return group.density * group.radius**2 * scene.flow.rate / scene.flow.viscosity


def equivalent_aspect_ratio(scene: Scene, group: FiberGroup) -> float | None:
    """r_e of Jeffery motion: sqrt((r_f^2+1)/2), or sqrt((r_f^2+r_f+2)/2) with plain weights."""
    r_f = group.aspect_ratio
    if r_f == 0.0:
        return None
    if scene.numerics.torque_weights == "plain":
        return math.sqrt(0.5 * (r_f**2 + r_f + 2.0))
    return math.sqrt(0.5 * (r_f**2 + 1.0))


def jeffery_period(scene: Scene, group: FiberGroup) -> float | None:
    """T = 2 pi (r_e + 1/r_e)/rate, s: full turn of a rigid massless fiber in simple shear."""
    r_e = equivalent_aspect_ratio(scene, group)
    if r_e is None or scene.flow is None or scene.flow.kind != "simple_shear":
        return None
    return 2.0 * math.pi * (r_e + 1.0 / r_e) / scene.flow.rate


def crowding(scene: Scene, group: FiberGroup) -> float | None:
    """V_f r_f of a group; above 1 a reduced chain agrees with the unreduced one in a suspension."""
    if scene.box is None or group.volume_fraction_achieved is None:
        return None
    return group.volume_fraction_achieved * group.aspect_ratio


def node_count(group: FiberGroup) -> int:
    """Number of nodes of a group: count (segments + 1)."""
    return group.count * (group.segments + 1)


def segment_count(group: FiberGroup) -> int:
    """Number of segments of a group."""
    return group.count * group.segments


def bead_count(group: FiberGroup) -> float:
    """Number of beads of the unreduced fibers of a group: count r_f, not always whole."""
    return group.count * group.aspect_ratio


def fiber_count(scene: Scene) -> int:
    """Number of fibers of all groups."""
    return sum(group.count for group in scene.fibers)


def total_strain(scene: Scene) -> float | None:
    """Strain of the whole run with repeats; None if a stage of it ends by time under a schedule."""
    strain = 0.0
    rate = scene.flow.rate if scene.flow is not None else 0.0
    steady = scene.flow is None or scene.flow.schedule is None
    for stage in scene.stage_sequence:
        if stage.end_time is not None and not steady:
            return None
        ends = [stage.end_strain] if stage.end_strain is not None else []
        ends += [rate * stage.end_time] if stage.end_time is not None else []
        if not ends:
            return None
        strain += min(ends)
    return strain


def longest_segment(scene: Scene) -> float:
    """Longest rest length of a segment of all groups, m; 0 if node files have them all."""
    lengths = [group.centerline_length / group.segments for group in scene.fibers if group.segments]
    return max(lengths, default=0.0)


def interaction_range(scene: Scene) -> float:
    """Center line distance below which two fibers act on each other, m; 0 without pair forces."""
    radius = max((group.radius for group in scene.fibers), default=0.0)
    return reach(scene.contact.law, scene.contact.lubrication, radius)


def reach(law: str, lubrication: str, radius: float) -> float:
    """Interaction range of fibers of one radius, m: 2.001 a, 3 a with lubrication, or 0."""
    if law == "none":
        return 0.0
    return radius * (REPULSION_REACH if lubrication == "none" else LUBRICATION_REACH)


def group_volume(scene: Scene, group: FiberGroup) -> float:
    """Volume of one fiber of a group, m^3, by the box's volume rule; rings have no ends."""
    rule = scene.box.volume_rule if scene.box is not None else "cylinder"
    ring = group.shape.kind == "ring"
    return fiber_volume("centerline" if ring else rule, group.diameter, group.length)


def fiber_volume(rule: str, diameter: float, length: float) -> float:
    """Volume of a straight fiber of `length` L tip to tip, m^3, by the box's volume rule.

    cylinder pi a^2 L, capsule pi a^2 (L_c + 4a/3), centerline pi a^2 L_c; L_c = L - d.
    """
    radius = 0.5 * diameter
    counted = {
        "cylinder": length,
        "capsule": length - diameter + 4.0 * radius / 3.0,
        "centerline": length - diameter,
    }[rule]
    return math.pi * radius * radius * counted
