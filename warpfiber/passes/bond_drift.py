"""First half of a step of bonded spheres that meet: half kick, drift, and whether the list lasts.

Source: velocity Verlet. The list holds as long as no node has moved by half of its skin; the move
of one more step is taken off, since pairs are looked at after the drift.
"""

from functools import cache

import warp as wp

from warpfiber.laws.rotation import make_rotation
from warpfiber.model import EXPIRED, HALT, precision
from warpfiber.passes.array_items import make_items
from warpfiber.passes.kernel_module import FUSED


@cache
def make_bond_drift(name: str):
    """Kernel `bond_drift`, one thread per fiber."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    turned = make_rotation(name)
    is_single = name == "float32"
    zero, half = real(0.0), real(0.5)
    point, set_point = make_items(wp.vec3d)
    vector, set_vector = make_items(vec3)
    four, set_four = make_items(vec4)

    @wp.kernel(module="unique", module_options=FUSED, enable_backward=False, grid_stride=False)
    def bond_drift(
        offset: wp.int32,
        dt: real,
        list_sizes: wp.array(dtype=real),
        fiber_node_start: wp.array(dtype=wp.int32),
        list_pos: wp.array(dtype=vec3),
        place: wp.array(dtype=wp.vec3d),
        node_pos_out: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        node_turn: wp.array(dtype=vec4),
        node_spin: wp.array(dtype=vec3),
        node_rate: wp.array(dtype=vec3),
        node_spin_rate: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        kick = half * dt
        furthest = zero
        for i in range(fiber_node_start[fiber], fiber_node_start[fiber + 1]):
            v = vector(node_velocity, i) + kick * vector(node_rate, i)
            w = vector(node_spin, i) + kick * vector(node_spin_rate, i)
            x = point(place, i) + wp.vec3d(dt * v)
            set_vector(node_velocity, i, v)
            set_vector(node_spin, i, w)
            set_four(node_turn, i, turned(four(node_turn, i), w, dt))
            set_point(place, i, x)
            if wp.static(is_single):
                node_pos_out[i] = vec3(x)
            moved = wp.length(vec3(x) - vector(list_pos, i)) + dt * wp.length(v)
            furthest = wp.max(furthest, moved)
        if not (furthest <= half * list_sizes[1]):
            status[wp.static(EXPIRED)] = 1

    return bond_drift
