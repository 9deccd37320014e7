"""Contact of one node with the plane walls of the box: Hertz, dashpot, friction with memory.

Source: laws `hertz` and `friction`; walls are rigid. Those of axis `press` move along their normal,
    and what they push with is told.
"""

from functools import cache

import warp as wp

from warpfiber.laws.friction import make_friction
from warpfiber.laws.hertz import DASHPOT, make_hertz
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct, node_struct

SIDES = 6  # places of a node's memories: axis by axis, low before high


@cache
def make_node_walls(name: str, walls: tuple[bool, bool, bool], has_friction: bool, press: int):
    """`wall_loads`: force and moment of all walls on a node; memories move on by dt.

    Third, the pushes of the two walls of axis `press` (-1: none).
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    BondGroup = bond_group_struct(name)
    Node = node_struct(name)
    plane_stiffness, plane_push, _ = make_hertz(name)
    carried_memory, friction_force = make_friction(name)
    wall_x, wall_y, wall_z = walls
    zero, half = real(0.0), real(0.5)
    dashpot = real(DASHPOT)

    @wp.func
    def one_wall(
        g: BondGroup,
        beta: real,
        friction: real,
        dt: real,
        mass: real,
        node: Node,
        n: vec3,
        gap: real,
        approach: real,
        slot: wp.int32,
        memories: wp.array(dtype=vec3),
        depths: wp.array(dtype=real),
    ):
        """n points into the box; gap from the wall to the center; approach: speed of the wall.

        Force, moment and push; the approach counts along n.
        """
        force = vec3(zero, zero, zero)
        moment = vec3(zero, zero, zero)
        depth = g.radius - gap
        if depth <= zero:
            if wp.static(has_friction):
                if depths[slot] != zero:
                    depths[slot] = zero
            return force, moment, zero
        k = plane_stiffness(g.wall_modulus, g.radius, depth)
        speed = wp.dot(node.v, n) - approach
        size = plane_push(k, beta, mass, depth, speed)
        if wp.static(has_friction):
            arm = -gap * n
            slide = node.v + wp.cross(node.w, arm)
            slide -= wp.dot(slide, n) * n
            stiffness = real(4.0) * g.compliance / g.shear_compliance * k
            turn = half * dt * wp.dot(node.w, n)
            memory = carried_memory(memories[slot], depths[slot], depth, n, turn)
            resistance = dashpot * beta * wp.sqrt(stiffness * mass)
            force, memory = friction_force(
                memory + dt * slide, stiffness, resistance, slide, friction * size
            )
            memories[slot] = memory
            depths[slot] = depth
            moment = wp.cross(arm, force)
        return force + size * n, moment, size

    @wp.func
    def wall_loads(
        g: BondGroup,
        beta: real,
        friction: real,
        dt: real,
        mass: real,
        i: wp.int32,
        node: Node,
        wall_place: wp.array(dtype=wp.vec3d),
        wall_velocity: wp.array(dtype=wp.vec2d),
        memories: wp.array(dtype=vec3),
        depths: wp.array(dtype=real),
    ):
        force = vec3(zero, zero, zero)
        moment = vec3(zero, zero, zero)
        pushes = wp.vec2d()
        for axis in range(3):
            has_wall = wp.static(wall_x)
            if axis == 1:
                has_wall = wp.static(wall_y)
            if axis == 2:
                has_wall = wp.static(wall_z)
            if has_wall:
                for side in range(2):
                    n = vec3(zero, zero, zero)
                    n[axis] = real(1 - 2 * side)
                    gap = real(node.x[axis] - wall_place[side][axis])
                    if side == 1:
                        gap = -gap
                    approach = zero
                    if axis == wp.static(press):
                        approach = n[axis] * real(wall_velocity[0][side])
                    push, couple, size = one_wall(
                        g,
                        beta,
                        friction,
                        dt,
                        mass,
                        node,
                        n,
                        gap,
                        approach,
                        wp.static(SIDES) * i + 2 * axis + side,
                        memories,
                        depths,
                    )
                    force += push
                    moment += couple
                    if axis == wp.static(press):
                        pushes[side] = wp.float64(size)
        return force, moment, pushes

    return wall_loads
