"""What bonds, walls and the damping of a stage dissipate in a step of bonded spheres.

One thread per fiber adds to its sums. The loads of a step are found with the speeds amid it,
v - a dt / 2; around them they do the work F . v dt (see `contact_energy`).
Source: laws `bond`, `hertz` and `friction`. Friction on walls: work put in against it; what its
    memories store is told by `bond_energy`. Drive: what walls that move in their planes put in.
"""

from functools import cache

import warp as wp

from warpfiber.laws.bond import make_bond
from warpfiber.laws.friction import make_friction
from warpfiber.laws.hertz import DASHPOT, make_hertz
from warpfiber.model import HALT, precision
from warpfiber.passes.array_items import make_items
from warpfiber.passes.bond_groups import bond_group_struct, node_struct
from warpfiber.passes.bonds import SETTLING, BondFeatures
from warpfiber.passes.kernel_module import FUSED
from warpfiber.passes.node_walls import CONTAINER, CORNERS, SIDES, make_concave

LOST = ("bonds", "settling", "walls", "wall friction", "drive")  # columns


@cache
def make_bond_losses(name: str, features: BondFeatures):
    """Kernel `bond_losses`: adds to the columns LOST of every fiber."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    Node = node_struct(name)
    _, _, bond_dashpots = make_bond(name)
    plane_stiffness, plane_push, _ = make_hertz(name)
    _, friction_force = make_friction(name)
    wall_x, wall_y, wall_z = features.walls
    has_walls, has_friction = any(features.walls), features.wall_friction
    has_container, planes = features.container, features.planes
    sides, first_plane = SIDES + planes, CORNERS + has_container
    container_gap, inside_radius = make_concave(name)
    has_dashpots = features.dashpots
    zero, half = real(0.0), real(0.5)
    spring_part, dashpot = real(2.0 / 3.0), real(DASHPOT)
    point, _ = make_items(wp.vec3d)
    vector, _ = make_items(vec3)

    @wp.func
    def node_at(
        i: wp.int32,
        back: real,
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
        node_rate: wp.array(dtype=vec3),
        node_spin_rate: wp.array(dtype=vec3),
    ) -> Node:
        """Place, and speeds a time `back` ago (0: now)."""
        node = Node()
        node.x = point(place, i)
        node.v = vector(node_velocity, i) - back * vector(node_rate, i)
        node.w = vector(node_spin, i) - back * vector(node_spin_rate, i)
        return node

    @wp.func
    def bond_loss(c: vec4, amid_i: Node, amid_j: Node, now_i: Node, now_j: Node) -> real:
        d = vec3(now_j.x - now_i.x)
        force, moment = bond_dashpots(c, d, amid_j.v - amid_i.v, amid_i.w, amid_j.w)
        slip = now_j.v - now_i.v - half * wp.cross(now_i.w + now_j.w, d)
        return wp.dot(force, slip) + wp.dot(moment, now_j.w - now_i.w)

    @wp.func
    def wall_loss(
        g: BondGroup,
        beta: real,
        face: vec4,
        mass: real,
        amid: Node,
        now: Node,
        n: vec3,
        gap: real,
        curvature_radius: real,
        approach: real,
        slot: wp.int32,
        memories: wp.array(dtype=vec3),
    ):
        """Of the dashpot, and what friction takes; n points into the box."""
        depth = g.radius - gap
        if depth <= zero:
            return zero, zero, zero
        k = plane_stiffness(g.wall_modulus, curvature_radius, depth)
        size = plane_push(k, beta, mass, depth, wp.dot(amid.v, n) - approach)
        lost = (spring_part * k * depth - size) * (wp.dot(now.v, n) - approach)
        rubbed = zero
        driven = zero
        if wp.static(has_friction):
            arm = -gap * n
            velocity = vec3(face[1], face[2], face[3])
            slide = amid.v + wp.cross(amid.w, arm) - velocity
            slide -= wp.dot(slide, n) * n
            stiffness = real(4.0) * g.compliance / g.shear_compliance * k
            resistance = dashpot * beta * wp.sqrt(stiffness * mass)
            force, _h = friction_force(memories[slot], stiffness, resistance, slide, face[0] * size)
            driven = wp.dot(force, velocity)
            rubbed = driven - wp.dot(force, now.v + wp.cross(now.w, arm))
        return lost, rubbed, driven

    @wp.kernel(module="unique", module_options=FUSED, enable_backward=False, grid_stride=False)
    def bond_losses(
        offset: wp.int32,
        dt: wp.float64,
        press: wp.int32,
        wall_place: wp.array(dtype=wp.vec3d),
        wall_velocity: wp.array(dtype=wp.vec2d),
        wall_damping: real,
        wall_face: wp.array(dtype=vec4),
        stage: wp.array(dtype=real),
        groups: wp.array(dtype=BondGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        wall_memory: wp.array(dtype=vec3),
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
        node_rate: wp.array(dtype=vec3),
        node_spin_rate: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        lost: wp.array2d(dtype=wp.float64),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        g = groups[fiber_group[fiber]]
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        settling = stage[wp.static(SETTLING)]
        back = half * real(dt)
        in_bonds = wp.float64(0.0)
        in_settling = wp.float64(0.0)
        at_walls = wp.float64(0.0)
        rubbed = wp.float64(0.0)
        driven = wp.float64(0.0)
        amid = node_at(first, back, place, node_velocity, node_spin, node_rate, node_spin_rate)
        now = node_at(first, zero, place, node_velocity, node_spin, node_rate, node_spin_rate)
        for i in range(first, last + 1):
            j = wp.where(i == last, first, i + 1)
            amid_j = node_at(j, back, place, node_velocity, node_spin, node_rate, node_spin_rate)
            now_j = node_at(j, zero, place, node_velocity, node_spin, node_rate, node_spin_rate)
            mass = g.mass
            inertia = g.inertia
            if (i == first or i == last) and g.closed == 0:
                mass = g.end_mass
                inertia = g.end_inertia
            damped = mass * wp.dot(amid.v, now.v) + inertia * wp.dot(amid.w, now.w)
            in_settling += wp.float64(settling * damped)
            if wp.static(has_dashpots):
                if i < last or g.closed == 1:
                    in_bonds += wp.float64(bond_loss(g.dashpots, amid, amid_j, now, now_j))
            if wp.static(has_walls):
                for axis in range(3):
                    has_wall = wp.static(wall_x)
                    if axis == 1:
                        has_wall = wp.static(wall_y)
                    if axis == 2:
                        has_wall = wp.static(wall_z)
                    if has_wall:
                        for side_of in range(2):
                            n = vec3(zero, zero, zero)
                            n[axis] = real(1 - 2 * side_of)
                            gap = real(now.x[axis] - wall_place[side_of][axis])
                            if side_of == 1:
                                gap = -gap
                            approach = zero
                            if axis == press:
                                approach = n[axis] * real(wall_velocity[0][side_of])
                            slot = wp.static(sides) * i + 2 * axis + side_of
                            loss, slid, drive = wall_loss(
                                g,
                                wall_damping,
                                wall_face[2 * axis + side_of],
                                mass,
                                amid,
                                now,
                                n,
                                gap,
                                g.radius,
                                approach,
                                slot,
                                wall_memory,
                            )
                            at_walls += wp.float64(loss)
                            rubbed += wp.float64(slid)
                            driven += wp.float64(drive)
            if wp.static(has_container):
                side = container_gap(now.x, wall_place[2])
                loss, slid, _drive = wall_loss(
                    g,
                    wall_damping,
                    wall_face[wp.static(CONTAINER)],
                    mass,
                    amid,
                    now,
                    vec3(side[0], side[1], side[2]),
                    side[3],
                    inside_radius(g.radius, wall_place[2]),
                    zero,
                    wp.static(sides) * i + wp.static(CONTAINER),
                    wall_memory,
                )
                at_walls += wp.float64(loss)
                rubbed += wp.float64(slid)
            if wp.static(planes > 0):
                for k in range(wp.static(planes)):
                    inwards = wall_place[wp.static(first_plane) + 2 * k]
                    away = now.x - wall_place[wp.static(first_plane) + 2 * k + 1]
                    loss, slid, drive = wall_loss(
                        g,
                        wall_damping,
                        wall_face[wp.static(SIDES) + k],
                        mass,
                        amid,
                        now,
                        vec3(inwards),
                        real(wp.dot(away, inwards)),
                        g.radius,
                        zero,
                        wp.static(sides) * i + wp.static(SIDES) + k,
                        wall_memory,
                    )
                    at_walls += wp.float64(loss)
                    rubbed += wp.float64(slid)
                    driven += wp.float64(drive)
            amid = amid_j
            now = now_j
        lost[fiber, 0] = lost[fiber, 0] + dt * in_bonds
        lost[fiber, 1] = lost[fiber, 1] + dt * in_settling
        lost[fiber, 2] = lost[fiber, 2] + dt * at_walls
        lost[fiber, 3] = lost[fiber, 3] + dt * rubbed
        lost[fiber, 4] = lost[fiber, 4] + dt * driven

    return bond_losses
