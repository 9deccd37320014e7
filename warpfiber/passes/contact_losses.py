"""What dashpots and friction of contacts between segments dissipate in a step.

The sweep over pairs leaves a record of every pair that acts; here the speeds of the end of the step
are known. One thread per segment and its outgoing pairs adds to the segment's sums, which so do not
depend on the number of workers.
Source: a force F does the work F . v dt with v the velocity after the second half kick, since nodes
    have v - a dt / 2 before and v + a dt / 2 after it. Friction dissipates what is put in against
    it less what its memories store (`contact_energy`).
Symbols: a record is (n, push of the dashpot), (friction on i, arm of i), (s, t, arm of j, 0).
"""

from functools import cache

import warp as wp

from warpfiber.model import HALT, precision
from warpfiber.passes.array_items import make_items
from warpfiber.passes.contact_energy import NORMAL, TANGENTIAL
from warpfiber.passes.kernel_module import FUSED

RECORD = 3  # vectors of four numbers per pair


@cache
def make_contact_losses(name: str, closed: bool):
    """Kernel `contact_losses`: adds to (S, 2) what was put in against dashpots and friction."""
    p = precision(name)
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    one = real(1.0)
    number, _ = make_items(wp.int32)
    vector, _ = make_items(vec3)
    four, _ = make_items(vec4)
    flag, _ = make_items(wp.uint8)

    @wp.func
    def between(s: real, of: wp.array(dtype=vec3), node: wp.int32, end: wp.int32) -> vec3:
        return (one - s) * vector(of, node) + s * vector(of, end)

    @wp.kernel(module="unique", module_options=FUSED, enable_backward=False, grid_stride=False)
    def contact_losses(
        offset: wp.int32,
        dt: wp.float64,
        segment_node: wp.array(dtype=wp.int32),
        segment_end: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_record: wp.array(dtype=vec4),
        node_velocity: wp.array(dtype=vec3),
        node_spin: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        lost: wp.array2d(dtype=wp.float64),
    ):
        if status[wp.static(HALT)] != 0:
            return
        i = wp.tid() + offset
        normal = wp.float64(0.0)
        tangential = wp.float64(0.0)
        for k in range(number(out_start, i), number(out_start, i + 1)):
            if flag(pair_acts, k) == wp.uint8(0):
                continue
            j = number(pair_j, k)
            node_i = number(segment_node, i)
            node_j = number(segment_node, j)
            end_i = node_i + 1
            end_j = node_j + 1
            if wp.static(closed):
                end_i = number(segment_end, i)
                end_j = number(segment_end, j)
            pushed = four(pair_record, wp.static(RECORD) * k)
            rubbed = four(pair_record, wp.static(RECORD) * k + 1)
            place = four(pair_record, wp.static(RECORD) * k + 2)
            n = vec3(pushed[0], pushed[1], pushed[2])
            drag = vec3(rubbed[0], rubbed[1], rubbed[2])
            slip = between(place[0], node_velocity, node_i, end_i)
            slip -= between(place[1], node_velocity, node_j, end_j)
            spin = rubbed[3] * between(place[0], node_spin, node_i, end_i)
            spin += place[2] * between(place[1], node_spin, node_j, end_j)
            normal += wp.float64(pushed[3] * wp.dot(slip, n))
            tangential -= wp.float64(wp.dot(drag, slip + wp.cross(spin, n)))
        lost[i, wp.static(NORMAL)] = lost[i, wp.static(NORMAL)] + dt * normal
        lost[i, wp.static(TANGENTIAL)] = lost[i, wp.static(TANGENTIAL)] + dt * tangential

    return contact_losses
