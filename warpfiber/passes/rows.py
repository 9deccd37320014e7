"""Pairs of a neighbor list in plain Warp: rows of found pairs are compacted and sorted.

No thread waits for or adds to another, so this runs on CUDA as on the CPU; it is also what the
vectors of `native_search` and the counting sorts of `native_sort` are compared with.
"""

from functools import cache

import warp as wp

from warpfiber.model import OVERFLOW, OVERFLOW_PAIRS, PAIR_COUNT
from warpfiber.passes.cells import ListFeatures
from warpfiber.passes.row_search import make_row_search


@cache
def make_row_kernels(name: str, features: ListFeatures):
    """`find_pairs`, `check_capacity`, ... `fetch_pairs` in launch order, as a dict by name."""
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

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
    names = "check_capacity compact_rows number_places mark_starts fetch_pairs"
    found = {"find_pairs": make_row_search(name, features)}
    return found | {kernel: local[kernel] for kernel in names.split()}
