"""The node sweep of `nodes` for the CPU: one block of fibers of one group at a time, SIMD.

A lane is a fiber. The block's positions and velocities are transposed from the state arrays into a
scratch of vectors on the stack, the two walks of `nodes` run on all lanes at once, and the fibers
that are not torn are transposed back. Nothing in a lane depends on the other lanes, so it does not
matter which fibers share a block. The work array `node_force` is not written.

Limits: closures `none` and `consistent`; fibers of up to MOST_NODES nodes (stack); sums are in
    another order than in `nodes` and multiplications and additions are fused: equal to rounding.
"""

from functools import cache

import numpy as np
import warp as wp

from warpfiber.model import Model, precision
from warpfiber.passes.native import LANES
from warpfiber.passes.native_nodes_source import node_sweep_source
from warpfiber.passes.nodes import NodeFeatures
from warpfiber.passes.precision import group_struct

MOST_NODES = 512
# A block costs about as much as this many fibers of the plain sweep.
FIBERS_PER_BLOCK = 3
# Arguments of the sweep that are arrays.
ARRAYS = """
    list_sizes groups pivots fiber_node_start fiber_group gradient deformation out_start in_start
    in_pair pair_acts pair_force pair_closest pair_arm_i pair_arm_j list_pos node_pos node_velocity
    status pair_i pair_j block_fiber block_own
""".split()


def fiber_blocks(fiber_group: np.ndarray, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Fibers (B, lanes) of every block, all of one group, and how many of them (B,) are its own.

    The last fiber of a group fills the lanes that are left over.
    """
    rows, counts = [], []
    for group in np.unique(fiber_group):
        mine = np.flatnonzero(fiber_group == group)
        for begin in range(0, len(mine), lanes):
            part = mine[begin : begin + lanes]
            rows.append(np.concatenate([part, np.full(lanes - len(part), mine[-1])]))
            counts.append(len(part))
    return np.asarray(rows, dtype=np.int32), np.asarray(counts, dtype=np.int32)


def native_nodes_apply(model: Model, features: NodeFeatures) -> bool:
    """Whether the native sweep can do this model and is the faster one."""
    if not model.device.startswith("cpu") or features.closure == "paper":
        return False
    if max(row["segments"] for row in model.group_rows) >= MOST_NODES:
        return False
    counts = np.bincount(model.host["fiber_group"])
    blocks = int(np.ceil(counts / LANES[model.precision.name]).sum())
    return model.fiber_count >= FIBERS_PER_BLOCK * blocks


@cache
def make_native_node_sweep(name: str, features: NodeFeatures, module: str = "unique"):
    """Kernel `native_node_sweep` over blocks of fibers.

    From `fetch_from` nodes on, what the next block needs is asked for.
    """
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    snippet = node_sweep_source(name, features, ARRAYS)

    @wp.func_native(snippet)
    def sweep_block(
        block: wp.int32,
        fetch_from: wp.int32,
        dt: real,
        flow_origin: vec3,
        wall_low: vec3,
        wall_high: vec3,
        strength: real,
        decay: real,
        list_sizes: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        pivots: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_closest: wp.array(dtype=vec2),
        pair_arm_i: wp.array(dtype=vec3),
        pair_arm_j: wp.array(dtype=vec3),
        list_pos: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        block_fiber: wp.array(dtype=wp.int32),
        block_own: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def native_node_sweep(
        offset: wp.int32,
        fetch_from: wp.int32,
        dt: real,
        flow_origin: vec3,
        wall_low: vec3,
        wall_high: vec3,
        strength: real,
        decay: real,
        list_sizes: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        pivots: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_closest: wp.array(dtype=vec2),
        pair_arm_i: wp.array(dtype=vec3),
        pair_arm_j: wp.array(dtype=vec3),
        list_pos: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_force_out: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        block_fiber: wp.array(dtype=wp.int32),
        block_own: wp.array(dtype=wp.int32),
    ):
        sweep_block(
            wp.tid() + offset,
            fetch_from,
            dt,
            flow_origin,
            wall_low,
            wall_high,
            strength,
            decay,
            list_sizes,
            groups,
            pivots,
            fiber_node_start,
            fiber_group,
            gradient,
            deformation,
            out_start,
            in_start,
            in_pair,
            pair_acts,
            pair_force,
            pair_closest,
            pair_arm_i,
            pair_arm_j,
            list_pos,
            node_pos,
            node_velocity,
            status,
            pair_i,
            pair_j,
            block_fiber,
            block_own,
        )

    return native_node_sweep
