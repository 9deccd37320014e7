"""The launches of one list build, with the arguments of every kernel."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import warp as wp

from warpfiber.model import PAIR_COUNT
from warpfiber.passes.executor import Call, Launch

if TYPE_CHECKING:
    from warpfiber.passes.neighbors import NeighborList

Launches = list[Launch | Call]


def list_launches(pairs: NeighborList) -> Launches:
    """Fibers into the box, pieces into cells, pairs out of them."""
    if pairs.native:
        found = [*_bin(pairs), _native_sort(pairs), _gather(pairs), *_native_pairs(pairs)]
    else:
        found = [*_bin(pairs), *_plain_sort(pairs), _gather(pairs), *_plain_pairs(pairs)]
    return [*found, *pairs.pruning.begin()] if pairs.pruning is not None else found


def _listed(pairs: NeighborList) -> tuple[Any, Any, Any, Any]:
    """Starts by owner, owners, partners and images: of the wide list where there is one."""
    wide = pairs.pruning
    if wide is not None:
        return wide.wide_start, wide.wide_i, wide.wide_j, wide.wide_image
    return pairs.out_start, pairs.pair_i, pairs.pair_j, pairs.pair_image


def _launch(
    pairs: NeighborList,
    name: str,
    dim: int,
    *inputs: Any,
    split: bool = True,
    follows: bool = False,
) -> Launch:
    return Launch(name, pairs.kernels[name], dim, list(inputs), split=split, follows=follows)


def _bin(pairs: NeighborList) -> Launches:
    model, state = pairs.model, pairs.state
    return [
        _launch(
            pairs,
            "place_fibers",
            model.fiber_count,
            pairs.wraps,
            state.lattice,
            state.gradient,
            model.fiber_node_start,
            state.node_pos,
            state.node_velocity,
            state.fiber_image,
            state.list_pos,
        ),
        *(_extend(pairs) if pairs.slide_origin is not None else []),
        _launch(
            pairs,
            "start_list",
            1,
            pairs.sizes,
            pairs.cell_capacity,
            state.lattice,
            state.list_lattice,
            state.deformation,
            pairs.inverse,
            pairs.cells,
            pairs.frame,
            state.status,
            split=False,
        ),
        _launch(
            pairs,
            "bin_pieces",
            pairs.piece_count,
            wp.vec3d(*model.domain.low),
            pairs.sizes,
            pairs.inverse,
            pairs.cells,
            pairs.piece_segment,
            pairs.piece_part,
            model.segment_node,
            model.segment_end,
            state.node_pos,
            pairs.segment_extension,
            pairs.piece_wrap,
            pairs.cell_key,
            pairs.order,
        ),
    ]


def _extend(pairs: NeighborList) -> Launches:
    model, state = pairs.model, pairs.state
    slide, fastest = pairs.segment_slide, pairs.fastest_slide
    move = [state.gradient, model.segment_node, state.node_pos, state.node_velocity, slide]
    extend = [pairs.wraps, pairs.sizes, slide, fastest, pairs.segment_extension]
    count, origin = model.segment_count, model.precision.vec3(*pairs.slide_origin)
    return [
        _launch(pairs, "slide_segments", count, origin, *move),
        _launch(pairs, "fastest_slide", 1, slide, fastest, split=False),
        _launch(pairs, "extend_segments", count, *extend),
    ]


def _gather(pairs: NeighborList) -> Launch:
    return _launch(
        pairs,
        "gather_pieces",
        pairs.piece_count,
        pairs.stride,
        wp.vec3d(*pairs.model.domain.low),
        pairs.sizes,
        pairs.state.lattice,
        pairs.order,
        pairs.piece_wrap,
        pairs.piece_segment,
        pairs.piece_part,
        pairs.model.segment_node,
        pairs.model.segment_end,
        pairs.state.node_pos,
        pairs.segment_extension,
        pairs.geometry,
        pairs.sorted_start,
        pairs.sorted_axis,
        pairs.sorted_segment,
        pairs.sorted_wrap,
        pairs.sorted_part,
        pairs.state.status,
    )


# -- CPU: native search and sorts -----------------------------------------------------------------
# All workers share every launch but the one that counts the cells.


def _native_sort(pairs: NeighborList) -> Launch:
    return _launch(
        pairs,
        "sort_cells",
        pairs.workers,
        pairs.workers,
        pairs.cells,
        pairs.piece_total,
        pairs.cell_key,
        pairs.cell_start,
        pairs.order,
    )


def _native_pairs(pairs: NeighborList) -> Launches:
    model, state, workers = pairs.model, pairs.state, pairs.workers
    found = (pairs.row_i, pairs.row_j, pairs.row_image)
    out_start, *listed = _listed(pairs)
    search = [
        _launch(
            pairs,
            "search_pairs",
            workers,
            workers,
            pairs.piece_count,
            pairs.stride,
            pairs.region,
            pairs.sizes,
            pairs.cells,
            pairs.frame,
            pairs.cell_key,
            pairs.order,
            pairs.cell_start,
            pairs.geometry,
            pairs.sorted_segment,
            pairs.sorted_wrap,
            model.segment_fiber,
            pairs.fiber_skip,
            *found,
            pairs.found_count,
            pairs.tally,
        ),
        _launch(
            pairs,
            "order_rows",
            workers,
            workers,
            workers,
            model.segment_count,
            pairs.region,
            pairs.pair_capacity,
            pairs.found_count,
            *found,
            state.status,
            out_start,
            pairs.pair_slot,
            *listed,
        ),
    ]
    if "confirm_pairs" in pairs.kernels:
        search.insert(1, _confirm(pairs))
    if pairs.pruning is not None:
        return search
    index = _launch(
        pairs,
        "index_partners",
        workers,
        workers,
        model.segment_count,
        state.status,
        pairs.pair_j,
        pairs.in_start,
        pairs.in_pair,
        state.status[PAIR_COUNT : PAIR_COUNT + 1],
    )
    return [*search, index]


def _confirm(pairs: NeighborList) -> Launch:
    return _launch(
        pairs,
        "confirm_pairs",
        pairs.workers * pairs.region,
        pairs.region,
        pairs.sizes,
        pairs.state.lattice,
        pairs.sorted_start,
        pairs.sorted_axis,
        pairs.sorted_segment,
        pairs.sorted_part,
        pairs.found_count,
        pairs.row_i,
        pairs.row_j,
        pairs.row_image,
        follows=True,
    )


# -- everywhere: padded rows and radix sorts ------------------------------------------------------


def _sort(keys: Any, values: Any, count: int, bins: int) -> Call:
    bits = max(1, math.ceil(math.log2(bins + 1)))

    def sort() -> None:
        wp.utils.radix_sort_pairs(keys, values, count, 0, bits)

    return Call("sort", sort)


def _starts(pairs: NeighborList, keys: Any, total: Any, slot: int, bins: int, out: Any) -> Launch:
    dim = len(keys) // 2 + 1
    return _launch(pairs, "mark_starts", dim, total, slot, bins, keys, out, split=False)


def _plain_sort(pairs: NeighborList) -> Launches:
    bins = pairs.cell_capacity
    return [
        _sort(pairs.cell_key, pairs.order, pairs.piece_count, bins),
        _starts(pairs, pairs.cell_key, pairs.piece_total, 0, bins, pairs.cell_start),
    ]


def _plain_pairs(pairs: NeighborList) -> Launches:
    model, state = pairs.model, pairs.state
    count, capacity, segments = pairs.piece_count, pairs.pair_capacity, model.segment_count
    rows = (pairs.row_i, pairs.row_j, pairs.row_image)
    status = state.status
    out_start, *listed = _listed(pairs)

    def scan() -> None:
        wp.utils.array_scan(pairs.row_count, pairs.row_end, inclusive=True)

    search = [
        _launch(
            pairs,
            "find_pairs",
            count,
            pairs.row_capacity,
            pairs.sizes,
            pairs.cells,
            pairs.frame,
            state.lattice,
            pairs.cell_key,
            pairs.cell_start,
            pairs.geometry,
            pairs.sorted_start,
            pairs.sorted_axis,
            pairs.sorted_segment,
            pairs.sorted_wrap,
            pairs.sorted_part,
            model.segment_fiber,
            pairs.fiber_skip,
            pairs.fiber_ring,
            pairs.row_count,
            *rows,
            status,
            split=False,
        ),
        Call("scan", scan),
        _launch(pairs, "check_capacity", 1, count, capacity, pairs.row_end, status, split=False),
        _launch(
            pairs,
            "compact_rows",
            count,
            pairs.row_capacity,
            pairs.row_count,
            pairs.row_end,
            status,
            *rows,
            pairs.pair_key,
            pairs.found_j,
            pairs.found_image,
            split=False,
        ),
        _launch(
            pairs,
            "number_places",
            capacity,
            segments,
            status,
            pairs.pair_key,
            pairs.pair_slot,
            pairs.in_key,
            pairs.in_pair,
            split=False,
        ),
        _sort(pairs.pair_key, pairs.pair_slot, capacity, segments),
        _starts(pairs, pairs.pair_key, status, PAIR_COUNT, segments, out_start),
        _launch(
            pairs,
            "fetch_pairs",
            segments,
            out_start,
            pairs.pair_slot,
            pairs.found_j,
            pairs.found_image,
            status,
            *listed,
            pairs.in_key,
            split=False,
        ),
    ]
    if pairs.pruning is not None:
        return search
    index = _starts(pairs, pairs.in_key, status, PAIR_COUNT, segments, pairs.in_start)
    return [*search, _sort(pairs.in_key, pairs.in_pair, capacity, segments), index]
