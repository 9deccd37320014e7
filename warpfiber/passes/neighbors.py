"""Pairs of segments within reach of one another: flat half list with an incoming index.

A build wraps fibers into the box, sorts segments by cell, keeps what is near, and sorts the kept
pairs by (owner, partner), so that the list does not depend on the order of the cells. It is one
captured graph at fixed capacities; a capacity that turns out too small grows and the build is
repeated.

The list is exact for as long as the node sweep's skin test says so (`nodes.skin_limit`): motion is
measured beside the imposed affine flow, which moves pairs apart by a known amount.

Limits: heights of the box >= `cell_width`; the host checks that.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import (
    OVERFLOW,
    OVERFLOW_PAIRS,
    OVERFLOW_ROW,
    PAIR_COUNT,
    ROW_NEED,
    Model,
    State,
)
from warpfiber.passes.cells import MAX_CELLS_PER_SEGMENT, ListFeatures, make_list_kernels
from warpfiber.passes.executor import load_kernel

FIRST_STRETCH = 1.05  # rest lengths that a segment may have before the cells are widened
CELL_SLACK = 1.02  # what a segment may grow in the step that outgrows the cells


class NeighborList:
    """Half list of segment pairs nearer than `reach` + `skin` (run units).

    Arrays: `out_start` (S+1), `pair_i`, `pair_j`, `pair_image` (capacity), sorted by (i, j); pairs
    where j = s are `in_pair[in_start[s]:in_start[s+1]]`.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        *,
        reach: float,
        skin: float,
        longest_rest: float,
        stretch: float = 1.0,
        row_capacity: int = 24,
        pair_capacity: int | None = None,
    ) -> None:
        self.model, self.state = model, state
        self.reach, self.skin = reach, skin
        self.longest_rest = longest_rest
        self.stretch_allowed = max(FIRST_STRETCH, CELL_SLACK * stretch)
        self.row_capacity = row_capacity
        self.pair_capacity = pair_capacity or max(64, 4 * model.segment_count)
        self.build_count = 0
        self.grow_count = 0
        domain = model.domain
        features = ListFeatures(domain.periodic, domain.shear_axes, domain.sheared)
        self.kernels = make_list_kernels(model.precision.name, features)
        for kernel in self.kernels.values():
            load_kernel(kernel, model.device)
        segments, device = model.segment_count, model.device
        self.cell_capacity = max(1, MAX_CELLS_PER_SEGMENT * segments)
        self.cells = wp.zeros(1, dtype=wp.vec3i, device=device)
        self.cell_start = wp.zeros(self.cell_capacity + 1, dtype=wp.int32, device=device)
        self.cell_key = wp.zeros(2 * segments, dtype=wp.int32, device=device)
        self.order = wp.zeros(2 * segments, dtype=wp.int32, device=device)
        self.segment_wrap = wp.zeros(segments, dtype=wp.vec3i, device=device)
        self.sorted_pos = wp.zeros(segments, dtype=model.precision.vec3, device=device)
        self.sorted_axis = wp.zeros(segments, dtype=model.precision.vec3, device=device)
        self.sorted_fiber = wp.zeros(segments, dtype=wp.int32, device=device)
        self.row_count = wp.zeros(segments, dtype=wp.int32, device=device)
        self.row_end = wp.zeros(segments, dtype=wp.int32, device=device)
        self.out_start = wp.zeros(segments + 1, dtype=wp.int32, device=device)
        self.in_start = wp.zeros(segments + 1, dtype=wp.int32, device=device)
        self.segment_total = wp.array([segments], dtype=wp.int32, device=device)
        self._allocate_rows()
        self._allocate_pairs()

    @property
    def cell_width(self) -> float:
        """Width that holds a segment, its reach and the skin; a step may stretch a bit more."""
        return CELL_SLACK * self.stretch_allowed * self.longest_rest + self.reach + self.skin

    def set_stretch(self, stretch: float) -> None:
        """Cells that hold segments of this many rest lengths, from the next build on."""
        self.stretch_allowed = stretch
        self._graphs = {}

    def _allocate_rows(self) -> None:
        size, device = self.model.segment_count * self.row_capacity, self.model.device
        self.row_i = wp.zeros(size, dtype=wp.int32, device=device)
        self.row_j = wp.zeros(size, dtype=wp.int32, device=device)
        self.row_image = wp.zeros(size, dtype=wp.int32, device=device)
        self._graphs: dict[bool, Any] = {}

    def _allocate_pairs(self) -> None:
        size, device = self.pair_capacity, self.model.device
        self.pair_i = wp.zeros(size, dtype=wp.int32, device=device)
        self.pair_j = wp.zeros(size, dtype=wp.int32, device=device)
        self.pair_image = wp.zeros(size, dtype=wp.int32, device=device)
        self.pair_key = wp.zeros(2 * size, dtype=wp.int32, device=device)
        self.pair_slot = wp.zeros(2 * size, dtype=wp.int32, device=device)
        self.in_key = wp.zeros(2 * size, dtype=wp.int32, device=device)
        self.in_pair = wp.zeros(2 * size, dtype=wp.int32, device=device)
        self._graphs = {}

    @property
    def pair_count(self) -> int:
        """Number of listed pairs."""
        return int(self.state.status.numpy()[PAIR_COUNT])

    def build(self, *, wrap: bool = True) -> bool:
        """Build from the current positions; True if pair arrays were replaced by larger ones."""
        replaced = False
        while True:
            if wrap not in self._graphs:
                with wp.ScopedCapture(device=self.model.device, force_module_load=False) as capture:
                    self._launch_all(wrap)
                self._graphs[wrap] = capture.graph
            wp.capture_launch(self._graphs[wrap])
            status = self.state.status.numpy()
            overflow = int(status[OVERFLOW])
            if overflow == 0:
                self.build_count += 1
                return replaced
            self.grow_count += 1
            wrap = False  # fibers are inside the box by now
            if overflow == OVERFLOW_ROW:
                self.row_capacity = max(int(1.5 * int(status[ROW_NEED])), self.row_capacity + 1)
                self._allocate_rows()
            elif overflow == OVERFLOW_PAIRS:
                self.pair_capacity = int(1.3 * int(status[PAIR_COUNT])) + 64
                self._allocate_pairs()
                replaced = True

    def _launch_all(self, wrap: bool) -> None:
        model, state, kernels = self.model, self.state, self.kernels
        segments, device = model.segment_count, model.device
        low = wp.vec3d(*model.domain.low)

        def launch(name: str, dim: int, *inputs: Any) -> None:
            wp.launch(kernels[name], dim=dim, inputs=list(inputs), device=device)

        if wrap:
            launch(
                "wrap_fibers",
                model.fiber_count,
                state.lattice,
                state.gradient,
                model.fiber_node_start,
                state.node_pos,
                state.node_velocity,
                state.fiber_image,
            )
        launch(
            "start_list",
            1,
            wp.float64(self.cell_width),
            self.cell_capacity,
            state.lattice,
            state.list_lattice,
            state.deformation,
            self.cells,
            state.status,
        )
        launch(
            "bin_segments",
            segments,
            low,
            state.lattice,
            self.cells,
            model.segment_node,
            state.node_pos,
            self.segment_wrap,
            self.cell_key,
            self.order,
        )
        bits = max(1, math.ceil(math.log2(self.cell_capacity + 1)))
        wp.utils.radix_sort_pairs(self.cell_key, self.order, segments, 0, bits)
        launch(
            "mark_starts",
            segments + 1,
            self.segment_total,
            0,
            self.cell_capacity,
            self.cell_key,
            self.cell_start,
        )
        launch(
            "sort_geometry",
            segments,
            state.lattice,
            self.order,
            self.segment_wrap,
            model.segment_node,
            model.segment_fiber,
            state.node_pos,
            self.sorted_pos,
            self.sorted_axis,
            self.sorted_fiber,
        )
        launch(
            "find_pairs",
            segments,
            model.precision.real(self.reach + self.skin),
            self.row_capacity,
            state.lattice,
            self.cells,
            self.cell_start,
            self.cell_key,
            self.order,
            self.segment_wrap,
            model.groups,
            model.fiber_group,
            self.sorted_pos,
            self.sorted_axis,
            self.sorted_fiber,
            self.row_count,
            self.row_i,
            self.row_j,
            self.row_image,
            state.status,
        )
        wp.utils.array_scan(self.row_count, self.row_end, inclusive=True)
        launch("check_capacity", 1, segments, self.pair_capacity, self.row_end, state.status)
        launch(
            "compact_rows",
            segments,
            self.row_capacity,
            self.row_count,
            self.row_end,
            state.status,
            self.pair_slot,
        )
        self._sort_pairs(launch)
        wp.copy(state.list_pos, state.node_pos)

    def _sort_pairs(self, launch: Any) -> None:
        """Stable sorts by partner, then by owner; then the incoming index by partner again."""
        segments, capacity = self.model.segment_count, self.pair_capacity
        status = self.state.status
        bits = max(1, segments.bit_length())
        for source in (self.row_j, self.row_i):
            launch("fetch_keys", capacity, segments, source, self.pair_slot, status, self.pair_key)
            wp.utils.radix_sort_pairs(self.pair_key, self.pair_slot, capacity, 0, bits)
        mark = ("mark_starts", capacity + 1, status, PAIR_COUNT, segments)
        launch(*mark, self.pair_key, self.out_start)
        launch(
            "fetch_pairs",
            capacity,
            self.pair_slot,
            self.row_i,
            self.row_j,
            self.row_image,
            status,
            segments,
            self.pair_i,
            self.pair_j,
            self.pair_image,
            self.in_key,
            self.in_pair,
        )
        wp.utils.radix_sort_pairs(self.in_key, self.in_pair, capacity, 0, bits)
        launch(*mark, self.in_key, self.in_start)

    def host_pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Owner, partner and image code of every listed pair, as NumPy copies."""
        n = self.pair_count
        return tuple(a.numpy()[:n].copy() for a in (self.pair_i, self.pair_j, self.pair_image))
