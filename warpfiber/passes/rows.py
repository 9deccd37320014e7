"""Pairs of a neighbor list in plain Warp: every piece writes a row, rows are compacted and sorted.

No thread waits for or adds to another, so this runs on CUDA as on the CPU; it is also what the
vectors of `native_search` and the counting sorts of `native_sort` are compared with. Half of the
cells around a piece are looked at, so every pair is met once. Cells are counted without wrapping:
the box that a cell lies in follows by division, so two images of one pair, and a segment and its
own image, are met like any others.
"""

from functools import cache

import warp as wp

from warpfiber.laws.segment_distance import make_segment_distance
from warpfiber.model import OVERFLOW, OVERFLOW_PAIRS, OVERFLOW_ROW, PAIR_COUNT, ROW_NEED, precision
from warpfiber.passes.cells import NO_WRAP, TINY, WRAP_Y, WRAP_Z, ListFeatures
from warpfiber.passes.native_search import PARALLEL, ROUNDING


@cache
def make_row_kernels(name: str, features: ListFeatures):
    """`find_pairs`, `check_capacity`, ... `fetch_pairs` in launch order, as a dict by name."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    closest_fractions = make_segment_distance(name)
    px, py, pz = features.periodic
    pieces, closed = features.pieces, features.closed
    mask, offset_image = WRAP_Y - 1, WRAP_Y // 2
    far_away = wp.float32(1e6)
    zero, half = wp.float32(0.0), wp.float32(0.5)
    one, two = wp.float32(1.0), wp.float32(2.0)
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

    @wp.func
    def boxes(c: wp.int32, d: wp.int32) -> wp.int32:
        """Whole boxes in `c` cells, rounded down."""
        if c >= 0:
            if c < d:
                return 0
            return c / d
        return -((d - 1 - c) / d)

    @wp.func
    def above(x: wp.float32) -> wp.float32:
        """x where positive, else 0: without the care of `wp.max` for NaN, one instruction."""
        return wp.where(x > zero, x, zero)

    @wp.func
    def within_one(x: wp.float32) -> wp.float32:
        """x between -1 and 1."""
        low = wp.where(x > -one, x, -one)
        return wp.where(low < one, low, one)

    @wp.func
    def cell_range(middle: wp.float32, reach: wp.float32, d: wp.int32, wraps: wp.bool):
        """First and last cell of what lies within reach of the middle."""
        low = wp.int32(wp.floor(wp.clamp(middle - reach, -far_away, far_away)))
        high = wp.int32(wp.floor(wp.clamp(middle + reach, -far_away, far_away)))
        if not wraps:
            low = wp.clamp(low, 0, d - 1)
            high = wp.clamp(high, 0, d - 1)
        return low, high

    @wp.func
    def image_vector(lattice: wp.mat33d, code: wp.int32) -> vec3:
        return vec3(
            lattice
            * wp.vec3d(
                wp.float64((code & wp.static(mask)) - wp.static(offset_image)),
                wp.float64(
                    ((code / wp.static(WRAP_Y)) & wp.static(mask)) - wp.static(offset_image)
                ),
                wp.float64(code / wp.static(WRAP_Z) - wp.static(offset_image)),
            )
        )

    @wp.func
    def holds(fraction: real, part: wp.int32) -> wp.bool:
        """Whether a fraction of the segment lies in this piece of it."""
        count = part / 65536
        return wp.min(wp.int32(fraction * real(count)), count - 1) == part % 65536

    @wp.kernel(**options)
    def find_pairs(
        row_capacity: wp.int32,
        sizes: wp.array(dtype=wp.float64),
        cells: wp.array(dtype=wp.vec3i),
        frame: wp.array(dtype=wp.float32),
        lattice: wp.array(dtype=wp.mat33d),
        key: wp.array(dtype=wp.int32),
        cell_start: wp.array(dtype=wp.int32),
        geometry: wp.array(dtype=wp.vec4f),
        start: wp.array(dtype=vec3),
        axis: wp.array(dtype=vec3),
        segment: wp.array(dtype=wp.int32),
        wrap: wp.array(dtype=wp.int32),
        part: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_skip: wp.array(dtype=wp.int32),
        fiber_ring: wp.array(dtype=wp.int32),
        row_count_out: wp.array(dtype=wp.int32),
        row_i_out: wp.array(dtype=wp.int32),
        row_j_out: wp.array(dtype=wp.int32),
        row_image_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        k = wp.tid()
        d = cells[0]
        own = key[k]
        own_row = own / d[0]
        ox = own - own_row * d[0]
        oz = own_row / d[1]
        oy = own_row - oz * d[1]
        here = geometry[2 * k]
        own_axis = geometry[2 * k + 1]
        x = wp.vec3f(here[0], here[1], here[2])
        a = wp.vec3f(own_axis[0], own_axis[1], own_axis[2])
        aa = wp.dot(a, a) + wp.float32(TINY)
        inverse_aa = own_axis[3]
        h = wp.float32(sizes[0])
        longest = half * wp.float32(sizes[1])
        size = wp.abs(x[0]) + wp.abs(x[1]) + wp.abs(x[2])
        around = h + longest + wp.float32(ROUNDING) * size
        near = h + wp.float32(ROUNDING) * (two * around + size)
        # what the rounding of squares as large as those of the farthest near midpoints adds
        squares = wp.float32(PARALLEL) * (around + longest) * (around + longest) / h
        low = wp.vec3i(0, 0, 0)
        high = wp.vec3i(0, 0, 0)
        for axis_number in range(3):
            g = wp.vec3f(
                frame[3 * axis_number], frame[3 * axis_number + 1], frame[3 * axis_number + 2]
            )
            wide = frame[18 + axis_number]
            # longer pieces than the cells hold are not in this list: they call for a new one
            reach = wp.min(wp.abs(wp.dot(g, a)), longest * wide)
            reach += around * wide + wp.float32(2e-3)
            wraps = wp.bool(wp.static(px))
            if axis_number == 1:
                wraps = wp.bool(wp.static(py))
            if axis_number == 2:
                wraps = wp.bool(wp.static(pz))
            first, last = cell_range(wp.dot(g, x), reach, d[axis_number], wraps)
            low[axis_number] = first
            high[axis_number] = last
        i = segment[k]
        fiber = segment_fiber[i]
        count = wp.int32(0)
        for z in range(wp.max(low[2], oz), high[2] + 1):
            nz = boxes(z, d[2])
            first_y = low[1]
            if z == oz:
                first_y = wp.max(first_y, oy)
            for y in range(first_y, high[1] + 1):
                ny = boxes(y, d[1])
                row = ((z - nz * d[2]) * d[1] + y - ny * d[1]) * d[0]
                mine = z == oz and y == oy
                at = low[0]
                if mine:
                    at = wp.max(at, ox)
                while at <= high[0]:
                    nx = boxes(at, d[0])
                    ex = at - nx * d[0]
                    stop = wp.min(high[0] - nx * d[0], d[0] - 1)
                    begin = cell_start[row + ex]
                    if mine and nx == 0 and ex == ox:
                        begin = k + 1
                    at = stop + nx * d[0] + 1
                    shift = wp.vec3f(zero, zero, zero)
                    margin = near + zero  # a copy
                    if nx != 0 or ny != 0 or nz != 0:
                        for row_number in range(3):
                            shift[row_number] = (
                                frame[9 + 3 * row_number] * wp.float32(nx)
                                + frame[10 + 3 * row_number] * wp.float32(ny)
                                + frame[11 + 3 * row_number] * wp.float32(nz)
                            )
                            margin += wp.float32(ROUNDING) * wp.abs(shift[row_number])
                    run = wp.static(NO_WRAP) + nx + wp.static(WRAP_Y) * ny + wp.static(WRAP_Z) * nz
                    u = x - shift
                    end = cell_start[row + stop + 1]
                    next_piece = begin
                    while next_piece < end:
                        m = next_piece
                        next_piece += 1
                        # the distance of the midpoint from the piece, then that of the two lines,
                        # then that of the two pieces: each rejects most of what the one before left
                        there = geometry[2 * m]
                        qx = there[0] - u[0]
                        qy = there[1] - u[1]
                        qz = there[2] - u[2]
                        qq = qx * qx + qy * qy + qz * qz
                        da = qx * a[0] + qy * a[1] + qz * a[2]
                        beyond = above(wp.abs(da) - aa)
                        far = there[3] + (margin + squares)
                        if qq - (da * da - beyond * beyond) * inverse_aa > far * far:
                            continue
                        b = geometry[2 * m + 1]
                        bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] + wp.float32(TINY)
                        near2 = margin * margin + wp.float32(PARALLEL) * (aa + bb)
                        across_x = a[1] * b[2] - a[2] * b[1]
                        across_y = a[2] * b[0] - a[0] * b[2]
                        across_z = a[0] * b[1] - a[1] * b[0]
                        nn = across_x * across_x + across_y * across_y + across_z * across_z
                        qn = qx * across_x + qy * across_y + qz * across_z
                        if qn * qn > near2 * nn + wp.float32(PARALLEL) * qq * aa * bb:
                            continue
                        ab = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
                        db = qx * b[0] + qy * b[1] + qz * b[2]
                        den = wp.max(aa * bb - ab * ab, wp.float32(1e-6) * aa * bb)
                        s = within_one((da * bb - db * ab) / den)
                        t = within_one((s * ab - db) * b[3])
                        s = within_one((t * ab + da) * inverse_aa)
                        cx = qx + t * b[0] - s * a[0]
                        cy = qy + t * b[1] - s * a[1]
                        cz = qz + t * b[2] - s * a[2]
                        if cx * cx + cy * cy + cz * cz > near2:
                            continue
                        j = segment[m]
                        code = run - wrap[m] + wrap[k]
                        if code == wp.static(NO_WRAP):
                            apart = wp.abs(i - j)
                            if wp.static(closed):
                                if segment_fiber[j] == fiber and fiber_ring[fiber] > 0:
                                    apart = wp.min(apart, fiber_ring[fiber] - apart)
                            if apart - 1 < fiber_skip[fiber]:
                                if segment_fiber[j] == fiber:
                                    continue
                        lower = k
                        upper = m
                        if i > j or (i == j and code < wp.static(NO_WRAP)):
                            lower = m
                            upper = k
                            code = 2 * wp.static(NO_WRAP) - code
                        delta = start[upper] - start[lower]
                        if code != wp.static(NO_WRAP):
                            delta += image_vector(lattice[0], code)
                        st = closest_fractions(delta, axis[lower], axis[upper])
                        c = delta + st[1] * axis[upper] - st[0] * axis[lower]
                        nearest = real(sizes[0])
                        # a distance that is not a number is no pair
                        if not (wp.length_sq(c) <= nearest * nearest):
                            continue
                        if wp.static(pieces):
                            # of all pairs of pieces only the one with the closest points reports
                            if not (holds(st[0], part[lower]) and holds(st[1], part[upper])):
                                continue
                        if count < row_capacity:
                            slot = k * row_capacity + count
                            row_i_out[slot] = wp.min(i, j)
                            row_j_out[slot] = wp.max(i, j)
                            row_image_out[slot] = code
                        count += 1
        row_count_out[k] = count
        if count > row_capacity:
            # racing stores: any of the values tells the host to grow, and it grows until none is
            # left
            status[wp.static(OVERFLOW)] = wp.static(OVERFLOW_ROW)
            status[wp.static(ROW_NEED)] = count

    @wp.kernel(**options)
    def check_capacity(
        rows: wp.int32,
        pair_capacity: wp.int32,
        row_end: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        total = row_end[rows - 1]
        status[wp.static(PAIR_COUNT)] = total
        if total > pair_capacity and status[wp.static(OVERFLOW)] == 0:
            status[wp.static(OVERFLOW)] = wp.static(OVERFLOW_PAIRS)

    @wp.kernel(**options)
    def compact_rows(
        row_capacity: wp.int32,
        row_count: wp.array(dtype=wp.int32),
        row_end: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        row_i: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_image: wp.array(dtype=wp.int32),
        key_out: wp.array(dtype=wp.int32),
        found_j_out: wp.array(dtype=wp.int32),
        found_image_out: wp.array(dtype=wp.int32),
    ):
        if status[wp.static(OVERFLOW)] != 0:
            return
        k = wp.tid()
        count = row_count[k]
        place = row_end[k] - count
        for slot in range(k * row_capacity, k * row_capacity + count):
            key_out[place] = row_i[slot]
            found_j_out[place] = row_j[slot]
            found_image_out[place] = row_image[slot]
            place += 1

    @wp.kernel(**options)
    def number_places(
        bins: wp.int32,
        status: wp.array(dtype=wp.int32),
        key_out: wp.array(dtype=wp.int32),
        slot_out: wp.array(dtype=wp.int32),
        in_key_out: wp.array(dtype=wp.int32),
        in_pair_out: wp.array(dtype=wp.int32),
    ):
        """What is sorted along; places beyond the last pair sort to the end of both orders."""
        place = wp.tid()
        in_key_out[place] = bins
        slot_out[place] = place
        in_pair_out[place] = place
        if status[wp.static(OVERFLOW)] != 0 or place >= status[wp.static(PAIR_COUNT)]:
            key_out[place] = bins

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
    def fetch_pairs(
        out_start: wp.array(dtype=wp.int32),
        slot: wp.array(dtype=wp.int32),
        found_j: wp.array(dtype=wp.int32),
        found_image: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        pair_i_out: wp.array(dtype=wp.int32),
        pair_j_out: wp.array(dtype=wp.int32),
        pair_image_out: wp.array(dtype=wp.int32),
        in_key_out: wp.array(dtype=wp.int32),
    ):
        """Pairs of one owner in the order of partner and image."""
        if status[wp.static(OVERFLOW)] != 0:
            return
        i = wp.tid()
        begin = out_start[i]
        for place in range(begin, out_start[i + 1]):
            j = found_j[slot[place]]
            code = found_image[slot[place]]
            at = place
            while at > begin:
                other = pair_j_out[at - 1]
                if other < j or (other == j and pair_image_out[at - 1] <= code):
                    break
                pair_j_out[at] = other
                pair_image_out[at] = pair_image_out[at - 1]
                in_key_out[at] = other
                at -= 1
            pair_i_out[place] = i
            pair_j_out[at] = j
            pair_image_out[at] = code
            in_key_out[at] = j

    local = locals()
    names = "find_pairs check_capacity compact_rows number_places mark_starts fetch_pairs"
    return {kernel: local[kernel] for kernel in names.split()}
