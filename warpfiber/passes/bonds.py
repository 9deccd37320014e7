"""One sweep over fibers made of bonded spheres: kick, drift, loads of bonds, pairs and walls, kick.

One thread walks along one fiber with the node before in its registers: a node is finished as soon
as the bond behind it is known, so positions are read and written once. Where fibers meet, kick and
drift are a sweep of their own (`bond_drift`), with the pairs between the two. Positions are float64
in every precision; bonds work with their differences.
Source: velocity Verlet; loads that depend on speed take that of the middle of the step.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.laws.bond import make_bond
from warpfiber.laws.rotation import make_rotation
from warpfiber.model import BAD_FIBER, HALT, TORN, precision
from warpfiber.passes.array_items import make_items
from warpfiber.passes.bond_groups import bond_group_struct, node_struct
from warpfiber.passes.capsule_pairs import make_gather
from warpfiber.passes.kernel_module import FUSED
from warpfiber.passes.node_walls import make_node_walls

# Of a node: moves; moves as told; also does not turn; the same in the lower and the upper grip.
FREE, HELD, CLAMPED, LOWER, UPPER = range(5)
SETTLING, END_SPEED = 0, 1  # slots of the stage's numbers: damping, squared speed of a still node
STAGE_SIZE = 2


@dataclass(frozen=True)
class BondFeatures:
    """What the sweep of a scene contains; everything else is not compiled."""

    dashpots: bool = False
    walls: tuple[bool, bool, bool] = (False, False, False)
    loads: bool = False  # forces on single nodes, and nodes that are held
    closed: bool = False  # some fibers are rings
    pairs: bool = False
    wall_friction: bool = False
    press: int = -1  # axis whose walls may move and are metered
    container: bool = False  # a cylinder around the fibers
    planes: int = 0  # beside those of the box
    grips: bool = False  # what acts on the nodes of grips is told; needs `loads`

    @property
    def walled(self) -> bool:
        """Whether there is any wall."""
        return any(self.walls) or self.container or self.planes > 0


@cache
def make_bond_sweep(name: str, features: BondFeatures, drifts: bool, kicks: bool):
    """Kernel `bond_sweep`: a step; without `drifts` what is left of it after `bond_drift`.

    Without `kicks` too: only the accelerations of the start.
    """
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    Node = node_struct(name)
    bond_loads, _, bond_dashpots = make_bond(name)
    turned = make_rotation(name)
    wall_loads = make_node_walls(
        name,
        features.walls,
        features.wall_friction,
        features.press,
        features.container,
        features.planes,
    )
    gather_pairs = make_gather(name, features.closed)
    has_walls, is_metered = features.walled, features.press >= 0
    has_dashpots, has_loads = features.dashpots, features.loads
    has_rings, has_pairs = features.closed, features.pairs
    has_grips = features.grips
    is_single = name == "float32"
    zero, half, one = real(0.0), real(0.5), real(1.0)
    point, set_point = make_items(wp.vec3d)
    vector, set_vector = make_items(vec3)
    turn, set_turn = make_items(vec4)
    scalar, _ = make_items(real)

    @wp.func
    def arrived(
        i: wp.int32,
        dt: real,
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        node_turn: wp.array(dtype=vec4),
        node_spin: wp.array(dtype=vec3),
        node_rate: wp.array(dtype=vec3),
        node_spin_rate: wp.array(dtype=vec3),
    ) -> Node:
        """The node after the first half kick and the drift."""
        node = Node()
        node.x = point(place, i)
        node.v = vector(node_velocity, i)
        node.q = turn(node_turn, i)
        node.w = vector(node_spin, i)
        if wp.static(drifts):
            node.v += (half * dt) * vector(node_rate, i)
            node.w += (half * dt) * vector(node_spin_rate, i)
            node.x += wp.vec3d(dt * node.v)
            node.q = turned(node.q, node.w, dt)
        return node

    @wp.func
    def bond_between(g: BondGroup, e0: vec3, l0: real, node_i: Node, node_j: Node):
        """Force and moments of a bond on its two nodes, and its length squared."""
        d = vec3(node_j.x - node_i.x)
        force, twist = bond_loads(g.stiffness, e0, l0, d, node_i.q, node_j.q)
        if wp.static(has_dashpots):
            resistance, moment = bond_dashpots(
                g.dashpots, d, node_j.v - node_i.v, node_i.w, node_j.w
            )
            force += resistance
            twist += moment
        couple = half * wp.cross(d, force)
        return force, couple + twist, couple - twist, wp.length_sq(d)

    @wp.kernel(module="unique", module_options=FUSED, enable_backward=False, grid_stride=False)
    def bond_sweep(
        offset: wp.int32,
        dt: real,
        wall_place: wp.array(dtype=wp.vec3d),
        wall_velocity: wp.array(dtype=wp.vec2d),
        fiber_push: wp.array(dtype=wp.vec2d),
        wall_damping: real,
        wall_face: wp.array(dtype=vec4),
        stage: wp.array(dtype=real),
        groups: wp.array(dtype=BondGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_segment_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        bond_axis: wp.array(dtype=vec3),
        bond_length: wp.array(dtype=real),
        node_hold: wp.array(dtype=wp.int32),
        node_load: wp.array(dtype=vec3),
        node_grip: wp.array(dtype=vec3),
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_force: wp.array(dtype=vec3),
        pair_arms: wp.array(dtype=vec4),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_hit: wp.array(dtype=wp.int32),
        hit_moment: wp.array(dtype=vec3),
        hit_beside: wp.array(dtype=vec3),
        pair_acting: wp.array(dtype=wp.int32),
        contact_force: wp.array(dtype=vec3),
        contact_moment: wp.array(dtype=vec3),
        wall_memory: wp.array(dtype=vec3),
        wall_depth: wp.array(dtype=real),
        place: wp.array(dtype=wp.vec3d),
        node_pos_out: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_turn: wp.array(dtype=vec4),
        node_spin: wp.array(dtype=vec3),
        node_rate: wp.array(dtype=vec3),
        node_spin_rate: wp.array(dtype=vec3),
        still_steps: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        g = groups[fiber_group[fiber]]
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        settling = stage[wp.static(SETTLING)]
        kick = half * dt
        nothing = vec3(zero, zero, zero)
        torn2 = g.torn_length * g.torn_length
        torn = wp.int32(0)
        fastest2 = zero
        pushed = wp.vec2d()

        if wp.static(has_pairs):
            first_segment = first - fiber
            if wp.static(has_rings):
                first_segment = fiber_segment_start[fiber]
            gather_pairs(
                first_segment,
                first_segment + last - first + g.closed,
                first,
                last,
                out_start,
                in_start,
                in_pair,
                pair_i,
                pair_j,
                pair_force,
                pair_arms,
                pair_acts,
                pair_hit,
                hit_moment,
                hit_beside,
                pair_acting,
                contact_force,
                contact_moment,
            )

        # A ring's last bond pulls at the first node now and at the last node in the end.
        force = nothing
        moment = nothing
        last_force = nothing
        last_moment = nothing
        node = arrived(
            first, dt, place, node_velocity, node_turn, node_spin, node_rate, node_spin_rate
        )
        if wp.static(has_rings):
            if g.closed == 1:
                end = arrived(
                    last, dt, place, node_velocity, node_turn, node_spin, node_rate, node_spin_rate
                )
                pull, moment_i, moment_j, length2 = bond_between(
                    g, bond_axis[last], bond_length[last], end, node
                )
                last_force = pull
                last_moment = moment_i
                force = -pull
                moment = moment_j
                if not (length2 < torn2):  # not finite is torn too
                    torn = 1

        by_inner_mass = one / g.mass
        by_end_mass = one / g.end_mass
        by_inner_inertia = one / g.inertia
        by_end_inertia = one / g.end_inertia
        for i in range(first, last + 1):
            after = node
            force_after = last_force
            moment_after = last_moment
            if i < last:
                after = arrived(
                    i + 1, dt, place, node_velocity, node_turn, node_spin, node_rate, node_spin_rate
                )
                pull, moment_i, moment_j, length2 = bond_between(
                    g, vector(bond_axis, i), scalar(bond_length, i), node, after
                )
                force += pull
                moment += moment_i
                force_after = -pull
                moment_after = moment_j
                if i + 1 == last:
                    force_after += last_force
                    moment_after += last_moment
                if not (length2 < torn2):
                    torn = 1
            if wp.static(has_pairs):
                force += vector(contact_force, i)
                moment += vector(contact_moment, i)
                set_vector(contact_force, i, nothing)
                set_vector(contact_moment, i, nothing)

            is_end = (i == first or i == last) and g.closed == 0
            mass = wp.where(is_end, g.end_mass, g.mass)
            if wp.static(has_grips):
                if node_hold[i] >= wp.static(LOWER):
                    node_grip[i] = force
            if wp.static(has_walls):
                step = zero
                if wp.static(kicks):
                    step = dt
                push, couple, pushes = wall_loads(
                    g,
                    wall_damping,
                    wall_face,
                    step,
                    mass,
                    i,
                    node,
                    wall_place,
                    wall_velocity,
                    wall_memory,
                    wall_depth,
                )
                force += push
                moment += couple
                if wp.static(is_metered):
                    pushed += pushes
            hold = wp.int32(0)
            if wp.static(has_loads):
                hold = node_hold[i]
                if hold == wp.static(FREE):
                    force += node_load[i]
            by_mass = wp.where(is_end, by_end_mass, by_inner_mass)
            by_inertia = wp.where(is_end, by_end_inertia, by_inner_inertia)
            rate = by_mass * force + g.weight - settling * node.v
            spin_rate = by_inertia * moment - settling * node.w
            v = node.v
            w = node.w
            if wp.static(kicks):
                v += kick * rate
                w += kick * spin_rate
            if wp.static(has_loads):
                if hold != wp.static(FREE):
                    rate = nothing
                    v = node_load[i]
                if hold >= wp.static(CLAMPED):
                    spin_rate = nothing
                    w = nothing
            set_vector(node_rate, i, rate)
            set_vector(node_spin_rate, i, spin_rate)
            set_vector(node_velocity, i, v)
            set_vector(node_spin, i, w)
            if wp.static(drifts):
                place[i] = node.x
                node_turn[i] = node.q
                if wp.static(is_single):
                    node_pos_out[i] = vec3(node.x)
            fastest2 = wp.max(fastest2, wp.length_sq(v))
            node = after
            force = force_after
            moment = moment_after

        if wp.static(is_metered):
            fiber_push[fiber] = pushed
        if wp.static(kicks):
            count = wp.int32(0)
            if fastest2 < stage[wp.static(END_SPEED)]:
                count = still_steps[fiber] + 1
            still_steps[fiber] = count
        if torn == 1:
            status[wp.static(TORN)] = 1
            status[wp.static(BAD_FIBER)] = fiber

    return bond_sweep
