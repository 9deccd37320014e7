"""Energies of fibers made of bonded spheres: a device sweep that only reads, and its sums.

One thread per fiber writes that fiber's energies; the host adds them in the order of the fibers.
Source: laws `bond` and `hertz`; weight is potential against the middle of the box, or of the start.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfiber.laws.bond import make_bond
from warpfiber.laws.hertz import make_hertz
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.node_walls import CONTAINER, CORNERS, SIDES, make_concave

# Columns; those of walls are zero without them.
ENERGIES = (
    "kinetic",
    "stretching",
    "shear",
    "bending",
    "twist",
    "gravity",
    "wall",
    "wall friction",
)


@cache
def make_measure_bonds(
    name: str,
    walls: tuple[bool, bool, bool],
    has_friction: bool = False,
    has_container: bool = False,
    planes: int = 0,
):
    """Kernel `measure_bonds`: energies (F, len(ENERGIES)) of the present state."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    _, bond_energies, _ = make_bond(name)
    plane_stiffness, _, plane_energy = make_hertz(name)
    wall_x, wall_y, wall_z = walls
    has_walls = any(walls) or has_container or planes > 0
    sides, first_plane = SIDES + planes, CORNERS + has_container
    container_gap, inside_radius = make_concave(name)
    half_real = real(0.5)

    @wp.func
    def rubbed_energy(g: BondGroup, radius: real, depth: real, h: vec3) -> wp.float64:
        """Of the memory of a wall's friction; a stale one has no depth."""
        k = real(4.0) * g.compliance / g.shear_compliance
        k *= plane_stiffness(g.wall_modulus, radius, depth)
        return wp.float64(half_real * k * wp.length_sq(h))

    @wp.func
    def walls_energy(
        g: BondGroup,
        x: wp.vec3d,
        i: wp.int32,
        wall_place: wp.array(dtype=wp.vec3d),
        wall_memory: wp.array(dtype=vec3),
    ) -> wp.vec2d:
        """Of the pushes of all walls on a node, and of their friction."""
        energy = wp.vec2d()
        for axis in range(3):
            has_wall = wp.static(wall_x)
            if axis == 1:
                has_wall = wp.static(wall_y)
            if axis == 2:
                has_wall = wp.static(wall_z)
            if has_wall:
                below = g.radius - real(x[axis] - wall_place[0][axis])
                above = g.radius - real(wall_place[1][axis] - x[axis])
                energy[0] += wp.float64(plane_energy(g.wall_modulus, g.radius, below))
                energy[0] += wp.float64(plane_energy(g.wall_modulus, g.radius, above))
                if wp.static(has_friction):
                    slot = wp.static(sides) * i + 2 * axis
                    energy[1] += rubbed_energy(g, g.radius, below, wall_memory[slot])
                    energy[1] += rubbed_energy(g, g.radius, above, wall_memory[slot + 1])
        if wp.static(has_container):
            radius = inside_radius(g.radius, wall_place[2])
            depth = g.radius - container_gap(x, wall_place[2])[3]
            energy[0] += wp.float64(plane_energy(g.wall_modulus, radius, depth))
            if wp.static(has_friction):
                h = wall_memory[wp.static(sides) * i + wp.static(CONTAINER)]
                energy[1] += rubbed_energy(g, radius, depth, h)
        if wp.static(planes > 0):
            for k in range(wp.static(planes)):
                inwards = wall_place[wp.static(first_plane) + 2 * k]
                away = x - wall_place[wp.static(first_plane) + 2 * k + 1]
                into = g.radius - real(wp.dot(away, inwards))
                energy[0] += wp.float64(plane_energy(g.wall_modulus, g.radius, into))
                if wp.static(has_friction):
                    kept = wall_memory[wp.static(sides) * i + wp.static(SIDES) + k]
                    energy[1] += rubbed_energy(g, g.radius, into, kept)
        return energy

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def measure_bonds(
        middle: wp.vec3d,
        wall_place: wp.array(dtype=wp.vec3d),
        wall_memory: wp.array(dtype=vec3),
        groups: wp.array(dtype=BondGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        bond_axis: wp.array(dtype=vec3),
        bond_length: wp.array(dtype=real),
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        node_turn: wp.array(dtype=vec4),
        node_spin: wp.array(dtype=vec3),
        energies_out: wp.array2d(dtype=wp.float64),
    ):
        fiber = wp.tid()
        g = groups[fiber_group[fiber]]
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        half = wp.float64(0.5)
        kinetic = wp.float64(0.0)
        gravity = wp.float64(0.0)
        wall = wp.vec2d()
        bonds = wp.vec4d()
        for i in range(first, last + 1):
            mass = wp.float64(g.mass)
            inertia = wp.float64(g.inertia)
            if (i == first or i == last) and g.closed == 0:
                mass = wp.float64(g.end_mass)
                inertia = wp.float64(g.end_inertia)
            moving = mass * wp.length_sq(wp.vec3d(node_velocity[i]))
            kinetic += half * (moving + inertia * wp.length_sq(wp.vec3d(node_spin[i])))
            gravity -= mass * wp.dot(wp.vec3d(g.weight), place[i] - middle)
            if wp.static(has_walls):
                wall += walls_energy(g, place[i], i, wall_place, wall_memory)
            j = i + 1
            if i == last:
                j = first
            if i < last or g.closed == 1:
                d = vec3(place[j] - place[i])
                bonds += wp.vec4d(
                    bond_energies(
                        g.stiffness, bond_axis[i], bond_length[i], d, node_turn[i], node_turn[j]
                    )
                )
        energies_out[fiber, 0] = kinetic
        for part in range(4):
            energies_out[fiber, part + 1] = bonds[part]
        energies_out[fiber, 5] = gravity
        energies_out[fiber, 6] = wall[0]
        energies_out[fiber, 7] = wall[1]

    return measure_bonds


def measure_bond_energies(
    kernel: Any, fibers: int, inputs: list[Any], device: str
) -> dict[str, float]:
    """Sums of all ENERGIES over the fibers, run units."""
    energies = wp.zeros((fibers, len(ENERGIES)), dtype=wp.float64, device=device)
    wp.launch(kernel, dim=fibers, inputs=[*inputs, energies], device=device)
    return dict(zip(ENERGIES, np.sum(energies.numpy(), axis=0).tolist(), strict=True))
