"""Device reductions that only read the state: orientation, energies, contacts, force terms.

Every thread sums a fixed run of fibers or segments, the host adds the few partial sums in order:
the result does not depend on the device's scheduling.

Source: a_ij = <p_i p_j> and A_ijkl of segments weighted by their length, and of end-to-end vectors
    with one vote per fiber.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.laws.bending import make_bending
from warpfiber.laws.drag import make_drag
from warpfiber.laws.flow import make_flow
from warpfiber.laws.repulsion import RANGE, make_repulsion
from warpfiber.laws.stretching import make_stretching
from warpfiber.laws.torque import make_torque
from warpfiber.model import precision
from warpfiber.passes.pairs import PairFeatures, make_pair_geometry
from warpfiber.passes.precision import group_struct
from warpfiber.passes.ring_nodes import make_ring_minimum
from warpfiber.passes.tensor_sums import TENSOR, TENSOR4_NAMES, make_tensor_sums

# Columns of the partial sums over fibers.
FIBER_SUMS = (
    "length",
    *TENSOR,
    *(f"{name}_fiber" for name in TENSOR),
    "energy_kinetic",
    "energy_stretching",
    "energy_bending",
    "curvature",
    "energy_wall",
    "bending_strain",
)
FIBER_MAXIMA = ("axial_strain_max", "curvature_max", "bending_strain_max")
# Behind them with orientation4: by length, then one vote per fiber.
FIBER_SUMS4 = (*TENSOR4_NAMES, *(f"{name}_fiber" for name in TENSOR4_NAMES))
PAIR_SUMS = ("touching", "repelling", "lubricating", "overlap", "energy_repulsion")
TERMS = ("stretching", "bending", "hydrodynamic torque", "contact", "drag")


@dataclass(frozen=True)
class MeasureFeatures:
    """Which sums over fibers a scene asks for."""

    orientation4: bool = False
    energy: bool = False
    curvature: bool = False
    walls: tuple[bool, bool, bool] = (False, False, False)  # with energy: potential of the walls
    # without it the mass is 0, and bending energy is that of law `chain_terms`
    inertia: bool = True


@cache
def make_measure_fibers(name: str, features: MeasureFeatures, module: str = "unique"):
    """Kernel: partial sums over fibers, columns FIBER_SUMS (+ FIBER_SUMS4) and FIBER_MAXIMA."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    bending_angle, _ = make_bending(name)
    has_energy, has_curvature = features.energy, features.curvature
    has_inertia = features.inertia
    has_tensor4 = features.orientation4
    add_tensor, add_tensor4 = make_tensor_sums()
    first_tensor4 = len(FIBER_SUMS)
    first_tensor4_fiber = first_tensor4 + len(TENSOR4_NAMES)
    wall_x, wall_y, wall_z = features.walls
    has_walls = features.energy and any(features.walls)
    _, repulsion_energy = make_repulsion(name)
    wall_range = real(RANGE)

    @wp.func
    def wall_energy(y: real, radius: real, strength: real, decay: real) -> wp.float64:
        """Potential of one node at the distance y of a wall (law `wall`)."""
        if y > wall_range * radius:
            return wp.float64(0.0)
        return wp.float64(repulsion_energy(strength, decay, y, radius))

    @wp.func
    def walls_energy(
        x: vec3, radius: real, low: vec3, high: vec3, strength: real, decay: real
    ) -> wp.float64:
        energy = wp.float64(0.0)
        for axis in range(3):
            has_wall = wp.static(wall_x)
            if axis == 1:
                has_wall = wp.static(wall_y)
            if axis == 2:
                has_wall = wp.static(wall_z)
            if has_wall:
                energy += wall_energy(x[axis] - low[axis], radius, strength, decay)
                energy += wall_energy(high[axis] - x[axis], radius, strength, decay)
        return energy

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def measure_fibers(
        chunks: wp.int32,
        fibers: wp.int32,
        wall_low: vec3,
        wall_high: vec3,
        strength: real,
        decay: real,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        sums_out: wp.array2d(dtype=wp.float64),
        maxima_out: wp.array2d(dtype=wp.float64),
    ):
        chunk = wp.tid()
        half = wp.float64(0.5)
        begin = wp.int32(wp.int64(fibers) * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(wp.int64(fibers) * wp.int64(chunk + 1) / wp.int64(chunks))
        for fiber in range(begin, end):
            g = groups[fiber_group[fiber]]
            first = fiber_node_start[fiber]
            rest = wp.float64(g.rest)
            axis = wp.normalize(wp.vec3d(node_pos[first + g.segments] - node_pos[first]))
            add_tensor(chunk, 7, axis, wp.float64(1.0), sums_out)
            if wp.static(has_tensor4):
                add_tensor4(chunk, wp.static(first_tensor4_fiber), axis, wp.float64(1.0), sums_out)
            if wp.static(has_walls):
                for i in range(first, first + g.segments + 1):
                    sums_out[chunk, 17] = sums_out[chunk, 17] + walls_energy(
                        node_pos[i], g.radius, wall_low, wall_high, strength, decay
                    )
            n0 = vec3(real(0.0), real(0.0), real(0.0))
            edge0 = axis
            for k in range(g.segments):
                edge = wp.vec3d(node_pos[first + k + 1] - node_pos[first + k])
                d = wp.length(edge)
                n = edge / d
                sums_out[chunk, 0] = sums_out[chunk, 0] + d
                add_tensor(chunk, 1, n, d, sums_out)
                if wp.static(has_tensor4):
                    add_tensor4(chunk, wp.static(first_tensor4), n, d, sums_out)
                strain = d / rest - wp.float64(1.0)
                maxima_out[chunk, 0] = wp.max(maxima_out[chunk, 0], wp.abs(strain))
                if wp.static(has_energy):
                    # kinetic energy of the unreduced fiber, m v^T A v / 2: a segment's inner beads
                    # move with the linear interpolation of its nodes
                    m = wp.float64(g.spacing)
                    v0 = wp.vec3d(node_velocity[first + k])
                    v1 = wp.vec3d(node_velocity[first + k + 1])
                    own = (m - wp.float64(1.0)) * (wp.float64(2.0) * m - wp.float64(1.0))
                    own = own / (wp.float64(6.0) * m)
                    cross = (m * m - wp.float64(1.0)) / (wp.float64(6.0) * m)
                    inner = own * (wp.dot(v0, v0) + wp.dot(v1, v1))
                    inner += wp.float64(2.0) * cross * wp.dot(v0, v1)
                    beads = inner + wp.dot(v1, v1)
                    if k == 0:
                        beads += wp.dot(v0, v0)
                    sums_out[chunk, 13] = sums_out[chunk, 13] + half * wp.float64(g.mass) * beads
                    pulled = strain * rest
                    if g.compliance > real(0.0):
                        sums_out[chunk, 14] = (
                            sums_out[chunk, 14] + half * wp.float64(g.stretching) * pulled * pulled
                        )
                if wp.static(has_energy or has_curvature):
                    n1 = vec3(n)
                    if k > 0:
                        angle = wp.float64(bending_angle(n0, n1))
                        bent = angle * angle
                        if wp.static(not has_inertia):
                            bent = wp.length_sq(edge - edge0) / (rest * rest)
                        sums_out[chunk, 15] = (
                            sums_out[chunk, 15] + half * wp.float64(g.bending) * bent
                        )
                        curvature = angle / rest
                        surface = wp.float64(g.radius) * curvature
                        sums_out[chunk, 16] = sums_out[chunk, 16] + curvature * rest
                        sums_out[chunk, 18] = sums_out[chunk, 18] + surface * rest
                        maxima_out[chunk, 1] = wp.max(maxima_out[chunk, 1], curvature)
                        maxima_out[chunk, 2] = wp.max(maxima_out[chunk, 2], surface)
                    n0 = n1
                edge0 = edge

    return measure_fibers


@cache
def make_measure_pairs(name: str, features: PairFeatures, module: str = "unique"):
    """Kernel: partial sums over listed pairs (PAIR_SUMS), largest overlap, which pairs touch."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    closest_fractions, image_shift, is_local_minimum, lubricate = make_pair_geometry(name, features)
    is_ring_minimum, closed = make_ring_minimum(name), features.closed
    _, repulsion_energy = make_repulsion(name)
    reach = real(RANGE)
    has_repulsion = features.repulsion
    has_lubrication = features.lubrication != "none"

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def measure_pairs(
        chunks: wp.int32,
        segments: wp.int32,
        strength: real,
        decay: real,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_end: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_ring: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=wp.mat33d),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        pair_touches_out: wp.array(dtype=wp.int32),
        sums_out: wp.array2d(dtype=wp.float64),
        maxima_out: wp.array2d(dtype=wp.float64),
    ):
        chunk = wp.tid()
        begin = wp.int32(wp.int64(segments) * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(wp.int64(segments) * wp.int64(chunk + 1) / wp.int64(chunks))
        box = mat33(lattice[0])
        still = vec3(real(0.0), real(0.0), real(0.0))
        one = wp.float64(1.0)
        for i in range(begin, end):
            node_i = segment_node[i]
            fiber_i = segment_fiber[i]
            gi = groups[fiber_group[fiber_i]]
            at_i = node_i - fiber_node_start[fiber_i]
            xi = node_pos[node_i]
            end_i = node_i + 1
            if wp.static(closed):
                end_i = segment_end[i]
            a = node_pos[end_i] - xi
            for k in range(out_start[i], out_start[i + 1]):
                j = pair_j[k]
                node_j = segment_node[j]
                fiber_j = segment_fiber[j]
                gj = groups[fiber_group[fiber_j]]
                at_j = node_j - fiber_node_start[fiber_j]
                end_j = node_j + 1
                if wp.static(closed):
                    end_j = segment_end[j]
                b = node_pos[end_j] - node_pos[node_j]
                delta = node_pos[node_j] - xi + image_shift(pair_image[k], box)
                st = closest_fractions(delta, a, b)
                c = delta + st[1] * b - st[0] * a
                distance = wp.length(c)
                contact = gi.radius + gj.radius
                touches = wp.int32(0)
                if distance <= reach * contact:
                    overlap = wp.float64(wp.max(contact - distance, real(0.0)))
                    overlap = overlap / (wp.float64(contact) * wp.float64(0.5))
                    maxima_out[chunk, 0] = wp.max(maxima_out[chunk, 0], overlap)
                    is_minimum = wp.bool(False)
                    if wp.static(closed):
                        is_minimum = is_ring_minimum(
                            st,
                            c,
                            node_i,
                            at_i,
                            gi.segments,
                            fiber_ring[fiber_i],
                            node_j,
                            at_j,
                            gj.segments,
                            fiber_ring[fiber_j],
                            node_pos,
                        )
                    else:
                        is_minimum = is_local_minimum(
                            st, c, node_i, at_i, gi.segments, node_j, at_j, gj.segments, node_pos
                        )
                    if is_minimum:
                        if distance <= contact:
                            touches = 1
                            sums_out[chunk, 0] = sums_out[chunk, 0] + one
                            sums_out[chunk, 3] = sums_out[chunk, 3] + overlap
                        if wp.static(has_repulsion):
                            sums_out[chunk, 1] = sums_out[chunk, 1] + one
                            sums_out[chunk, 4] = sums_out[chunk, 4] + wp.float64(
                                repulsion_energy(strength, decay, distance, contact)
                            )
                if wp.static(has_lubrication):
                    force, arm_i, arm_j, active = lubricate(
                        gi, gj, at_i, at_j, delta, a, b, still, still, still, still, real(0.0)
                    )
                    if active > 0:
                        sums_out[chunk, 2] = sums_out[chunk, 2] + one
                pair_touches_out[k] = touches

    return measure_pairs


@cache
def make_measure_terms(name: str, pairs: str):
    """Kernel (one thread): the largest force of every term on one fiber, columns TERMS."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    flow_velocity, flow_spin = make_flow(name)
    drag_force, _ = make_drag(name)
    torque_couple = make_torque(name)
    stretching_force = make_stretching(name)
    _, bending_forces = make_bending(name)
    has_pairs = pairs != "none"

    @wp.func
    def keep_largest(column: wp.int32, force: vec3, out: wp.array(dtype=wp.float64)):
        size = wp.float64(wp.length(force))
        if not (size <= out[column]):
            out[column] = size

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def measure_terms(
        fiber: wp.int32,
        flow_origin: vec3,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_segment_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_acts: wp.array(dtype=wp.uint8),
        pair_force: wp.array(dtype=vec3),
        terms_out: wp.array(dtype=wp.float64),
    ):
        g = groups[fiber_group[fiber]]
        first = fiber_node_start[fiber]
        spin = flow_spin(gradient[0])
        n0 = vec3(real(0.0), real(0.0), real(0.0))
        inverse0 = real(1.0)
        for k in range(g.segments + 1):
            i = first + k
            x = node_pos[i]
            v = node_velocity[i]
            u = flow_velocity(gradient[0], flow_origin, x)
            keep_largest(4, drag_force(g.drag, u, v), terms_out)
            if k < g.segments:
                edge = node_pos[i + 1] - x
                d1 = wp.length(edge)
                inverse1 = real(1.0) / d1
                n1 = inverse1 * edge
                keep_largest(0, stretching_force(g.stretching, d1, g.rest, n1), terms_out)
                if k > 0:
                    before, after = bending_forces(g.bending, n0, inverse0, n1, inverse1)
                    keep_largest(1, before + after, terms_out)
                dv = node_velocity[i + 1] - v
                couple = torque_couple(g.torque * g.weight, n1, inverse1, dv, spin)
                keep_largest(2, couple, terms_out)
                if wp.static(has_pairs):
                    segment = fiber_segment_start[fiber] + k
                    for pair in range(out_start[segment], out_start[segment + 1]):
                        if pair_acts[pair] != wp.uint8(0):
                            keep_largest(3, pair_force[pair], terms_out)
                    for slot in range(in_start[segment], in_start[segment + 1]):
                        pair = in_pair[slot]
                        if pair_acts[pair] != wp.uint8(0):
                            keep_largest(3, pair_force[pair], terms_out)
                n0 = n1
                inverse0 = inverse1

    return measure_terms
