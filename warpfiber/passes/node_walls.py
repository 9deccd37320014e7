"""Contact of one node with the walls of box and container: Hertz, dashpot, friction with memory.

Source: laws `hertz` and `friction`; walls are rigid. Those of axis `press` move along their normal,
    and what they push with is told. A container is a cylinder along z around the fibers: inside it
    R* = 1 / (1 / a - 1 / R).
Symbols: places of walls: lower and upper corner, of a container (x, y of its axis, R), of other
    planes (unit normal inwards, a point). Faces of walls: friction, velocity in their planes.
"""

from functools import cache

import warp as wp

from warpfiber.laws.friction import make_friction
from warpfiber.laws.hertz import DASHPOT, make_hertz
from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct, node_struct

SIDES = 7  # places of a node's memories: axis by axis, low before high; the container; other planes
CONTAINER = 6
CORNERS = 2  # places before those of a container and of other planes


@cache
def make_concave(name: str):
    """`container_gap(x, place)`: (way inwards, gap) from the container to a center, or no way."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    zero, one = real(0.0), real(1.0)

    @wp.func
    def container_gap(x: wp.vec3d, place: wp.vec3d) -> vec4:
        across = vec3(real(x[0] - place[0]), real(x[1] - place[1]), zero)
        away = wp.length(across)
        if away == zero:
            return vec4(one, zero, zero, real(place[2]))
        n = across / -away
        return vec4(n[0], n[1], zero, real(place[2]) - away)

    @wp.func
    def inside_radius(radius: real, place: wp.vec3d) -> real:
        """R* of a sphere inside the container."""
        return radius / (one - radius / real(place[2]))

    return container_gap, inside_radius


@cache
def make_node_walls(
    name: str,
    walls: tuple[bool, bool, bool],
    has_friction: bool,
    press: int,
    has_container: bool = False,
    planes: int = 0,
):
    """`wall_loads`: force and moment of all walls on a node; memories move on by dt.

    Third, the pushes of the two walls of axis `press` (-1: none).
    """
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    Node = node_struct(name)
    plane_stiffness, plane_push, _ = make_hertz(name)
    carried_memory, friction_force = make_friction(name)
    container_gap, inside_radius = make_concave(name)
    wall_x, wall_y, wall_z = walls
    zero, half = real(0.0), real(0.5)
    dashpot = real(DASHPOT)
    sides, first_plane = SIDES + planes, CORNERS + has_container

    @wp.func
    def one_wall(
        g: BondGroup,
        beta: real,
        face: vec4,
        dt: real,
        mass: real,
        node: Node,
        n: vec3,
        gap: real,
        curvature_radius: real,
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
                # no step takes a node a radius away: the memories of most are not even read
                if depth > -g.radius and depths[slot] != zero:
                    depths[slot] = zero
            return force, moment, zero
        k = plane_stiffness(g.wall_modulus, curvature_radius, depth)
        speed = wp.dot(node.v, n) - approach
        size = plane_push(k, beta, mass, depth, speed)
        if wp.static(has_friction):
            arm = -gap * n
            slide = node.v + wp.cross(node.w, arm) - vec3(face[1], face[2], face[3])
            slide -= wp.dot(slide, n) * n
            stiffness = real(4.0) * g.compliance / g.shear_compliance * k
            turn = half * dt * wp.dot(node.w, n)
            memory = carried_memory(memories[slot], depths[slot], depth, n, turn)
            resistance = dashpot * beta * wp.sqrt(stiffness * mass)
            force, memory = friction_force(
                memory + dt * slide, stiffness, resistance, slide, face[0] * size
            )
            memories[slot] = memory
            depths[slot] = depth
            moment = wp.cross(arm, force)
        return force + size * n, moment, size

    @wp.func
    def wall_loads(
        g: BondGroup,
        beta: real,
        faces: wp.array(dtype=vec4),
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
                        faces[2 * axis + side],
                        dt,
                        mass,
                        node,
                        n,
                        gap,
                        g.radius,
                        approach,
                        wp.static(sides) * i + 2 * axis + side,
                        memories,
                        depths,
                    )
                    force += push
                    moment += couple
                    if axis == wp.static(press):
                        pushes[side] = wp.float64(size)
        if wp.static(has_container):
            from_side = container_gap(node.x, wall_place[2])
            push, couple, _size = one_wall(
                g,
                beta,
                faces[wp.static(CONTAINER)],
                dt,
                mass,
                node,
                vec3(from_side[0], from_side[1], from_side[2]),
                from_side[3],
                inside_radius(g.radius, wall_place[2]),
                zero,
                wp.static(sides) * i + wp.static(CONTAINER),
                memories,
                depths,
            )
            force += push
            moment += couple
        if wp.static(planes > 0):
            for k in range(wp.static(planes)):
                inwards = wall_place[wp.static(first_plane) + 2 * k]
                away = node.x - wall_place[wp.static(first_plane) + 2 * k + 1]
                push, couple, _other = one_wall(
                    g,
                    beta,
                    faces[wp.static(SIDES) + k],
                    dt,
                    mass,
                    node,
                    vec3(inwards),
                    real(wp.dot(away, inwards)),
                    g.radius,
                    zero,
                    wp.static(sides) * i + wp.static(SIDES) + k,
                    memories,
                    depths,
                )
                force += push
                moment += couple
        return force, moment, pushes

    return wall_loads
