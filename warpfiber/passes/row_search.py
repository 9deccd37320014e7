"""Search for pairs in plain Warp: every piece writes a row of those near it.

Half of the cells around a piece are looked at, so every pair is met once. Cells are counted without
wrapping: the box that a cell lies in follows by division, so two images of one pair, and a segment
and its own image, are met like any others.

A piece first collects the midpoints that are near its line, then those whose line is near, then the
law (or, in a loose list, pruning) confirms what is left. What is collected is stored whether it
passes or not, and kept by counting on: which one passes is anybody's guess, and a wrong one costs a
processor more than the rest of the test. Measured at 20,000 segments, V_f = 0.1, skin of a
diameter: 500 ns per segment, 610 with a branch for each test.
"""

from functools import cache

import warp as wp

from warpfiber.laws.segment_distance import make_segment_distance
from warpfiber.model import OVERFLOW, OVERFLOW_ROW, ROW_NEED, precision
from warpfiber.passes.cells import NO_WRAP, TINY, WRAP_Y, WRAP_Z, ListFeatures
from warpfiber.passes.native_search import PARALLEL, ROUNDING

ROOM = 32  # midpoints that wait at a time; a power of two, so that an index is never below 0


@cache
def make_row_search(name: str, features: ListFeatures):
    """`find_pairs` over pieces in the order of the cells."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    closest_fractions = make_segment_distance(name)
    px, py, pz = features.periodic
    pieces, closed, loose = features.pieces, features.closed, features.loose
    mask, offset_image = WRAP_Y - 1, WRAP_Y // 2
    far_away = wp.float32(1e6)
    zero, half = wp.float32(0.0), wp.float32(0.5)
    one, two = wp.float32(1.0), wp.float32(2.0)
    List = wp.types.vector(ROOM, wp.int32)
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

    @wp.func
    def rounding(x: wp.vec3f) -> wp.float32:
        return wp.float32(ROUNDING) * (wp.abs(x[0]) + wp.abs(x[1]) + wp.abs(x[2]))

    @wp.func
    def run_shift(frame: wp.array(dtype=wp.float32), run: wp.int32) -> wp.vec3f:
        """Where the box lies whose number is the linear part `run` of an image."""
        n = wp.vec3f(
            wp.float32((run & wp.static(mask)) - wp.static(offset_image)),
            wp.float32(((run / wp.static(WRAP_Y)) & wp.static(mask)) - wp.static(offset_image)),
            wp.float32(run / wp.static(WRAP_Z) - wp.static(offset_image)),
        )
        return wp.vec3f(
            frame[9] * n[0] + frame[10] * n[1] + frame[11] * n[2],
            frame[12] * n[0] + frame[13] * n[1] + frame[14] * n[2],
            frame[15] * n[0] + frame[16] * n[1] + frame[17] * n[2],
        )

    @wp.func
    def confirm(
        k: wp.int32,
        waiting: wp.int32,
        place: List,
        image: List,
        before: wp.int32,
        row_capacity: wp.int32,
        near: wp.float32,
        sizes: wp.array(dtype=wp.float64),
        frame: wp.array(dtype=wp.float32),
        lattice: wp.array(dtype=wp.mat33d),
        geometry: wp.array(dtype=wp.vec4f),
        start: wp.array(dtype=vec3),
        axis: wp.array(dtype=vec3),
        segment: wp.array(dtype=wp.int32),
        wrap: wp.array(dtype=wp.int32),
        part: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_skip: wp.array(dtype=wp.int32),
        fiber_ring: wp.array(dtype=wp.int32),
        row_i_out: wp.array(dtype=wp.int32),
        row_j_out: wp.array(dtype=wp.int32),
        row_image_out: wp.array(dtype=wp.int32),
    ) -> wp.int32:
        """Pairs in the row of piece k, those of its `waiting` midpoints among them."""
        here = geometry[2 * k]
        own_axis = geometry[2 * k + 1]
        x = wp.vec3f(here[0], here[1], here[2])
        a = wp.vec3f(own_axis[0], own_axis[1], own_axis[2])
        aa = wp.dot(a, a) + wp.float32(TINY)
        inverse_aa = own_axis[3]
        kept = wp.int32(0)
        for e in range(waiting):
            m = place[e]
            run = image[e]
            there = geometry[2 * m]
            b = geometry[2 * m + 1]
            qx = there[0] - x[0]
            qy = there[1] - x[1]
            qz = there[2] - x[2]
            margin = near + zero
            if run != wp.static(NO_WRAP):
                shift = run_shift(frame, run)
                qx += shift[0]
                qy += shift[1]
                qz += shift[2]
                margin += rounding(shift)
            da = qx * a[0] + qy * a[1] + qz * a[2]
            bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] + wp.float32(TINY)
            near2 = margin * margin + wp.float32(PARALLEL) * (aa + bb)
            ab = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
            db = qx * b[0] + qy * b[1] + qz * b[2]
            den = wp.float32(1e-6) * aa * bb
            den += above(aa * bb - ab * ab - den)
            s = within_one((da * bb - db * ab) / den)
            t = within_one((s * ab - db) * b[3])
            s = within_one((t * ab + da) * inverse_aa)
            cx = qx + t * b[0] - s * a[0]
            cy = qy + t * b[1] - s * a[1]
            cz = qz + t * b[2] - s * a[2]
            place[kept] = m
            image[kept] = run
            kept += wp.where(cx * cx + cy * cy + cz * cz > near2, 0, 1)
        i = segment[k]
        fiber = segment_fiber[i]
        count = before + 0
        for e in range(kept):
            m = place[e]
            j = segment[m]
            code = image[e] - wrap[m] + wrap[k]
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
            if not wp.static(loose):
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
        return count

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
        around = h + longest + rounding(x)
        near = h + two * wp.float32(ROUNDING) * around + rounding(x)
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
        count = wp.int32(0)
        waiting = wp.int32(0)
        place = List()
        image = List()
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
                    end = cell_start[row + stop + 1]
                    if mine and nx == 0 and ex == ox:
                        begin = k + 1
                    at = stop + nx * d[0] + 1
                    if begin >= end:
                        continue
                    run = wp.static(NO_WRAP) + nx + wp.static(WRAP_Y) * ny + wp.static(WRAP_Z) * nz
                    u = x + wp.vec3f(zero, zero, zero)  # a copy
                    wide_near = near + squares
                    if run != wp.static(NO_WRAP):
                        shift = run_shift(frame, run)
                        u = x - shift
                        wide_near += rounding(shift)
                    m = begin
                    while m < end:
                        if waiting == wp.static(ROOM):
                            count = confirm(
                                k,
                                waiting,
                                place,
                                image,
                                count,
                                row_capacity,
                                near,
                                sizes,
                                frame,
                                lattice,
                                geometry,
                                start,
                                axis,
                                segment,
                                wrap,
                                part,
                                segment_fiber,
                                fiber_skip,
                                fiber_ring,
                                row_i_out,
                                row_j_out,
                                row_image_out,
                            )
                            waiting = 0
                        last = wp.min(end, m + wp.static(ROOM) - waiting)
                        while m < last:
                            there = geometry[2 * m]
                            qx = there[0] - u[0]
                            qy = there[1] - u[1]
                            qz = there[2] - u[2]
                            qq = qx * qx + qy * qy + qz * qz
                            da = qx * a[0] + qy * a[1] + qz * a[2]
                            beyond = above(wp.abs(da) - aa)
                            far = there[3] + wide_near
                            place[waiting & wp.static(ROOM - 1)] = m
                            image[waiting & wp.static(ROOM - 1)] = run
                            off = qq - (da * da - beyond * beyond) * inverse_aa
                            waiting += wp.where(off > far * far, 0, 1)
                            m += 1
        count = confirm(
            k,
            waiting,
            place,
            image,
            count,
            row_capacity,
            near,
            sizes,
            frame,
            lattice,
            geometry,
            start,
            axis,
            segment,
            wrap,
            part,
            segment_fiber,
            fiber_skip,
            fiber_ring,
            row_i_out,
            row_j_out,
            row_image_out,
        )
        row_count_out[k] = count
        if count > row_capacity:
            # racing stores: any of the values tells the host to grow, and it grows until none is
            # left
            status[wp.static(OVERFLOW)] = wp.static(OVERFLOW_ROW)
            status[wp.static(ROW_NEED)] = count

    return find_pairs
