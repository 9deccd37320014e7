"""The pair sweep of bonded spheres on the CPU: distances and contacts of eight pairs at a time.

A pair is a lane, and nothing in a lane depends on the others. Near pairs are in PARTS; each adds
the loads of its contacts to a line of numbers per node of its own, which the sweep over bonds adds
up in turn, so a sum does not depend on the number of workers. What a pair does is stored by pair
only if asked for : most of the time would go into that.

Limits: CPU only (clang vector types), else `capsule_pairs`; multiplications and additions are
    fused and powers are by series: equal to rounding.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.native_capsules_source import capsule_sweep_source

# Arguments of the sweep that are arrays.
ARRAYS = """
    groups fiber_group segment_fiber lattice out_start part_start near_count near_pair near_i near_j
    near_image pair_i pair_j pair_image place node_velocity node_spin step pair_acts
    pair_force pair_arms pair_record pair_memory pair_step contact_load contact_touch status
""".split()


@cache
def make_native_capsule_pairs(name: str, features: CapsuleFeatures):
    """Kernel `native_capsule_pairs` over the PARTS of the near pairs."""
    p = precision(name)
    real, vec3, vec4, mat33 = p.real, p.vec3, p.vec4, p.mat33
    BondGroup = bond_group_struct(name)

    @wp.func_native(capsule_sweep_source(name, features, ARRAYS))
    def sweep_part(
        part: wp.int32,
        keeps: wp.int32,
        dt: real,
        beta: real,
        friction: real,
        largest_reach: real,
        groups: wp.array(dtype=BondGroup),
        fiber_group: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        out_start: wp.array(dtype=wp.int32),
        part_start: wp.array(dtype=wp.int32),
        near_count: wp.array(dtype=wp.int32),
        near_pair: wp.array(dtype=wp.int32),
        near_i: wp.array(dtype=wp.int32),
        near_j: wp.array(dtype=wp.int32),
        near_image: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
        step: wp.array(dtype=wp.int64),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        pair_arms: wp.array(dtype=vec4),
        pair_record: wp.array(dtype=vec4),
        pair_memory: wp.array2d(dtype=vec4),
        pair_step: wp.array2d(dtype=wp.int32),
        contact_load: wp.array(dtype=real),
        contact_touch: wp.array(dtype=wp.uint8),
        status: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def native_capsule_pairs(
        offset: wp.int32,
        keeps: wp.int32,
        dt: real,
        beta: real,
        friction: real,
        largest_reach: real,
        groups: wp.array(dtype=BondGroup),
        fiber_group: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        out_start: wp.array(dtype=wp.int32),
        part_start: wp.array(dtype=wp.int32),
        near_count: wp.array(dtype=wp.int32),
        near_pair: wp.array(dtype=wp.int32),
        near_i: wp.array(dtype=wp.int32),
        near_j: wp.array(dtype=wp.int32),
        near_image: wp.array(dtype=wp.int32),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        place: wp.array(dtype=wp.vec3d),
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
        step: wp.array(dtype=wp.int64),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force_out: wp.array(dtype=vec3),
        pair_arms_out: wp.array(dtype=vec4),
        pair_record_out: wp.array(dtype=vec4),
        pair_memory: wp.array2d(dtype=vec4),
        pair_step: wp.array2d(dtype=wp.int32),
        contact_load: wp.array(dtype=real),
        contact_touch: wp.array(dtype=wp.uint8),
        status: wp.array(dtype=wp.int32),
    ):
        sweep_part(
            wp.tid() + offset,
            keeps,
            dt,
            beta,
            friction,
            largest_reach,
            groups,
            fiber_group,
            segment_fiber,
            lattice,
            out_start,
            part_start,
            near_count,
            near_pair,
            near_i,
            near_j,
            near_image,
            pair_i,
            pair_j,
            pair_image,
            place,
            node_velocity,
            node_spin,
            step,
            pair_acts,
            pair_force_out,
            pair_arms_out,
            pair_record_out,
            pair_memory,
            pair_step,
            contact_load,
            contact_touch,
            status,
        )

    return native_capsule_pairs
