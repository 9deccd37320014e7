"""The sweeps over bonded spheres for the CPU: one block of fibers of one group at a time, SIMD.

A lane is a fiber. The block's nodes are transposed from the state arrays into a scratch of vectors
on the stack, the laws run on all lanes at once, and the nodes are transposed back. What no other
sweep reads is kept as vectors from launch to launch (`node_blocks`). Loads of walls
keep their one source: the laws of `node_walls` for the few nodes that touch one. Nothing in a lane
depends on the other lanes, so it does not matter which fibers share a block.

A launch does what its phase says: accelerations, the half kick that ends a step, the half kick and
drift that begin one. The end of a step and the begin of the next in one launch give the same as in
two, to the last bit; accelerations are then not stored.

Limits: open fibers of LEAST_NODES to MOST_NODES nodes that can meet; sums are in another order than
    in `bonds` and multiplications and additions are fused: equal to rounding.
"""

from functools import cache

import numpy as np
import warp as wp

from warpfiber.model import HALT, Model, precision
from warpfiber.passes.bond_groups import bond_group_struct, node_struct
from warpfiber.passes.bonds import BondFeatures
from warpfiber.passes.native_bonds_source import END, FROM_NODES, LANES, LOADS, bond_sweep_source
from warpfiber.passes.node_walls import make_node_walls

LEAST_NODES, MOST_NODES = LANES, 256
# A block costs about as much as this many fibers of the plain sweep.
FIBERS_PER_BLOCK = 3
# Arguments of the sweep that are arrays.
ARRAYS = """
    stage groups fiber_node_start fiber_group node_hold node_load node_grip contact_load
    contact_touch fiber_extent fiber_touches node_touches node_push node_couple place node_pos
    node_velocity node_turn node_spin node_rate node_spin_rate still_steps status block_fiber
    block_own block_start block_axis block_length block_pos block_skin block_turn
""".split()


def native_bonds_apply(model: Model, features: BondFeatures) -> bool:
    """Whether the native sweep can do this model and is the faster one."""
    if not model.device.startswith("cpu") or features.closed or not features.pairs:
        return False
    if features.container or features.planes:
        return False
    nodes = np.diff(model.host["fiber_node_start"])
    if nodes.min() < LEAST_NODES or nodes.max() > MOST_NODES:
        return False
    counts = np.bincount(model.host["fiber_group"])
    blocks = int(np.ceil(counts / LANES).sum())
    return model.fiber_count >= FIBERS_PER_BLOCK * blocks


@cache
def make_native_bond_sweep(name: str, features: BondFeatures):
    """Kernel `native_bond_sweep` over blocks of fibers."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    BondGroup = bond_group_struct(name)
    Node = node_struct(name)
    wall_loads = make_node_walls(name, features.walls, features.wall_friction, features.press)
    has_walls, is_metered = any(features.walls), features.press >= 0
    wall_x, wall_y, wall_z = features.walls
    zero = real(0.0)

    @wp.func_native(bond_sweep_source(name, features, ARRAYS))
    def sweep_block(
        block: wp.int32,
        phase: wp.int32,
        dt: real,
        stage: wp.array(dtype=real),
        groups: wp.array(dtype=BondGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        node_hold: wp.array(dtype=wp.int32),
        node_load: wp.array(dtype=vec3),
        node_grip: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=real),
        contact_touch: wp.array(dtype=wp.uint8),
        fiber_extent: wp.array(dtype=wp.float64),
        fiber_touches: wp.array(dtype=wp.uint8),
        node_touches: wp.array(dtype=wp.uint8),
        node_push: wp.array(dtype=vec3),
        node_couple: wp.array(dtype=vec3),
        place: wp.array(dtype=wp.vec3d),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_turn: wp.array(dtype=vec4),
        node_spin: wp.array(dtype=vec3),
        node_rate: wp.array(dtype=vec3),
        node_spin_rate: wp.array(dtype=vec3),
        still_steps: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        block_fiber: wp.array(dtype=wp.int32),
        block_own: wp.array(dtype=wp.int32),
        block_start: wp.array(dtype=wp.int32),
        block_axis: wp.array(dtype=real),
        block_length: wp.array(dtype=real),
        block_pos: wp.array(dtype=wp.float64),
        block_skin: wp.array(dtype=real),
        block_turn: wp.array(dtype=real),
    ): ...

    @wp.func
    def is_at_wall(g: BondGroup, x: wp.vec3d, wall_place: wp.array(dtype=wp.vec3d)) -> wp.bool:
        """Whether a node touches a wall."""
        reach = wp.float64(g.radius)
        for axis in range(3):
            has_wall = wp.static(wall_x)
            if axis == 1:
                has_wall = wp.static(wall_y)
            if axis == 2:
                has_wall = wp.static(wall_z)
            if has_wall:
                if x[axis] - wall_place[0][axis] < reach or wall_place[1][axis] - x[axis] < reach:
                    return True
        return False

    @wp.func
    def is_beside_wall(
        g: BondGroup,
        fiber: wp.int32,
        fiber_extent: wp.array(dtype=wp.float64),
        wall_place: wp.array(dtype=wp.vec3d),
    ) -> wp.bool:
        """Whether some node of a fiber may touch a wall."""
        low = wp.vec3d()
        high = wp.vec3d()
        for axis in range(3):
            low[axis] = fiber_extent[6 * fiber + axis]
            high[axis] = fiber_extent[6 * fiber + 3 + axis]
        return is_at_wall(g, low, wall_place) or is_at_wall(g, high, wall_place)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def native_bond_sweep(
        offset: wp.int32,
        phase: wp.int32,
        dt: real,
        wall_place: wp.array(dtype=wp.vec3d),
        wall_velocity: wp.array(dtype=wp.vec2d),
        fiber_push: wp.array(dtype=wp.vec2d),
        wall_damping: real,
        wall_face: wp.array(dtype=vec4),
        wall_memory: wp.array(dtype=vec3),
        wall_depth: wp.array(dtype=real),
        stage: wp.array(dtype=real),
        groups: wp.array(dtype=BondGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        node_hold: wp.array(dtype=wp.int32),
        node_load: wp.array(dtype=vec3),
        node_grip: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=real),
        contact_touch: wp.array(dtype=wp.uint8),
        fiber_extent: wp.array(dtype=wp.float64),
        fiber_touches: wp.array(dtype=wp.uint8),
        node_touches: wp.array(dtype=wp.uint8),
        node_push: wp.array(dtype=vec3),
        node_couple: wp.array(dtype=vec3),
        place: wp.array(dtype=wp.vec3d),
        node_pos_out: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_turn: wp.array(dtype=vec4),
        node_spin: wp.array(dtype=vec3),
        node_rate: wp.array(dtype=vec3),
        node_spin_rate: wp.array(dtype=vec3),
        still_steps: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        block_fiber: wp.array(dtype=wp.int32),
        block_own: wp.array(dtype=wp.int32),
        block_start: wp.array(dtype=wp.int32),
        block_axis: wp.array(dtype=real),
        block_length: wp.array(dtype=real),
        block_pos: wp.array(dtype=wp.float64),
        block_skin: wp.array(dtype=real),
        block_turn: wp.array(dtype=real),
    ):
        if status[wp.static(HALT)] != 0:
            return
        block = wp.tid() + offset
        if wp.static(has_walls):
            if (phase & wp.static(LOADS)) != 0:
                step = zero
                if (phase & wp.static(END)) != 0:
                    step = dt
                for lane in range(block_own[block]):
                    fiber = block_fiber[wp.static(LANES) * block + lane]
                    g = groups[fiber_group[fiber]]
                    first = fiber_node_start[fiber]
                    last = fiber_node_start[fiber + 1] - 1
                    pushed = wp.vec2d()
                    if (
                        (phase & wp.static(FROM_NODES)) != 0
                        or fiber_touches[fiber] != wp.uint8(0)
                        or is_beside_wall(g, fiber, fiber_extent, wall_place)
                    ):
                        touched = wp.uint8(0)
                        for i in range(first, last + 1):
                            touches = is_at_wall(g, place[i], wall_place)
                            # a node that has just left a wall has a memory to be cleared
                            if not touches and node_touches[i] == wp.uint8(0):
                                continue
                            node_touches[i] = wp.uint8(touches)
                            touched |= node_touches[i]
                            node = Node()
                            node.x = place[i]
                            node.v = node_velocity[i]
                            node.w = node_spin[i]
                            mass = g.mass
                            if i == first or i == last:
                                mass = g.end_mass
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
                            node_push[i] = push
                            node_couple[i] = couple
                            if wp.static(is_metered):
                                pushed += pushes
                        fiber_touches[fiber] = touched
                    if wp.static(is_metered):
                        fiber_push[fiber] = pushed
        sweep_block(
            block,
            phase,
            dt,
            stage,
            groups,
            fiber_node_start,
            fiber_group,
            node_hold,
            node_load,
            node_grip,
            contact_load,
            contact_touch,
            fiber_extent,
            fiber_touches,
            node_touches,
            node_push,
            node_couple,
            place,
            node_pos_out,
            node_velocity,
            node_turn,
            node_spin,
            node_rate,
            node_spin_rate,
            still_steps,
            status,
            block_fiber,
            block_own,
            block_start,
            block_axis,
            block_length,
            block_pos,
            block_skin,
            block_turn,
        )

    return native_bond_sweep
