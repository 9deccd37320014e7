"""Segments in cells: the kernels that every neighbor list needs before it can look for pairs.

Segments are entered at their midpoints; one much longer than the others as several pieces of equal
length, so that it does not set the width of the cells. The box is cut into rows along its first
axis and rows into short cells: what is near a piece lies in few runs of neighbors in memory.
Positions in the cells are float32 beside an exact copy; they only serve tests that err on the safe
side.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.model import EXPIRED, OVERFLOW, ROW_NEED, STRETCHED, precision
from warpfiber.passes.pairs import IMAGE_BITS, image_code

MAX_CELLS_PER_PIECE = 4
# Widths of a cell in the largest distance of midpoints that can be near, along and across a row,
# where vectors search and where one piece after the other does (not native). Measured at 20,000
# segments: (0.25, 0.6) finds 1.7 times fewer midpoints but takes the vectors 1.3 times as long,
# since its runs are shorter than one; without vectors (0.1, 0.6) takes 0.85 of (0.1, 1.3).
CELL_LENGTH, CELL_WIDTH = 0.1, {True: 1.3, False: 0.6}
NARROWEST, FEW_CELLS = 0.45, 4.0
MOST_CELLS = 2000.0  # along one axis: a float32 still tells cells apart to a thousandth
GEOMETRY_PLANES = 7  # midpoint, half axis, half length
TINY = 1e-30  # added to squared lengths that are divided by
PLANE_PADDING = 64  # a vector may read past the last piece
WRAP_Y, WRAP_Z = 1 << IMAGE_BITS, 1 << (2 * IMAGE_BITS)
NO_WRAP = image_code(0, 0, 0)


@dataclass(frozen=True)
class ListFeatures:
    """Which axes wrap, whether shear resets the lattice, whether segments are cut into pieces.

    `loose`: the list is pruned, so what only float32 holds for near may stay. `slides`: segments
    have extensions of their own, instead of one for all.
    """

    periodic: tuple[bool, bool, bool]
    shear_axes: tuple[int, int] | None = None
    sheared: bool = False
    pieces: bool = False
    closed: bool = False  # segments that end at the first node of their fiber
    loose: bool = False
    slides: bool = False


# Cell order is random order in memory: what the pieces after this one need is asked for early.
FETCH_AHEAD = r"""
    const int far = k + 32, near = k + 16, last = order.shape[0] - 1;
    const int e = order.data[far < last ? far : last];
    __builtin_prefetch(piece_wrap.data + e);
    __builtin_prefetch(segment_node.data + e);
    const int soon = order.data[near < last ? near : last];
    const char* x = (const char*)(node_pos.data + segment_node.data[soon]);
    __builtin_prefetch(x);
    __builtin_prefetch(x + 2 * sizeof(node_pos.data[0]) - 1);
"""


@cache
def make_cell_kernels(
    name: str, features: ListFeatures, native: bool = False, module: str = "unique"
):
    """`place_fibers`, `start_list`, `bin_pieces`, `gather_pieces` as a dict by name.

    `geometry` of the pieces in the order of the cells: planes of one number each for vectors
    (`native`), else two vec4 per piece: midpoint and half length, half axis a and 1 / a^2.
    """
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    px, py, pz = features.periodic
    flow_axis, gradient_axis = features.shear_axes or (0, 0)
    i_flow, i_gradient = wp.constant(flow_axis), wp.constant(gradient_axis)
    resets = features.shear_axes is not None
    sheared = features.sheared
    pieces, closed, loose = features.pieces, features.closed, features.loose
    slides = features.slides
    half = wp.float64(0.5)
    stored = wp.float32 if native else wp.vec4f
    options = {"module": module, "enable_backward": False, "grid_stride": False}

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

    @wp.func
    def middle_fraction(part: wp.int32) -> wp.float64:
        """Where along its segment the middle of a piece lies; `part` = number + 65536 count."""
        return (wp.float64(part % 65536) + half) / wp.float64(part / 65536)

    ahead = native and not pieces  # CPU only

    @wp.func_native(FETCH_AHEAD)
    def fetch_ahead(
        k: wp.int32,
        order: wp.array(dtype=wp.int32),
        piece_wrap: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
    ): ...

    @wp.kernel(**options)
    def place_fibers(
        offset: wp.int32,
        wraps: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=wp.mat33d),
        gradient: wp.array(dtype=mat33),
        fiber_node_start: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        fiber_image: wp.array(dtype=wp.vec3i),
        list_pos_out: wp.array(dtype=vec3),
    ):
        """Wrap every fiber into the box and remember where it is."""
        fiber = wp.tid() + offset
        first = fiber_node_start[fiber]
        last = fiber_node_start[fiber + 1] - 1
        if wraps[0] != 0:
            h = lattice[0]
            if wp.static(resets):
                turns = excess_turns(h)
                if turns != wp.float64(0.0):
                    image = fiber_image[fiber]
                    image[i_flow] = image[i_flow] + wp.int32(turns) * image[i_gradient]
                    fiber_image[fiber] = image
                    h[i_flow, i_gradient] = h[i_flow, i_gradient] - turns * h[i_flow, i_flow]
            center = wp.vec3d(node_pos[first] + node_pos[last]) * half
            n = wrap_count(wp.inverse(h) * center)
            if n[0] != 0 or n[1] != 0 or n[2] != 0:
                fiber_image[fiber] = fiber_image[fiber] + n
                shift = vec3(lattice_vector(h, n))
                for i in range(first, last + 1):
                    node_pos[i] = node_pos[i] - shift
                    if wp.static(sheared):
                        node_velocity[i] = node_velocity[i] - gradient[0] * shift
        for i in range(first, last + 1):
            list_pos_out[i] = node_pos[i]

    @wp.kernel(**options)
    def start_list(
        sizes: wp.array(dtype=wp.float64),
        cell_capacity: wp.int32,
        lattice: wp.array(dtype=wp.mat33d),
        list_lattice: wp.array(dtype=wp.mat33d),
        deformation: wp.array(dtype=wp.mat33d),
        inverse_out: wp.array(dtype=wp.mat33d),
        cells_out: wp.array(dtype=wp.vec3i),
        frame_out: wp.array(dtype=wp.float32),
        status: wp.array(dtype=wp.int32),
    ):
        """Lattice, cells and cleared status.

        `frame`: cells per length (9), lattice (9), cells per length along every axis (3).
        """
        h = lattice[0]
        if wp.static(resets):
            turns = excess_turns(h)
            h[i_flow, i_gradient] = h[i_flow, i_gradient] - turns * h[i_flow, i_flow]
            lattice[0] = h
        list_lattice[0] = h
        deformation[0] = wp.identity(n=3, dtype=wp.float64)
        inverse = wp.inverse(h)
        inverse_out[0] = inverse
        near = sizes[0] + sizes[1]
        # rows of the inverse have the inverse heights of the box as lengths
        d = wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(1.0))
        for axis in range(3):
            width = near * wp.float64(wp.static(CELL_WIDTH[native]))
            if axis == 0:
                width = near * wp.float64(CELL_LENGTH)
            height = wp.float64(1.0) / wp.length(inverse[axis])
            count = wp.floor(height / width)
            # boxes of few cells: what lies around a piece is less than so many whole cells
            narrow = wp.floor(height / (near * wp.float64(NARROWEST)))
            count = wp.max(count, wp.min(narrow, wp.float64(FEW_CELLS)))
            d[axis] = wp.clamp(count, wp.float64(1.0), wp.float64(MOST_CELLS))
        while d[0] * d[1] * d[2] > wp.float64(cell_capacity):
            for axis in range(3):
                d[axis] = wp.max(wp.floor(d[axis] * wp.float64(0.875)), wp.float64(1.0))
        cells_out[0] = wp.vec3i(wp.int32(d[0]), wp.int32(d[1]), wp.int32(d[2]))
        for row in range(3):
            for col in range(3):
                frame_out[3 * row + col] = wp.float32(inverse[row, col] * d[row])
                frame_out[9 + 3 * row + col] = wp.float32(h[row, col])
            frame_out[18 + row] = wp.float32(wp.length(inverse[row]) * d[row])
        status[wp.static(EXPIRED)] = 0
        status[wp.static(OVERFLOW)] = 0
        status[wp.static(STRETCHED)] = 0
        status[wp.static(ROW_NEED)] = 0

    @wp.kernel(**options)
    def bin_pieces(
        offset: wp.int32,
        low: wp.vec3d,
        sizes: wp.array(dtype=wp.float64),
        inverse: wp.array(dtype=wp.mat33d),
        cells: wp.array(dtype=wp.vec3i),
        piece_segment: wp.array(dtype=wp.int32),
        piece_part: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_end: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        segment_extension: wp.array(dtype=real),
        piece_wrap_out: wp.array(dtype=wp.int32),
        key_out: wp.array(dtype=wp.int32),
        order_out: wp.array(dtype=wp.int32),
    ):
        """Cell of every piece and the whole boxes it lies away (as the linear part of an image)."""
        e = wp.tid() + offset
        i = e
        if wp.static(pieces):
            i = piece_segment[e]
        node = segment_node[i]
        start = wp.vec3d(node_pos[node])
        after = node + 1
        if wp.static(closed):
            after = segment_end[i]
        end = wp.vec3d(node_pos[after])
        middle = half * (start + end)
        if wp.static(pieces):
            middle = start + middle_fraction(piece_part[e]) * (end - start)
            if sizes[2] > wp.float64(0.0):
                longer = sizes[2]
                if wp.static(slides):
                    longer = wp.float64(segment_extension[i])
                share = middle_fraction(piece_part[e]) - half
                middle += (wp.float64(2.0) * longer * share) * wp.normalize(end - start)
        x = inverse[0] * (middle - low)
        n = wrap_count(x)
        piece_wrap_out[e] = n[0] + wp.static(WRAP_Y) * n[1] + wp.static(WRAP_Z) * n[2]
        d = cells[0]
        c = wp.vec3i(0, 0, 0)
        for axis in range(3):
            along = (x[axis] - wp.float64(n[axis])) * wp.float64(d[axis])
            c[axis] = wp.clamp(wp.int32(wp.floor(along)), 0, d[axis] - 1)
        key_out[e] = (c[2] * d[1] + c[1]) * d[0] + c[0]
        order_out[e] = e

    @wp.kernel(**options)
    def gather_pieces(
        offset: wp.int32,
        stride: wp.int32,
        low: wp.vec3d,
        sizes: wp.array(dtype=wp.float64),
        lattice: wp.array(dtype=wp.mat33d),
        order: wp.array(dtype=wp.int32),
        piece_wrap: wp.array(dtype=wp.int32),
        piece_segment: wp.array(dtype=wp.int32),
        piece_part: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_end: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        segment_extension: wp.array(dtype=real),
        geometry_out: wp.array(dtype=stored),
        start_out: wp.array(dtype=vec3),
        axis_out: wp.array(dtype=vec3),
        segment_out: wp.array(dtype=wp.int32),
        wrap_out: wp.array(dtype=wp.int32),
        part_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        """Copies in the order of the cells: the segment as listed, its piece wrapped in float32."""
        k = wp.tid() + offset
        if wp.static(ahead):
            fetch_ahead(k, order, piece_wrap, segment_node, node_pos)
        e = order[k]
        i = e
        if wp.static(pieces):
            i = piece_segment[e]
        node = segment_node[i]
        start = node_pos[node]
        after = node + 1
        if wp.static(closed):
            after = segment_end[i]
        axis = node_pos[after] - start
        if sizes[2] > wp.float64(0.0):
            longer = real(sizes[2])
            if wp.static(slides):
                longer = segment_extension[i]
            reach = longer / wp.length(axis) * axis
            start -= reach
            axis += reach + reach
        if not wp.static(loose):
            start_out[k] = start
            axis_out[k] = axis
        segment_out[k] = i
        code = piece_wrap[e]
        wrap_out[k] = code
        half_axis = half * wp.vec3d(axis)
        middle = wp.vec3d(start) - low + half_axis
        if wp.static(pieces):
            part = piece_part[e]
            part_out[k] = part
            middle = wp.vec3d(start) - low + middle_fraction(part) * wp.vec3d(axis)
            half_axis = half_axis / wp.float64(part / 65536)
        if code != 0:
            n = code + wp.static(NO_WRAP)
            mask = wp.static(WRAP_Y - 1)
            middle -= lattice_vector(
                lattice[0],
                wp.vec3i(
                    (n & mask) - wp.static(WRAP_Y // 2),
                    ((n / wp.static(WRAP_Y)) & mask) - wp.static(WRAP_Y // 2),
                    (n / wp.static(WRAP_Z)) - wp.static(WRAP_Y // 2),
                ),
            )
        half_length = wp.length(half_axis)
        if wp.static(native):
            for axis_number in range(3):
                geometry_out[axis_number * stride + k] = wp.float32(middle[axis_number])
                geometry_out[(axis_number + 3) * stride + k] = wp.float32(half_axis[axis_number])
            geometry_out[6 * stride + k] = wp.float32(half_length)
        else:
            x, a = wp.vec3f(middle), wp.vec3f(half_axis)
            inverse_aa = wp.float32(1.0) / (wp.dot(a, a) + wp.float32(TINY))
            geometry_out[2 * k] = wp.vec4f(x[0], x[1], x[2], wp.float32(half_length))
            geometry_out[2 * k + 1] = wp.vec4f(a[0], a[1], a[2], inverse_aa)
        if half_length > half * sizes[1]:
            status[wp.static(STRETCHED)] = 1

    local = locals()
    names = "place_fibers start_list bin_pieces gather_pieces"
    return {kernel: local[kernel] for kernel in names.split()}
