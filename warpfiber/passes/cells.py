"""Kernels of one neighbor-list build, from wrapped fibers to sorted pairs (see `neighbors`).

Segments are sorted by cell and each is tested against half of its 27 neighbor cells. Every pair
keeps the lattice vector that connects it; the half stencil therefore also holds for boxes of one or
two cells, where two images of one pair can both be near.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.laws.segment_distance import make_segment_distance
from warpfiber.model import (
    EXPIRED,
    OVERFLOW,
    OVERFLOW_PAIRS,
    OVERFLOW_ROW,
    PAIR_COUNT,
    ROW_NEED,
    precision,
)
from warpfiber.passes.pairs import make_image
from warpfiber.passes.precision import group_struct

MAX_CELLS_PER_SEGMENT = 4
# Cells are this much wider than the reach, so that rounding cannot move a neighbor two cells away.
CELL_MARGIN = 1.0 + 1e-6


@dataclass(frozen=True)
class ListFeatures:
    """Which axes wrap, and whether the lattice is reset when the shear passes half a box."""

    periodic: tuple[bool, bool, bool]
    shear_axes: tuple[int, int] | None = None
    sheared: bool = False


@cache
def make_list_kernels(name: str, features: ListFeatures):
    """The kernels of one build, in launch order, as a dict by name."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    closest_fractions = make_segment_distance(name)
    pack_image, _ = make_image(name)
    px, py, pz = features.periodic
    flow_axis, gradient_axis = features.shear_axes or (0, 0)
    i_flow, i_gradient = wp.constant(flow_axis), wp.constant(gradient_axis)
    resets = features.shear_axes is not None
    sheared = features.sheared
    half = real(0.5)
    margin = wp.float64(CELL_MARGIN)
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

    @wp.func
    def wrap_count(x: wp.vec3d) -> wp.vec3i:
        """Whole boxes along the periodic axes."""
        nx, ny, nz = wp.int32(0), wp.int32(0), wp.int32(0)
        if wp.static(px):
            nx = wp.int32(wp.floor(x[0]))
        if wp.static(py):
            ny = wp.int32(wp.floor(x[1]))
        if wp.static(pz):
            nz = wp.int32(wp.floor(x[2]))
        return wp.vec3i(nx, ny, nz)

    @wp.func
    def lattice_vector(lattice: wp.mat33d, n: wp.vec3i) -> wp.vec3d:
        return lattice * wp.vec3d(wp.float64(n[0]), wp.float64(n[1]), wp.float64(n[2]))

    @wp.func
    def excess_turns(h: wp.mat33d) -> wp.float64:
        """Whole boxes of shear: a lattice sheared by them is the same with a shorter vector."""
        return wp.rint(h[i_flow, i_gradient] / h[i_flow, i_flow])

    @wp.kernel(**options)
    def wrap_fibers(
        lattice: wp.array(dtype=wp.mat33d),
        gradient: wp.array(dtype=mat33),
        fiber_node_start: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        fiber_image: wp.array(dtype=wp.vec3i),
    ):
        fiber = wp.tid()
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        h = lattice[0]
        if wp.static(resets):
            turns = excess_turns(h)
            if turns != wp.float64(0.0):
                image = fiber_image[fiber]
                image[i_flow] = image[i_flow] + wp.int32(turns) * image[i_gradient]
                fiber_image[fiber] = image
                h[i_flow, i_gradient] = h[i_flow, i_gradient] - turns * h[i_flow, i_flow]
        center = wp.vec3d(node_pos[first] + node_pos[last]) * wp.float64(0.5)
        n = wrap_count(wp.inverse(h) * center)
        if n[0] != 0 or n[1] != 0 or n[2] != 0:
            fiber_image[fiber] = fiber_image[fiber] + n
            shift = vec3(lattice_vector(h, n))
            for i in range(first, last + 1):
                node_pos[i] = node_pos[i] - shift
                if wp.static(sheared):
                    node_velocity[i] = node_velocity[i] - gradient[0] * shift

    @wp.kernel(**options)
    def start_list(
        reach: wp.float64,
        cell_capacity: wp.int32,
        lattice: wp.array(dtype=wp.mat33d),
        list_lattice: wp.array(dtype=wp.mat33d),
        deformation: wp.array(dtype=wp.mat33d),
        cells: wp.array(dtype=wp.vec3i),
        status: wp.array(dtype=wp.int32),
    ):
        h = lattice[0]
        if wp.static(resets):
            turns = excess_turns(h)
            h[i_flow, i_gradient] = h[i_flow, i_gradient] - turns * h[i_flow, i_flow]
            lattice[0] = h
        list_lattice[0] = h
        deformation[0] = wp.identity(n=3, dtype=wp.float64)
        inverse = wp.inverse(h)
        # rows of the inverse have the inverse heights of the cell as lengths
        d = wp.vec3i(1, 1, 1)
        for axis in range(3):
            height = wp.float64(1.0) / wp.length(inverse[axis])
            count = wp.floor(height / (reach * margin))
            d[axis] = wp.int32(wp.clamp(count, wp.float64(1.0), wp.float64(1000.0)))
        while d[0] * d[1] * d[2] > cell_capacity:
            for axis in range(3):
                d[axis] = wp.max((d[axis] * 7) / 8, 1)
        cells[0] = d
        status[wp.static(EXPIRED)] = 0
        status[wp.static(OVERFLOW)] = 0
        status[wp.static(ROW_NEED)] = 0

    @wp.kernel(**options)
    def bin_segments(
        low: wp.vec3d,
        lattice: wp.array(dtype=wp.mat33d),
        cells: wp.array(dtype=wp.vec3i),
        segment_node: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        segment_wrap_out: wp.array(dtype=wp.vec3i),
        key_out: wp.array(dtype=wp.int32),
        index_out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        node = segment_node[i]
        middle = wp.vec3d(node_pos[node] + node_pos[node + 1]) * wp.float64(0.5)
        x = wp.inverse(lattice[0]) * (middle - low)
        n = wrap_count(x)
        segment_wrap_out[i] = n
        d = cells[0]
        c = wp.vec3i(0, 0, 0)
        for axis in range(3):
            along = (x[axis] - wp.float64(n[axis])) * wp.float64(d[axis])
            c[axis] = wp.clamp(wp.int32(wp.floor(along)), 0, d[axis] - 1)
        key_out[i] = (c[2] * d[1] + c[1]) * d[0] + c[0]
        index_out[i] = i

    @wp.kernel(**options)
    def mark_starts(
        count: wp.array(dtype=wp.int32),
        count_slot: wp.int32,
        bins: wp.int32,
        key: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
    ):
        """start[b] = first place with key >= b, for sorted keys; start[bins] = count."""
        i = wp.tid()
        n = count[count_slot]
        if i > n:
            return
        below = wp.int32(-1)
        if i > 0:
            below = key[i - 1]
        here = bins
        if i < n:
            here = key[i]
        for b in range(below + 1, here + 1):
            start_out[b] = i

    @wp.kernel(**options)
    def sort_geometry(
        lattice: wp.array(dtype=wp.mat33d),
        order: wp.array(dtype=wp.int32),
        segment_wrap: wp.array(dtype=wp.vec3i),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        sorted_pos_out: wp.array(dtype=vec3),
        sorted_axis_out: wp.array(dtype=vec3),
        sorted_fiber_out: wp.array(dtype=wp.int32),
    ):
        k = wp.tid()
        i = order[k]
        node = segment_node[i]
        x = node_pos[node]
        sorted_axis_out[k] = node_pos[node + 1] - x
        sorted_pos_out[k] = x - vec3(lattice_vector(lattice[0], segment_wrap[i]))
        sorted_fiber_out[k] = segment_fiber[i]

    @wp.kernel(**options)
    def find_pairs(
        reach: real,
        row_capacity: wp.int32,
        lattice: wp.array(dtype=wp.mat33d),
        cells: wp.array(dtype=wp.vec3i),
        cell_start: wp.array(dtype=wp.int32),
        cell_of: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        segment_wrap: wp.array(dtype=wp.vec3i),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        sorted_pos: wp.array(dtype=vec3),
        sorted_axis: wp.array(dtype=vec3),
        sorted_fiber: wp.array(dtype=wp.int32),
        row_count_out: wp.array(dtype=wp.int32),
        row_i_out: wp.array(dtype=wp.int32),
        row_j_out: wp.array(dtype=wp.int32),
        row_image_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        k = wp.tid()
        h = lattice[0]
        d = cells[0]
        own = cell_of[k]
        cx = own % d[0]
        cy = (own / d[0]) % d[1]
        cz = own / (d[0] * d[1])
        x = sorted_pos[k]
        a = sorted_axis[k]
        half_a = half * wp.length(a)
        fiber = sorted_fiber[k]
        i = order[k]
        wrap_i = segment_wrap[i]
        g = groups[fiber_group[fiber]]
        # segments of one fiber nearer than pi a along it are never a pair
        skip = wp.int32(wp.ceil(real(3.14159265358979) * g.radius / g.rest))
        count = wp.int32(0)
        stencil = wp.int32(
            14
        )  # a variable, or the loop would be unrolled and take seconds to compile
        for cell in range(stencil):
            # 13 is the own cell; 14 ... 26 the forward half of the 27 neighbors
            dx = (cell + 13) % 3 - 1
            dy = ((cell + 13) / 3) % 3 - 1
            dz = (cell + 13) / 9 - 1
            ex, ey, ez = cx + dx, cy + dy, cz + dz
            nx, ny, nz = wp.int32(0), wp.int32(0), wp.int32(0)
            if ex < 0 or ex >= d[0]:
                if wp.static(not px):
                    continue
                nx = dx
                ex -= dx * d[0]
            if ey < 0 or ey >= d[1]:
                if wp.static(not py):
                    continue
                ny = dy
                ey -= dy * d[1]
            if ez < 0 or ez >= d[2]:
                if wp.static(not pz):
                    continue
                nz = dz
                ez -= dz * d[2]
            n = wp.vec3i(nx, ny, nz)
            shift = vec3(lattice_vector(h, n))
            other = (ez * d[1] + ey) * d[0] + ex
            begin = cell_start[other]
            if cell == 0:
                begin = k + 1
            for m in range(begin, cell_start[other + 1]):
                b = sorted_axis[m]
                delta = sorted_pos[m] + shift - x
                across = delta + half * (b - a)
                far = half_a + half * wp.length(b) + reach
                if wp.length_sq(across) > far * far:
                    continue
                st = closest_fractions(delta, a, b)
                c = delta + st[1] * b - st[0] * a
                if wp.length_sq(c) > reach * reach:
                    continue
                j = order[m]
                image = n - segment_wrap[j] + wrap_i
                if sorted_fiber[m] == fiber and image[0] == 0 and image[1] == 0 and image[2] == 0:
                    if wp.abs(i - j) - 1 < skip:
                        continue
                if count < row_capacity:
                    slot = k * row_capacity + count
                    if i <= j:
                        row_i_out[slot] = i
                        row_j_out[slot] = j
                        row_image_out[slot] = pack_image(image[0], image[1], image[2])
                    else:
                        row_i_out[slot] = j
                        row_j_out[slot] = i
                        row_image_out[slot] = pack_image(-image[0], -image[1], -image[2])
                count += 1
        row_count_out[k] = count
        if count > row_capacity:
            # racing stores: any of the values tells the host to grow, and it grows until none is
            # left
            status[wp.static(OVERFLOW)] = wp.static(OVERFLOW_ROW)
            status[wp.static(ROW_NEED)] = count

    @wp.kernel(**options)
    def check_capacity(
        segments: wp.int32,
        pair_capacity: wp.int32,
        row_end: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        total = row_end[segments - 1]
        status[wp.static(PAIR_COUNT)] = total
        if total > pair_capacity and status[wp.static(OVERFLOW)] == 0:
            status[wp.static(OVERFLOW)] = wp.static(OVERFLOW_PAIRS)

    @wp.kernel(**options)
    def compact_rows(
        row_capacity: wp.int32,
        row_count: wp.array(dtype=wp.int32),
        row_end: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        slot_out: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(OVERFLOW)] != 0:
            return
        k = wp.tid()
        count = row_count[k]
        for m in range(count):
            slot_out[row_end[k] - count + m] = k * row_capacity + m

    @wp.kernel(**options)
    def fetch_keys(
        bins: wp.int32,
        source: wp.array(dtype=wp.int32),
        slot: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        key_out: wp.array(dtype=wp.int32),
    ):
        """Key of every place from its slot; places beyond the last pair sort to the end."""
        place = wp.tid()
        if status[wp.static(OVERFLOW)] == 0 and place < status[wp.static(PAIR_COUNT)]:
            key_out[place] = source[slot[place]]
        else:
            key_out[place] = bins

    @wp.kernel(**options)
    def fetch_pairs(
        slot: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_image: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        bins: wp.int32,
        pair_i_out: wp.array(dtype=wp.int32),
        pair_j_out: wp.array(dtype=wp.int32),
        pair_image_out: wp.array(dtype=wp.int32),
        key_out: wp.array(dtype=wp.int32),
        place_out: wp.array(dtype=wp.int32),
    ):
        place = wp.tid()
        key_out[place] = bins
        place_out[place] = place
        if status[wp.static(OVERFLOW)] == 0 and place < status[wp.static(PAIR_COUNT)]:
            s = slot[place]
            pair_i_out[place] = row_i[s]
            pair_j_out[place] = row_j[s]
            pair_image_out[place] = row_image[s]
            key_out[place] = row_j[s]

    local = locals()
    names = (
        "wrap_fibers start_list bin_segments mark_starts sort_geometry find_pairs check_capacity "
        "compact_rows fetch_keys fetch_pairs"
    )
    return {kernel: local[kernel] for kernel in names.split()}
