"""CPU only: counting sorts of one neighbor list, every worker its own range of bins.

Each worker reads all keys and places those of its own bins, so workers neither wait for each other
nor share a counter, and the order within a bin is that of the keys: the same for any number of
workers. `rows.mark_starts` behind a radix sort is the plain version.
"""

from functools import cache

import warp as wp

from warpfiber.model import OVERFLOW, OVERFLOW_PAIRS, PAIR_COUNT, ROW_NEED

# Keys stand in `regions` parts of `stride` places of which only the first count[region] are in use;
# a negative key belongs to no bin. start[bins] is written by whoever owns the last bin.
COUNT_KEYS = r"""
    const int first = (int)((long long)bins * worker / workers);
    const int last = (int)((long long)bins * (worker + 1) / workers);
    int* start = start_out.data;
    for (int b = first; b < last; ++b) start[b] = 0;
    int before = 0, all = 0;
    for (int r = 0; r < regions; ++r) {
        const int* keys = key.data + (long long)r * stride;
        const int used = count.data[r] < stride ? count.data[r] : stride;
        for (int k = 0; k < used; ++k) {
            const int b = keys[k];
            all += b >= 0;
            before += b >= 0 && b < first;
            if (b >= first && b < last) ++start[b];
        }
    }
"""

# Starts first hold the end of every row and are counted down, so the keys are taken backwards.
PLACE_KEYS = r"""
    int sum = before;
    for (int b = first; b < last; ++b) { sum += start[b]; start[b] = sum; }
    if (last == bins) start[bins] = all;
    for (int r = regions - 1; r >= 0; --r) {
        const int* keys = key.data + (long long)r * stride;
        const int used = count.data[r] < stride ? count.data[r] : stride;
        for (int k = used - 1; k >= 0; --k) {
            const int b = keys[k];
            if (b >= first && b < last) place_out.data[--start[b]] = r * stride + k;
        }
    }
"""

# Found pairs by owner, rows in the order of partner and image.
ORDER_ROWS = (
    COUNT_KEYS
    + r"""
    if (worker == 0) {
        int need = 0;
        for (int r = 0; r < regions; ++r) need = count.data[r] > need ? count.data[r] : need;
        status.data[PAIR_COUNT] = all;
        if (need > stride || all > capacity) {
            status.data[ROW_NEED] = need;
            status.data[OVERFLOW] = OVERFLOW_PAIRS;
        }
    }
    for (int r = 0; r < regions; ++r) if (count.data[r] > stride) return;
    if (all > capacity) return;
"""
    + PLACE_KEYS
    + r"""
    for (int i = first; i < last; ++i) {
        const int begin = start[i], end = i + 1 < last ? start[i + 1] : sum;
        for (int a = begin; a < end; ++a) {
            const int slot = place_out.data[a], j = partner.data[slot], n = image.data[slot];
            int b = a;
            for (; b > begin; --b) {
                const int other = pair_j_out.data[b - 1];
                if (other < j || (other == j && pair_image_out.data[b - 1] <= n)) break;
                pair_j_out.data[b] = other;
                pair_image_out.data[b] = pair_image_out.data[b - 1];
            }
            pair_i_out.data[a] = i;
            pair_j_out.data[b] = j;
            pair_image_out.data[b] = n;
        }
    }
"""
)
for _slot, _value in {
    "OVERFLOW_PAIRS": OVERFLOW_PAIRS,
    "PAIR_COUNT": PAIR_COUNT,
    "ROW_NEED": ROW_NEED,
    "[OVERFLOW]": f"[{OVERFLOW}]",
}.items():
    ORDER_ROWS = ORDER_ROWS.replace(_slot, str(_value))


@cache
def make_sort_kernels(module: str = "unique"):
    """`sort_cells`, `order_rows`, `index_partners`, each over workers, as a dict by name."""
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.func_native(COUNT_KEYS + PLACE_KEYS)
    def sort_keys(
        worker: wp.int32,
        workers: wp.int32,
        bins: wp.int32,
        regions: wp.int32,
        stride: wp.int32,
        count: wp.array(dtype=wp.int32),
        key: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
        place_out: wp.array(dtype=wp.int32),
    ): ...

    @wp.func_native(ORDER_ROWS)
    def sort_rows(
        worker: wp.int32,
        workers: wp.int32,
        bins: wp.int32,
        regions: wp.int32,
        stride: wp.int32,
        capacity: wp.int32,
        count: wp.array(dtype=wp.int32),
        key: wp.array(dtype=wp.int32),
        partner: wp.array(dtype=wp.int32),
        image: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
        place_out: wp.array(dtype=wp.int32),
        pair_i_out: wp.array(dtype=wp.int32),
        pair_j_out: wp.array(dtype=wp.int32),
        pair_image_out: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(**options)
    def sort_cells(
        offset: wp.int32,
        workers: wp.int32,
        cells: wp.array(dtype=wp.vec3i),
        count: wp.array(dtype=wp.int32),
        key: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
        place_out: wp.array(dtype=wp.int32),
    ):
        """Pieces by cell."""
        d = cells[0]
        bins = d[0] * d[1] * d[2]
        n = count[0]
        sort_keys(wp.tid() + offset, workers, bins, 1, n, count, key, start_out, place_out)

    @wp.kernel(**options)
    def order_rows(
        offset: wp.int32,
        workers: wp.int32,
        regions: wp.int32,
        bins: wp.int32,
        stride: wp.int32,
        capacity: wp.int32,
        count: wp.array(dtype=wp.int32),
        key: wp.array(dtype=wp.int32),
        partner: wp.array(dtype=wp.int32),
        image: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
        place_out: wp.array(dtype=wp.int32),
        pair_i_out: wp.array(dtype=wp.int32),
        pair_j_out: wp.array(dtype=wp.int32),
        pair_image_out: wp.array(dtype=wp.int32),
    ):
        """Found pairs by owner, partner and image."""
        sort_rows(
            wp.tid() + offset,
            workers,
            bins,
            regions,
            stride,
            capacity,
            count,
            key,
            partner,
            image,
            status,
            start_out,
            place_out,
            pair_i_out,
            pair_j_out,
            pair_image_out,
        )

    @wp.kernel(**options)
    def index_partners(
        offset: wp.int32,
        workers: wp.int32,
        bins: wp.int32,
        status: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        in_start_out: wp.array(dtype=wp.int32),
        in_pair_out: wp.array(dtype=wp.int32),
        pair_total: wp.array(dtype=wp.int32),
    ):
        """Places of the pairs by partner."""
        if status[wp.static(OVERFLOW)] != 0:
            return
        worker = wp.tid() + offset
        n = pair_total[0]
        sort_keys(worker, workers, bins, 1, n, pair_total, pair_j, in_start_out, in_pair_out)

    local = locals()
    return {kernel: local[kernel] for kernel in "sort_cells order_rows index_partners".split()}
