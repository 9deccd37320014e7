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
from warpfiber.passes.cells import NO_WRAP, WRAP_Y, WRAP_Z, ListFeatures
from warpfiber.passes.native_search import ROUNDING


@cache
def make_row_kernels(name: str, features: ListFeatures):
    """`find_pairs`, `check_capacity`, ... `fetch_pairs` in launch order, as a dict by name."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    closest_fractions = make_segment_distance(name)
    px, py, pz = features.periodic
    pieces = features.pieces
    mask, offset_image = WRAP_Y - 1, WRAP_Y // 2
    far_away = wp.float32(1e6)
    zero, one, half = wp.float32(0.0), wp.float32(1.0), wp.float32(0.5)
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

    @wp.func
    def boxes(c: wp.int32, d: wp.int32) -> wp.int32:
        """Whole boxes in `c` cells, rounded down."""
        if c >= 0:
            return c / d
        return -((d - 1 - c) / d)

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
        stride: wp.int32,
        sizes: wp.array(dtype=wp.float64),
        cells: wp.array(dtype=wp.vec3i),
        frame: wp.array(dtype=wp.float32),
        lattice: wp.array(dtype=wp.mat33d),
        key: wp.array(dtype=wp.int32),
        cell_start: wp.array(dtype=wp.int32),
        planes: wp.array(dtype=wp.float32),
        start: wp.array(dtype=vec3),
        axis: wp.array(dtype=vec3),
        segment: wp.array(dtype=wp.int32),
        wrap: wp.array(dtype=wp.int32),
        part: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_skip: wp.array(dtype=wp.int32),
        row_count_out: wp.array(dtype=wp.int32),
        row_i_out: wp.array(dtype=wp.int32),
        row_j_out: wp.array(dtype=wp.int32),
        row_image_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        k = wp.tid()
        d = cells[0]
        own = key[k]
        ox = own % d[0]
        oy = (own / d[0]) % d[1]
        oz = own / (d[0] * d[1])
        x = wp.vec3f(planes[k], planes[stride + k], planes[2 * stride + k])
        a = wp.vec3f(planes[3 * stride + k], planes[4 * stride + k], planes[5 * stride + k])
        inverse_aa = one / (wp.dot(a, a) + wp.float32(1e-30))
        h = wp.float32(sizes[0])
        longest = half * wp.float32(sizes[1])
        size = wp.abs(x[0]) + wp.abs(x[1]) + wp.abs(x[2])
        around = h + longest + wp.float32(ROUNDING) * size
        low = wp.vec3i(0, 0, 0)
        high = wp.vec3i(0, 0, 0)
        for axis_number in range(3):
            g = wp.vec3f(
                frame[3 * axis_number], frame[3 * axis_number + 1], frame[3 * axis_number + 2]
            )
            wide = wp.length(g)
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
                cx = low[0]
                if mine:
                    cx = wp.max(cx, ox)
                while cx <= high[0]:
                    nx = boxes(cx, d[0])
                    ex = cx - nx * d[0]
                    stop = wp.min(high[0] - nx * d[0], d[0] - 1)
                    begin = cell_start[row + ex]
                    if mine and nx == 0 and ex == ox:
                        begin = k + 1
                    cx = stop + nx * d[0] + 1
                    shift = wp.vec3f(zero, zero, zero)
                    if nx != 0 or ny != 0 or nz != 0:
                        for row_number in range(3):
                            shift[row_number] = (
                                frame[9 + 3 * row_number] * wp.float32(nx)
                                + frame[10 + 3 * row_number] * wp.float32(ny)
                                + frame[11 + 3 * row_number] * wp.float32(nz)
                            )
                    margin = h + wp.float32(ROUNDING) * (
                        wp.float32(2.0) * around
                        + size
                        + wp.abs(shift[0])
                        + wp.abs(shift[1])
                        + wp.abs(shift[2])
                    )
                    run = wp.static(NO_WRAP) + nx + wp.static(WRAP_Y) * ny + wp.static(WRAP_Z) * nz
                    for m in range(begin, cell_start[row + stop + 1]):
                        q = (
                            wp.vec3f(planes[m], planes[stride + m], planes[2 * stride + m])
                            + shift
                            - x
                        )
                        q -= wp.clamp(wp.dot(q, a) * inverse_aa, -one, one) * a
                        far = planes[6 * stride + m] + margin
                        if wp.length_sq(q) > far * far:
                            continue
                        j = segment[m]
                        code = run - wrap[m] + wrap[k]
                        if code == wp.static(NO_WRAP):
                            if wp.abs(i - j) - 1 < fiber_skip[fiber]:
                                if segment_fiber[j] == fiber:
                                    continue
                        u = k
                        v = m
                        if i > j or (i == j and code < wp.static(NO_WRAP)):
                            u = m
                            v = k
                            code = 2 * wp.static(NO_WRAP) - code
                        delta = start[v] - start[u]
                        if code != wp.static(NO_WRAP):
                            delta += image_vector(lattice[0], code)
                        st = closest_fractions(delta, axis[u], axis[v])
                        c = delta + st[1] * axis[v] - st[0] * axis[u]
                        nearest = real(sizes[0])
                        # a distance that is not a number is no pair
                        if not (wp.length_sq(c) <= nearest * nearest):
                            continue
                        if wp.static(pieces):
                            # of all pairs of pieces only the one with the closest points reports
                            if not (holds(st[0], part[u]) and holds(st[1], part[v])):
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
        in_key_out: wp.array(dtype=wp.int32),
        in_pair_out: wp.array(dtype=wp.int32),
    ):
        """Owner of every place; places beyond the last pair sort to the end of both orders."""
        place = wp.tid()
        in_key_out[place] = bins
        in_pair_out[place] = place
        if status[wp.static(OVERFLOW)] == 0 and place < status[wp.static(PAIR_COUNT)]:
            key_out[place] = source[slot[place]]
        else:
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
        row_j: wp.array(dtype=wp.int32),
        row_image: wp.array(dtype=wp.int32),
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
            j = row_j[slot[place]]
            code = row_image[slot[place]]
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
    names = "find_pairs check_capacity compact_rows fetch_keys mark_starts fetch_pairs"
    return {kernel: local[kernel] for kernel in names.split()}
