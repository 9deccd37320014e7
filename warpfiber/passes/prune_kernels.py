"""Kernels that prune a wide list of pairs to those near each other now (`pruning`).

Vectors test blocks of pairs on the CPU, each worker its share of the blocks; the plain kernels
take the partners of one segment each and number what is kept by a scan. Either way the order stays
that of the wide list.
"""

from functools import cache

import warp as wp

from warpfiber.laws.segment_distance import make_segment_distance
from warpfiber.model import EXPIRED, PAIR_COUNT, precision
from warpfiber.passes.native_pairs import BLOCK, near_text
from warpfiber.passes.nodes import make_skin_limit
from warpfiber.passes.pairs import NO_IMAGE, make_image

# Kept pairs of one worker, in order; starts of all segments up to that of its last listed pair.
KEEP = f"""
    const int total = wide_total.data[0], blocks = (total + {BLOCK - 1}) / {BLOCK};
    const int begin = (int)((long long)blocks * worker / workers);
    const int end = (int)((long long)blocks * (worker + 1) / workers);
    int place = 0;
    for (int w = 0; w < worker; ++w) place += kept.data[w];
    int below = begin > 0 ? wide_i.data[{BLOCK} * begin - 1] : -1;
    for (int block = begin; block < end; ++block)
        for (unsigned long long bits = near_bits.data[block]; bits; bits &= bits - 1) {{
            const int k = {BLOCK} * block + __builtin_ctzll(bits), i = wide_i.data[k];
            while (below < i) start_out.data[++below] = place;
            pair_i_out.data[place] = i;
            pair_j_out.data[place] = wide_j.data[k];
            pair_image_out.data[place] = wide_image.data[k];
            ++place;
        }}
    const bool is_last = worker == workers - 1;
    const int until = is_last ? segments : end > 0 ? wide_i.data[{BLOCK} * end - 1] : -1;
    while (below < until) start_out.data[++below] = place;
    if (is_last) status.data[{PAIR_COUNT}] = place;
"""


@cache
def make_wide_kernels(name: str, module: str = "unique"):
    """`remember_wide`, `remember_nodes`, `begin_prune`, `place_nodes` by name."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    skin_limit = make_skin_limit(name)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def remember_wide(
        lattice: wp.array(dtype=wp.mat33d),
        status: wp.array(dtype=wp.int32),
        wide_lattice_out: wp.array(dtype=wp.mat33d),
        wide_deformation_out: wp.array(dtype=wp.mat33d),
        wide_total_out: wp.array(dtype=wp.int32),
    ):
        """After a build: nothing has moved yet."""
        wide_lattice_out[0] = lattice[0]
        wide_deformation_out[0] = wp.identity(n=3, dtype=wp.float64)
        wide_total_out[0] = status[wp.static(PAIR_COUNT)]

    @wp.kernel(**options)
    def begin_prune(
        wide_sizes: wp.array(dtype=real),
        lattice: wp.array(dtype=wp.mat33d),
        list_lattice_out: wp.array(dtype=wp.mat33d),
        prune_lattice_out: wp.array(dtype=mat33),
        deformation: wp.array(dtype=wp.mat33d),
        wide_deformation: wp.array(dtype=wp.mat33d),
        affine_out: wp.array(dtype=mat33),
        limit_out: wp.array(dtype=real),
        short_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        """F since the build, and the square of the largest motion that the margin holds."""
        list_lattice_out[0] = lattice[0]
        prune_lattice_out[0] = mat33(lattice[0])
        wide_deformation[0] = deformation[0] * wide_deformation[0]
        deformation[0] = wp.identity(n=3, dtype=wp.float64)
        affine = mat33(wide_deformation[0])
        limit = skin_limit(affine, wide_sizes[1], wide_sizes[0])
        affine_out[0] = affine
        limit_out[0] = limit * limit
        short_out[0] = wp.where(limit < real(0.0), 1, 0)
        status[wp.static(EXPIRED)] = 0

    @wp.kernel(**options)
    def place_nodes(
        offset: wp.int32,
        flow_origin: vec3,
        affine: wp.array(dtype=mat33),
        limit: wp.array(dtype=real),
        wide_pos: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        list_pos_out: wp.array(dtype=vec3),
        short_out: wp.array(dtype=wp.int32),
    ):
        """`short` where the margin does not hold the motion of a node."""
        i = wp.tid() + offset
        x = node_pos[i]
        list_pos_out[i] = x
        moved = x - flow_origin - affine[0] * (wide_pos[i] - flow_origin)
        if not (wp.length_sq(moved) <= limit[0]):
            short_out[0] = 1

    @wp.kernel(**options)
    def remember_nodes(
        offset: wp.int32,
        node_pos: wp.array(dtype=vec3),
        pos_out: wp.array(dtype=vec3),
    ):
        i = wp.tid() + offset
        pos_out[i] = node_pos[i]

    local = locals()
    names = "remember_wide remember_nodes begin_prune place_nodes"
    return {kernel: local[kernel] for kernel in names.split()}


@cache
def make_native_prune(name: str, periodic: bool, module: str = "unique"):
    """`mark_near` and `keep_near`, each over workers, as a dict by name."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    options = {"module": module, "enable_backward": False, "grid_stride": False}
    head = "const auto touch_bound = reach_bound;"

    @wp.func_native(near_text(name, periodic, head=head, rest="return near;"))
    def near_block(
        first: wp.int32,
        count: wp.int32,
        fetch_from: wp.int32,
        reach_bound: real,
        segment_node: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
    ) -> wp.uint64: ...

    @wp.func_native("return __builtin_popcountll(bits);")
    def bit_count(bits: wp.uint64) -> wp.int32: ...

    @wp.func_native(KEEP)
    def keep(
        worker: wp.int32,
        workers: wp.int32,
        segments: wp.int32,
        wide_total: wp.array(dtype=wp.int32),
        near_bits: wp.array(dtype=wp.uint64),
        kept: wp.array(dtype=wp.int32),
        wide_i: wp.array(dtype=wp.int32),
        wide_j: wp.array(dtype=wp.int32),
        wide_image: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
        pair_i_out: wp.array(dtype=wp.int32),
        pair_j_out: wp.array(dtype=wp.int32),
        pair_image_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(**options)
    def mark_near(
        offset: wp.int32,
        workers: wp.int32,
        fetch_from: wp.int32,
        list_sizes: wp.array(dtype=real),
        segment_node: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        wide_total: wp.array(dtype=wp.int32),
        wide_i: wp.array(dtype=wp.int32),
        wide_j: wp.array(dtype=wp.int32),
        wide_image: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        near_bits_out: wp.array(dtype=wp.uint64),
        kept_out: wp.array(dtype=wp.int32),
    ):
        """Bits of the pairs to keep by block, and how many each worker has."""
        worker = wp.tid() + offset
        total = wide_total[0]
        blocks = (total + wp.static(BLOCK - 1)) / wp.static(BLOCK)
        begin = wp.int32(wp.int64(blocks) * wp.int64(worker) / wp.int64(workers))
        end = wp.int32(wp.int64(blocks) * wp.int64(worker + 1) / wp.int64(workers))
        kept = wp.int32(0)
        for block in range(begin, end):
            first = block * wp.static(BLOCK)
            bits = near_block(
                first,
                wp.min(total - first, wp.static(BLOCK)),
                fetch_from,
                list_sizes[0],
                segment_node,
                lattice,
                wide_i,
                wide_j,
                wide_image,
                node_pos,
            )
            near_bits_out[block] = bits
            kept += bit_count(bits)
        kept_out[worker] = kept

    @wp.kernel(**options)
    def keep_near(
        offset: wp.int32,
        workers: wp.int32,
        segments: wp.int32,
        wide_total: wp.array(dtype=wp.int32),
        near_bits: wp.array(dtype=wp.uint64),
        kept: wp.array(dtype=wp.int32),
        wide_i: wp.array(dtype=wp.int32),
        wide_j: wp.array(dtype=wp.int32),
        wide_image: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
        pair_i_out: wp.array(dtype=wp.int32),
        pair_j_out: wp.array(dtype=wp.int32),
        pair_image_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        keep(
            wp.tid() + offset,
            workers,
            segments,
            wide_total,
            near_bits,
            kept,
            wide_i,
            wide_j,
            wide_image,
            start_out,
            pair_i_out,
            pair_j_out,
            pair_image_out,
            status,
        )

    return {"mark_near": mark_near, "keep_near": keep_near}


@cache
def make_plain_prune(name: str, periodic: bool):
    """`mark_near` (over owners) and `keep_near` (over owners, or places) as a dict by name."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    closest_fractions = make_segment_distance(name)
    unpack_image = make_image(name)
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def mark_near(
        list_sizes: wp.array(dtype=real),
        segment_node: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        wide_start: wp.array(dtype=wp.int32),
        wide_j: wp.array(dtype=wp.int32),
        wide_image: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        near_out: wp.array(dtype=wp.int32),
        near_count_out: wp.array(dtype=wp.int32),
    ):
        """Places of the near partners, at the begin of the row of their segment.

        Stored whether near or not, and kept by counting on: nobody can guess which one is.
        """
        i = wp.tid()
        node_i = segment_node[i]
        xi = node_pos[node_i]
        a = node_pos[node_i + 1] - xi
        reach = list_sizes[0]
        begin = wide_start[i]
        place = begin
        for k in range(begin, wide_start[i + 1]):
            node_j = segment_node[wide_j[k]]
            xj = node_pos[node_j]
            b = node_pos[node_j + 1] - xj
            delta = xj - xi
            if wp.static(periodic):
                code = wide_image[k]
                if code != wp.static(NO_IMAGE):
                    delta += lattice[0] * unpack_image(code)
            st = closest_fractions(delta, a, b)
            c = delta + st[1] * b - st[0] * a
            near_out[place] = k
            place += wp.where(wp.length_sq(c) <= reach * reach, 1, 0)
        near_count_out[i] = place - begin

    @wp.kernel(**options)
    def keep_near(
        bins: wp.int32,
        room: wp.int32,
        near: wp.array(dtype=wp.int32),
        near_end: wp.array(dtype=wp.int32),
        wide_start: wp.array(dtype=wp.int32),
        wide_j: wp.array(dtype=wp.int32),
        wide_image: wp.array(dtype=wp.int32),
        start_out: wp.array(dtype=wp.int32),
        pair_i_out: wp.array(dtype=wp.int32),
        pair_j_out: wp.array(dtype=wp.int32),
        pair_image_out: wp.array(dtype=wp.int32),
        in_key_out: wp.array(dtype=wp.int32),
        in_pair_out: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
    ):
        """Kept pairs; places beyond the last one sort to the end of the order by partner."""
        i = wp.tid()
        total = near_end[bins - 1]
        if i < room:
            in_pair_out[i] = i
            if i >= total:
                in_key_out[i] = bins
        if i == 0:
            status[wp.static(PAIR_COUNT)] = total
            start_out[bins] = total
        if i >= bins:
            return
        place = wp.int32(0)
        if i > 0:
            place = near_end[i - 1]
        start_out[i] = place
        row = wide_start[i] - place
        for to in range(place, near_end[i]):
            k = near[row + to]
            j = wide_j[k]
            pair_i_out[to] = i
            pair_j_out[to] = j
            pair_image_out[to] = wide_image[k]
            in_key_out[to] = j

    return {"mark_near": mark_near, "keep_near": keep_near}
