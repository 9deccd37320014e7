"""Pairs of segments within reach of one another: flat half list with an incoming index.

A build wraps fibers into the box, sorts segments by cell, keeps what is near, and sorts the kept
pairs by (owner, partner, image), so that the list depends neither on the order of the cells nor on
the workers. It is captured once at fixed capacities; a capacity that turns out too small grows and
the build is repeated. On the CPU the search and the sorts are native code that all workers share;
the plain kernels make the same list.

The list is exact for as long as the node sweep's skin test says so (`nodes.skin_limit`): motion is
measured beside the imposed affine flow, which moves pairs apart by a known amount.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import (
    BAD_FIBER,
    OVERFLOW,
    OVERFLOW_PAIRS,
    OVERFLOW_ROW,
    PAIR_COUNT,
    ROW_NEED,
    STRETCHED,
    TORN,
    Model,
    State,
)
from warpfiber.passes.cells import (
    GEOMETRY_PLANES,
    MAX_CELLS_PER_PIECE,
    PLANE_PADDING,
    ListFeatures,
    make_cell_kernels,
)
from warpfiber.passes.executor import Executor
from warpfiber.passes.host_arrays import host_view, write_array
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.list_extension import make_extension_kernels
from warpfiber.passes.list_launches import list_launches
from warpfiber.passes.native_search import make_search_kernels
from warpfiber.passes.native_sort import make_sort_kernels
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.passes.pieces import piece_counts
from warpfiber.passes.pruning import Pruning
from warpfiber.passes.rows import make_row_kernels
from warpfiber.passes.worker_choice import WorkerChoice

FIRST_STRETCH = 1.05  # rest lengths that a segment may have before the cells are widened
START_ROOM = 1.02  # for segments that are longer than that from the start
FARTHEST = 1e8  # lengths from the origin, where single precision no longer tells neighbors
STRETCH_GROWTH = 1.2  # of the allowed stretch, when a segment outgrew the cells
OPEN_FRACTION = 0.1  # volume fraction that long segments are cut for where there is no box


class NeighborList:
    """Half list of segment pairs nearer than `reach` + `skin` (run units).

    Arrays: `out_start` (S+1), `pair_i`, `pair_j`, `pair_image` (capacity), sorted by (i, j); pairs
    where j = s are `in_pair[in_start[s]:in_start[s+1]]`. `sizes` (reach + skin, longest piece,
    extension) and `skin_out` (reach + skin, skin, extension) are read by kernels, so these may
    change between builds. Segments are listed as if longer by the extension at each end: what
    slides along itself uses up that before the skin.

    With `slide_origin`, of the flow, each has its own part of that (`list_extension`).

    With `flow_origin` the pairs are pruned from a wider list (`pruning`): a build makes that one
    and prunes it, `prune` alone the arrays above.
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
        row_capacity: int = 12,
        pair_capacity: int | None = None,
        workers: int = 1,
        native: bool | None = None,
        flow_origin: np.ndarray | None = None,
        slide_origin: np.ndarray | None = None,
    ) -> None:
        self.model, self.state = model, state
        self.slide_origin = slide_origin
        self.reach, self.skin = reach, skin
        self.extension = 0.0
        self.longest_rest = longest_rest
        self.stretch_allowed = max(FIRST_STRETCH, START_ROOM * stretch)
        self.row_capacity = row_capacity
        self.workers = workers
        self.worker_choice: WorkerChoice | None = None
        closed = len(model.segment_end) > 0
        self.native = model.device.startswith("cpu") if native is None else native
        self.native = self.native and not closed  # vectors know open fibers alone
        room = 1.5 if flow_origin is None else 3.2  # pairs per segment; a wide list has more
        self.pair_capacity = pair_capacity or max(64, int(room * model.segment_count))
        self.build_count = 0
        self.grow_count = 0
        self._executor: Executor | None = None
        self.pruning: Pruning | None = None
        self._cut_into_pieces()
        domain, name = model.domain, model.precision.name
        has_pieces = self.piece_count > model.segment_count
        # pairs a rounding of float32 too far are pruned, or cost an implicit step nothing
        loose = flow_origin is not None or (slide_origin is not None and self.native)
        features = ListFeatures(
            domain.periodic,
            domain.shear_axes,
            domain.sheared,
            has_pieces,
            closed,
            loose=loose and not has_pieces,
            slides=slide_origin is not None,
        )
        if self.native:
            module = kernel_module("list", name, features)
            self.kernels = make_cell_kernels(name, features, True, module)
            self.kernels |= make_search_kernels(name, features, module)
            self.kernels |= make_sort_kernels(module)
        else:
            self.kernels = make_cell_kernels(name, features) | make_row_kernels(name, features)
        if features.slides:
            self.kernels |= make_extension_kernels(name, kernel_module("slide", name))
        if flow_origin is not None:
            self.pruning = Pruning(self, flow_origin)
            self.kernels |= self.pruning.kernels
        self._allocate_cells(features.loose)
        self._allocate_rows()
        self._allocate_pairs()

    def _cut_into_pieces(self) -> None:
        """Pieces of all segments, in the order of the segments."""
        model = self.model
        segments, group = model.segment_count, model.host["fiber_group"]
        fiber = model.host["segment_fiber"]
        mine = group[fiber]
        numbers = np.bincount(mine, minlength=len(model.group_rows))
        rest = [row["rest"] for row in model.group_rows]
        volume = float(np.prod(model.domain.size))
        if not any(model.domain.periodic + model.domain.wall):
            # where fibers may spread, the room they take now says nothing of a continued run
            sizes = [math.pi * row["radius"] ** 2 * row["rest"] for row in model.group_rows]
            volume = float(numbers @ sizes) / OPEN_FRACTION
        counts = piece_counts(rest, numbers.tolist(), self.reach + self.skin, volume)
        self.longest_piece = max(r / c for r, c in zip(rest, counts, strict=True))
        self.fewest_pieces = min(counts)
        each = np.asarray(counts)[mine]
        self.piece_count = int(each.sum())
        # segments of one fiber nearer than pi a along it are never a pair
        skip = [math.ceil(math.pi * row["radius"] / row["rest"]) for row in model.group_rows]

        def put(values: Any) -> Any:
            return wp.array(values, dtype=wp.int32, device=model.device)

        self.fiber_skip = put(np.asarray(skip)[group])
        nodes = np.diff(model.host["fiber_node_start"])
        ring = np.where(np.bincount(fiber, minlength=len(nodes)) == nodes, nodes, 0)
        self.fiber_ring = put(ring if len(model.segment_end) else ring[:0])
        if self.piece_count == segments:  # a piece is a segment: kernels do without these
            self.piece_segment = self.piece_part = put(np.zeros(0))
            return
        self.piece_segment = put(np.repeat(np.arange(segments), each))
        start = np.repeat(np.cumsum(each) - each, each)
        self.piece_part = put(
            np.arange(self.piece_count) - start + 65536 * np.repeat(each, each),
        )

    @property
    def cell_width(self) -> float:
        """Width that holds a segment, its reach and the skin."""
        longest = self.stretch_allowed * self.longest_rest + 2.0 * self.extension
        return longest + self.reach + self.skin + self.margin

    @property
    def margin(self) -> float:
        """What the wide list holds beyond the skin; 0 without one."""
        return self.pruning.margin if self.pruning is not None else 0.0

    def set_stretch(self, stretch: float) -> None:
        """Cells that hold segments of this many rest lengths, from the next build on."""
        self.stretch_allowed = stretch
        self._write_sizes()

    def set_skin(self, skin: float, margin: float = 0.0) -> None:
        """Another skin, and margin of the wide list, from the next build on."""
        self.skin = skin
        if self.pruning is not None:
            self.pruning.margin = margin
        self._write_sizes()

    def set_extension(self, extension: float) -> None:
        """Segments that are listed as longer by this at each end, from the next build on."""
        self.extension = extension
        self._write_sizes()

    def _write_sizes(self) -> None:
        extent, extension = self.reach + self.skin + self.margin, self.extension
        longest = self.stretch_allowed * self.longest_piece + 2.0 * extension / self.fewest_pieces
        write_array(self.sizes, np.asarray([extent, longest, extension]))
        told = np.asarray([self.reach + self.skin, self.skin, extension])
        write_array(self.skin_out, told.astype(self.model.precision.numpy))
        if self.pruning is not None:
            self.pruning.write_sizes()

    # -- arrays -----------------------------------------------------------------------------------

    def _int(self, size: int) -> Any:
        return wp.zeros(size, dtype=wp.int32, device=self.model.device)

    def _allocate_cells(self, loose: bool) -> None:
        p, device = self.model.precision, self.model.device
        segments, count = self.model.segment_count, self.piece_count
        self.stride = count + PLANE_PADDING
        self.cell_capacity = MAX_CELLS_PER_PIECE * count + 64
        self.sizes = wp.zeros(3, dtype=wp.float64, device=device)
        self.skin_out = wp.zeros(3, dtype=p.real, device=device)
        self._write_sizes()
        self.wraps = self._int(1)
        self._wraps = 0
        self.inverse = wp.zeros(1, dtype=wp.mat33d, device=device)
        self.cells = wp.zeros(1, dtype=wp.vec3i, device=device)
        self.frame = wp.zeros(21, dtype=wp.float32, device=device)
        self.cell_start = self._int(self.cell_capacity + 1)
        in_sort = 1 if self.native else 2  # a radix sort needs as much again
        self.cell_key = self._int(in_sort * count)
        self.order = self._int(in_sort * count)
        self.piece_wrap = self._int(count)
        if self.native:
            size, stored = GEOMETRY_PLANES * self.stride, wp.float32
        else:
            size, stored = 2 * count, wp.vec4f
        self.geometry = wp.zeros(size, dtype=stored, device=device)
        exact = 0 if loose else count
        self.sorted_start = wp.zeros(exact, dtype=p.vec3, device=device)
        self.sorted_axis = wp.zeros(exact, dtype=p.vec3, device=device)
        self.sorted_segment = self._int(count)
        self.sorted_wrap = self._int(count)
        self.sorted_part = self._int(len(self.piece_part))
        self.out_start = self._int(segments + 1)
        self.in_start = self._int(segments + 1)
        slides = 0 if self.slide_origin is None else segments
        self.segment_slide = wp.zeros(slides, dtype=p.real, device=device)
        self.segment_extension = wp.zeros(slides, dtype=p.real, device=device)
        self.fastest_slide = wp.zeros(1, dtype=p.real, device=device)
        self.piece_total = wp.array([count], dtype=wp.int32, device=device)
        self.tally = wp.zeros(2 * self.workers, dtype=wp.int64, device=device)
        self.found_count = self._int(self.workers)

    def _allocate_rows(self) -> None:
        """Room for what is found, before it is sorted."""
        size = 0 if self.native else self.piece_count * self.row_capacity
        self.row_count = self._int(0 if self.native else self.piece_count)
        self.row_end = self._int(0 if self.native else self.piece_count)
        self.row_i, self.row_j, self.row_image = (self._int(size) for _ in range(3))
        self._drop_executor()

    def _allocate_pairs(self) -> None:
        size = self.pair_capacity
        self.pair_i, self.pair_j, self.pair_image = (self._int(size) for _ in range(3))
        if self.native:
            # each worker writes to a part of its own, with room for an uneven share
            self.region = size if self.workers == 1 else 2 * size // self.workers + 64
            whole = self.workers * self.region
            self.row_i, self.row_j, self.row_image = (self._int(whole) for _ in range(3))
            self.pair_slot, self.in_pair = self._int(size), self._int(size)
        else:
            self.pair_key, self.pair_slot = self._int(2 * size), self._int(2 * size)
            self.in_key, self.in_pair = self._int(2 * size), self._int(2 * size)
            self.found_j, self.found_image = self._int(size), self._int(size)
        if self.pruning is not None:
            self.pruning.allocate(size)
        self._drop_executor()

    def _drop_executor(self) -> None:
        if self._executor is not None:
            self._executor.close()
            self._executor = None

    def close(self) -> None:
        """End the extra worker threads."""
        self._drop_executor()
        if self.pruning is not None:
            self.pruning.close()

    # -- reading ----------------------------------------------------------------------------------

    @property
    def pair_count(self) -> int:
        """Number of listed pairs."""
        return int(host_view(self.state.status)[PAIR_COUNT])

    @property
    def kept_count(self) -> int:
        """Number of pairs that the last search kept: those of the wide list where there is one."""
        wide = self.pruning
        return self.pair_count if wide is None else int(wide.wide_total.numpy()[0])

    def host_pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Owner, partner and image code of every listed pair, as NumPy copies."""
        n = self.pair_count
        return tuple(a.numpy()[:n].copy() for a in (self.pair_i, self.pair_j, self.pair_image))

    def search_counts(self) -> dict[str, int]:
        """What the last build looked at: midpoints in cells, pieces compared, law; native only."""
        if not self.native:
            return {}
        seen, compared = self.tally.numpy().reshape(-1, 2).sum(axis=0)
        confirmed = int(self.found_count.numpy().sum())
        return {"in_cells": int(seen), "compared": int(compared), "confirmed": confirmed}

    # -- building ---------------------------------------------------------------------------------

    def build(self, *, wrap: bool = True) -> bool:
        """Build from the current positions; True if pair arrays were replaced by larger ones.

        A segment longer than the cells hold widens them (`stretch_allowed`) before anything uses
        the list.
        """
        replaced = False
        while True:
            if self._wraps != int(wrap):
                self._wraps = int(wrap)
                self.wraps.fill_(self._wraps)
            if self._executor is None:
                launches, device = list_launches(self), self.model.device
                self._executor = Executor(
                    launches, device, self.workers, single=True, choice=self.worker_choice
                )
            self._executor.run(1, _never)
            status = host_view(self.state.status)
            overflow, stretched = int(status[OVERFLOW]), bool(status[STRETCHED])
            lost = self._lost_fiber() if overflow or stretched else None
            if overflow == 0 and (not stretched or lost is not None):
                self.build_count += 1  # a torn fiber is reported by the next step
                if self.pruning is not None:
                    self.pruning.prune()
                return replaced
            if lost is not None:
                words = status.copy()
                words[TORN], words[BAD_FIBER], words[OVERFLOW] = 1, lost, 0
                self.state.status.assign(words)
                return replaced
            self.grow_count += 1
            wrap = False  # fibers are inside the box by now
            if stretched:
                self.set_stretch(STRETCH_GROWTH * self.stretch_allowed)
                continue
            need = int(status[ROW_NEED])
            if overflow == OVERFLOW_ROW:
                self.row_capacity = max(int(1.5 * need), self.row_capacity + 1)
                self._allocate_rows()
            elif overflow == OVERFLOW_PAIRS:
                if self.native:  # as much as the fullest part needs
                    need = need * self.workers // 2 if self.workers > 1 else need
                self.pair_capacity = int(1.3 * max(int(status[PAIR_COUNT]), need)) + 64
                self._allocate_pairs()
                replaced = True

    def _lost_fiber(self) -> int | None:
        """A fiber that the last step tore or threw so far that no list can hold it."""
        model = self.model
        nodes = self.state.node_pos.numpy().astype(float)
        first = model.host["segment_node"]
        rest = np.asarray([row["rest"] for row in model.group_rows])
        rest = rest[model.host["fiber_group"][model.host["segment_fiber"]]]
        with np.errstate(over="ignore", invalid="ignore"):
            length = np.linalg.norm(nodes[model.host["segment_end"]] - nodes[first], axis=1)
            far = np.abs(nodes[first]).max(axis=1) > FARTHEST * (self.longest_rest + self.reach)
            lost = np.flatnonzero(~(length < TEAR_STRETCH * rest) | far)
        return int(model.host["segment_fiber"][lost[0]]) if len(lost) else None


def _never() -> bool:
    return False
