"""First moments of the forces on fibers without inertia: of the drag, and of contact.

    drag:     sum over beads of (r - x_c) F_h,  F_h = 6 pi eta a (u - v) on a bead
    contact:  (x_c,j - x_c,i) F of every pair, F = -f n - F_t on i: arms of both fibers and the
              line from one center line to the other; a wall takes part with the point that is
              touched
Both are made symmetric: torques of the fluid on beads add to the antisymmetric part alone, which
balances that of the drag. Beads between nodes move and lie on a line, so their sum is that over the
nodes with the Galerkin matrix: sum x_i F_i, F = zeta A (u - v).
Every thread sums a fixed run of fibers or rows, the host adds the few partial sums in order.

Source: Batchelor 1970 for the stress of force-free particles, Brady & Bossis 1988 for what forces
    between them add, with the model's own drag of free-draining beads.
Symbols: r place of a bead, x_c middle of a fiber by beads, f force of a row, n from i to j, F_t
    force of friction on j; the couples of either on a fiber add to the antisymmetric part alone.
Limits: moments are about the middle of a fiber, which matters where a force from outside (gravity,
    a hold) acts on it. A bead's own stresslet, (20/3) pi eta a^3 times the rate of strain, is left
    out: the drag of the model has none.
"""

from functools import cache

import warp as wp

from warpfiber.laws.chain_terms import make_chain_terms
from warpfiber.model import precision
from warpfiber.passes.precision import group_struct

STRESS = ("11", "22", "33", "12", "13", "23")
WALL = -1  # partner of a row with a plane wall


@cache
def make_measure_stress(name: str, has_friction: bool = False):
    """Kernels `drag_moments` over runs of fibers and `contact_moments` over runs of rows."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    drag_diagonal, _, _ = make_chain_terms(name)
    half = wp.float64(0.5)
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

    @wp.func
    def add_moment(
        row: wp.int32, arm: wp.vec3d, force: wp.vec3d, out: wp.array2d(dtype=wp.float64)
    ):
        out[row, 0] = out[row, 0] + arm[0] * force[0]
        out[row, 1] = out[row, 1] + arm[1] * force[1]
        out[row, 2] = out[row, 2] + arm[2] * force[2]
        out[row, 3] = out[row, 3] + half * (arm[0] * force[1] + arm[1] * force[0])
        out[row, 4] = out[row, 4] + half * (arm[0] * force[2] + arm[2] * force[0])
        out[row, 5] = out[row, 5] + half * (arm[1] * force[2] + arm[2] * force[1])

    @wp.kernel(**options)
    def drag_moments(
        chunks: wp.int32,
        fibers: wp.int32,
        flow_origin: vec3,
        gradient: wp.array(dtype=mat33),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        center_out: wp.array(dtype=wp.vec3d),
        sums_out: wp.array2d(dtype=wp.float64),
    ):
        chunk = wp.tid()
        begin = wp.int32(wp.int64(fibers) * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(wp.int64(fibers) * wp.int64(chunk + 1) / wp.int64(chunks))
        full = wp.mat33d(gradient[0])
        origin = wp.vec3d(flow_origin)
        for fiber in range(begin, end):
            g = groups[fiber_group[fiber]]
            first = fiber_node_start[fiber]
            beside = wp.float64(g.coupling)
            center = wp.vec3d()
            beads = wp.float64(0.0)
            for k in range(g.segments + 1):
                share = wp.float64(drag_diagonal(g.spacing, k, g.segments)) + beside
                if k > 0 and k < g.segments:
                    share += beside
                center += share * wp.vec3d(node_pos[first + k])
                beads += share
            center = center / beads
            center_out[fiber] = center
            if fiber_frozen[fiber] != wp.uint8(0):
                continue
            x = wp.vec3d(node_pos[first])
            slip = full * (x - origin) - wp.vec3d(node_velocity[first])
            before = wp.vec3d()
            for k in range(g.segments + 1):
                force = wp.float64(drag_diagonal(g.spacing, k, g.segments)) * slip + beside * before
                arm = x - center
                before = slip
                if k < g.segments:
                    x = wp.vec3d(node_pos[first + k + 1])
                    slip = full * (x - origin) - wp.vec3d(node_velocity[first + k + 1])
                    force += beside * slip
                add_moment(chunk, arm, wp.float64(g.drag) * force, sums_out)

    @wp.kernel(**options)
    def contact_moments(
        chunks: wp.int32,
        row_count: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        row_friction: wp.array(dtype=vec3),
        lattice: wp.array(dtype=wp.mat33d),
        periodic: wp.vec3d,
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        center: wp.array(dtype=wp.vec3d),
        sums_out: wp.array2d(dtype=wp.float64),
    ):
        chunk = wp.tid()
        rows = wp.int64(row_count[0])
        begin = wp.int32(rows * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(rows * wp.int64(chunk + 1) / wp.int64(chunks))
        box = lattice[0]
        back = wp.inverse(box)
        for r in range(begin, end):
            if row_force[r] == real(0.0):
                continue
            force = -wp.float64(row_force[r]) * wp.vec3d(row_normal[r])  # on i
            if wp.static(has_friction):
                if row_friction.shape[0] > 0:  # only the first of two linearizations has any
                    force -= wp.vec3d(row_friction[r])
            node = segment_node[row_i[r]]
            fiber = segment_fiber[row_i[r]]
            s = wp.float64(row_s[r])
            x = wp.vec3d(node_pos[node])
            x = x + s * (wp.vec3d(node_pos[node + 1]) - x)
            arm = x - center[fiber]
            if fiber_frozen[fiber] == wp.uint8(0):
                add_moment(chunk, arm, force, sums_out)
            j = row_j[r]
            if j == wp.static(WALL):
                touched = wp.float64(groups[fiber_group[fiber]].radius)
                add_moment(chunk, touched * wp.vec3d(row_normal[r]), force, sums_out)
                continue
            other_node = segment_node[j]
            other = segment_fiber[j]
            t = wp.float64(row_t[r])
            y = wp.vec3d(node_pos[other_node])
            y = y + t * (wp.vec3d(node_pos[other_node + 1]) - y)
            if fiber_frozen[other] == wp.uint8(0):
                add_moment(chunk, y - center[other], -force, sums_out)
            # of all images the one that is met: far less than half a box away
            across = y - x
            image = back * across
            for axis in range(3):
                image[axis] = periodic[axis] * wp.round(image[axis])
            add_moment(chunk, across - box * image, force, sums_out)

    return drag_moments, contact_moments
