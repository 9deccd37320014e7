"""CPU only: counting sorts of one neighbor list, every worker its own range of bins.

Each worker reads all keys and places those of its own bins, so workers neither wait for each other
nor share a counter, and the order within a bin is that of the keys: the same for any number of
workers. Which keys are a worker's own cannot be guessed, so vectors find them, 64 at a time.
`rows.mark_starts` behind a radix sort is the plain version.
"""

from functools import cache

import warp as wp

from warpfiber.model import OVERFLOW, OVERFLOW_PAIRS, PAIR_COUNT, ROW_NEED
from warpfiber.passes.pairs import IMAGE_BITS

# Keys stand in `regions` parts of `stride` places of which only the first count[region] are in use;
# a negative key belongs to no bin. start[bins] is written by whoever owns the last bin. Workers
# share the bins so that about as many keys are in those of each, by a sample of the keys.
COUNT_KEYS = r"""
    typedef int I __attribute__((ext_vector_type(16)));
    typedef bool B __attribute__((ext_vector_type(16)));
    typedef unsigned long long word_t;
    auto used_in = [&](int r) { return count.data[r] < stride ? count.data[r] : stride; };
    int first = 0, last = bins;
    if (workers > 1) {
        enum { PARTS = 256, SAMPLES = 512 };
        int weight[PARTS], whole = 0, sum = 0, keys_used = 0, begin = PARTS, end = PARTS;
        for (int c = 0; c < PARTS; ++c) weight[c] = 1;  // a bin without keys takes time as well
        for (int r = 0; r < regions; ++r) keys_used += used_in(r);
        const int every = keys_used / SAMPLES + 1;
        const float part = (float)PARTS / (float)bins;
        for (int r = 0; r < regions; ++r)
            for (int k = 0, used = used_in(r); k < used; k += every) {
                const int b = key.data[(long long)r * stride + k], c = (int)(part * (float)b);
                if (b >= 0) weight[c < PARTS ? c : PARTS - 1] += 4;
            }
        for (int c = 0; c < PARTS; ++c) whole += weight[c];
        for (int c = PARTS - 1; c >= 0; --c) {
            if ((whole - sum) * workers >= whole * worker) begin = c;
            if ((whole - sum) * workers >= whole * (worker + 1)) end = c;
            sum += weight[c];
        }
        first = worker == 0 ? 0 : (int)((long long)bins * begin / PARTS);
        last = worker == workers - 1 ? bins : (int)((long long)bins * end / PARTS);
    }
    int* start = start_out.data;
    for (int b = first; b < last; ++b) start[b] = 0;
    int before = 0, all = 0;
    // bits of up to 64 keys that are in the bins of this worker: which ones is anybody's guess
    auto mine = [&](const int* keys, int n) -> word_t {
        word_t in = 0, below = 0, any = 0;
        for (int q = 0; q + 16 <= n; q += 16) {
            I k;
            __builtin_memcpy(&k, keys + q, sizeof(k));
            auto bits = [&](I is) -> word_t {
                const B set = __builtin_convertvector(is, B);
                return (word_t)__builtin_bit_cast(unsigned short, set) << q;
            };
            in |= bits((k >= first) & (k < last));
            below |= bits((k >= 0) & (k < first));
            any |= bits(k >= 0);
        }
        for (int q = n / 16 * 16; q < n; ++q) {
            const int k = keys[q];
            in |= (word_t)((k >= first) & (k < last)) << q;
            below |= (word_t)((k >= 0) & (k < first)) << q;
            any |= (word_t)(k >= 0) << q;
        }
        before += __builtin_popcountll(below);
        all += __builtin_popcountll(any);
        return in;
    };
    for (int r = 0; r < regions; ++r) {
        const int* keys = key.data + (long long)r * stride;
        for (int k = 0, used = used_in(r); k < used; k += 64) {
            word_t in = mine(keys + k, used - k < 64 ? used - k : 64);
            if (~in == 0)
                for (int q = 0; q < 64; ++q) ++start[keys[k + q]];
            else
                for (; in; in &= in - 1) ++start[keys[k + __builtin_ctzll(in)]];
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
        const int used = used_in(r);
        for (int k = (used - 1) / 64 * 64; k >= 0 && used > 0; k -= 64) {
            word_t in = mine(keys + k, used - k < 64 ? used - k : 64);
            if (~in == 0) {
                for (int at = k + 63; at >= k; --at)
                    place_out.data[--start[keys[at]]] = r * stride + at;
                continue;
            }
            while (in) {
                const int q = 63 - __builtin_clzll(in);
                in ^= (word_t)1 << q;
                place_out.data[--start[keys[k + q]]] = r * stride + k + q;
            }
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
    // the place in a short row is the number of smaller ones, their order breaks ties
    typedef word_t L __attribute__((ext_vector_type(8)));
    typedef bool B8 __attribute__((ext_vector_type(8)));
    for (int i = first; i < last; ++i) {
        const int begin = start[i], end = i + 1 < last ? start[i + 1] : sum;
        if (end - begin <= 8) {
            word_t row[8];
            for (int a = 0; a < 8; ++a) row[a] = ~(word_t)0;
            for (int a = 0; a < end - begin; ++a) {
                const int slot = place_out.data[begin + a];
                const word_t code = image.data[slot];
                row[a] = (word_t)partner.data[slot] << 3 + CODE_BITS | code << 3 | a;
            }
            L all_of;
            __builtin_memcpy(&all_of, row, sizeof(all_of));
            for (int a = 0; a < end - begin; ++a) {
                const B8 less = __builtin_convertvector(all_of < row[a], B8);
                const int b = begin + __builtin_popcount(__builtin_bit_cast(unsigned char, less));
                pair_i_out.data[begin + a] = i;
                pair_j_out.data[b] = (int)(row[a] >> 3 + CODE_BITS);
                pair_image_out.data[b] = (int)(row[a] >> 3) & (1 << CODE_BITS) - 1;
            }
            continue;
        }
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
    "CODE_BITS": 3 * IMAGE_BITS,
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
