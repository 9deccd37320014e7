"""Rows of contact of one step, on the device: pairs of segments, plane walls, lubricated beads.

A step makes them anew from the neighbor list: carry the last forces, count, running sum, fill. The
rows of a segment are next to each other, in the order of its pairs, then those of walls. Too many
rows for the capacity are none at all, and the need is told; after `grow` the step is repeated.

Source: see `row_geometry`, `row_count`, `row_fill`.
Symbols: run units; force f constant over the step, along the normal on j, against it on i.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.laws.lubrication import OUTER
from warpfiber.model import Model, State
from warpfiber.passes.array_rows import wall_arrays
from warpfiber.passes.executor import Call, Launch
from warpfiber.passes.host_arrays import host_view
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.native_row_fill import fill_pairs, make_native_row_fill
from warpfiber.passes.native_row_slots import ALONE, FIRST, LAST
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.pair_motion import CHUNK_SEGMENTS, make_pair_motion, native_chunks
from warpfiber.passes.row_count import RowFeatures, make_row_count
from warpfiber.passes.row_fill import KEY_IMAGE, make_row_fill
from warpfiber.passes.row_slip import Friction, RowSlip, make_row_slip

KEEP = 0.5  # radii of the thinner fiber: rows with a smaller predicted gap, unless told otherwise
NEVER = -1e20  # radii: no gap is that small
GROWTH = 1.3
SPARE_ROWS = 20_000  # at first, beside one per segment: launches are captured anew when rows grow
FAR = 1e30  # run units: motion of which nothing is known


class ContactRows:
    """Rows of the step under way; `launches` of a step, `grow` where `row_need` asks for it.

    Rows (capacity): `row_i`, `row_j`, `row_s`, `row_t`, `row_normal`, `row_base`,
    `row_compliance`, `row_force`, with friction those of `rub`; those of segment i are
    `row_out_start[i:i+2]`, those of listed pair k the `pair_row_count[k]` from `pair_row[k]` on,
    `pair_clear` what its center lines surely stay apart without contact; `row_count` (1) in all,
    `row_need` (1) is 0 unless they do not fit.
    `node_foreseen`: where the step is thought to end, which decides on the rows that are made;
    where it would end without them unless given. Free ends with a gap below `near_now` at the
    start have rows whatever is foreseen, places inside a fiber below half of it.
    `chosen` (S) uint8: rows of these segments alone; which of their pairs to look at is in
    `pair_slots` by then.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        pairs: NeighborList,
        *,
        node_back: Any,
        lattice_back: Any,
        lattice_now: Any,
        step_size: Any,
        node_foreseen: Any = None,
        keep: float = KEEP,
        near_now: float = NEVER,
        lubrication: str = "none",
        chosen: Any = None,
        friction: Friction | None = None,
        capacity: int | None = None,
    ) -> None:
        self.model, self.state, self.pairs = model, state, pairs
        self.node_back, self.step_size = node_back, step_size
        self.lattice_back, self.lattice_now = lattice_back, lattice_now
        self.foresees = node_foreseen is not None
        self.node_foreseen = node_foreseen if self.foresees else state.node_pos
        self.keep, self.near_now = keep, near_now
        domain = model.domain
        native = model.device.startswith("cpu")
        radii = {row["radius"] for row in model.group_rows}
        self.features = RowFeatures(
            any(domain.periodic),
            domain.wall,
            lubrication,
            bool(domain.arrays),
            chosen is not None,
            filled=native and len(radii) == 1 and lubrication == "none",
        )
        self.chosen = wp.zeros(0, dtype=wp.uint8, device=model.device) if chosen is None else chosen
        name, features = model.precision.name, self.features
        module = kernel_module("rows", name, features)
        self.kernels = dict(make_row_count(name, features, module))
        self.kernels["pair_motion"] = make_pair_motion(name, features.periodic, module, native)
        self.motion_dim = native_chunks(model.segment_count) if native else model.segment_count
        self.kernels["fill_rows"] = make_row_fill(name, features, module)
        if features.filled:
            fill = make_native_row_fill(name, features.periodic, KEY_IMAGE, module)
            self.kernels["fill_pairs"] = fill
        self.rub: RowSlip | None = None
        if friction is not None:
            held = friction.fiber_frozen is not None
            slip = kernel_module("slip", name, features.periodic, held)
            self.kernels |= make_row_slip(name, features.periodic, held, slip)
            self.rub = RowSlip(model, friction)
        segments = model.segment_count
        self.row_out_start = self._int(segments + 1)
        self.carried_start = self._int(segments + 1)
        self.segment_rows = self._int(segments)
        # segments of which pairs are left to be decided
        self.segment_look = wp.zeros(segments, dtype=wp.uint8, device=model.device)
        self.row_count, self.row_need = self._int(1), self._int(1)
        # whether `pair_clear` is that of the last step, and what the next may take off it
        self.pairs_known = self._int(1)
        real = model.precision.real
        self.step_strain = wp.zeros(1, dtype=real, device=model.device)
        self.segment_moved = wp.full(segments, real(FAR), dtype=real, device=model.device)
        fiber = model.host["segment_fiber"]
        joined = np.concatenate([[False], fiber[1:] == fiber[:-1], [False]])
        self.alone = not joined.any()  # every segment is a fiber
        ends = FIRST * ~joined[:-1] + LAST * ~joined[1:]
        self.segment_ends = wp.array(ends, dtype=wp.uint8, device=model.device)
        self._allocate_rows(capacity or max(64, segments + min(segments, SPARE_ROWS)))
        self._fit_pairs()

    # -- arrays -----------------------------------------------------------------------------------

    def _int(self, size: int) -> Any:
        return wp.zeros(size, dtype=wp.int32, device=self.model.device)

    def _allocate_rows(self, capacity: int) -> None:
        p, device = self.model.precision, self.model.device

        def reals() -> Any:
            return wp.zeros(capacity, dtype=p.real, device=device)

        self.capacity = capacity
        self.row_i, self.row_j = self._int(capacity), self._int(capacity)
        self.row_key, self.carried_j = self._int(capacity), self._int(capacity)
        self.carried_key = self._int(capacity)
        self.row_s, self.row_t, self.row_base = reals(), reals(), reals()
        self.row_compliance, self.row_force, self.carried_force = reals(), reals(), reals()
        self.row_normal = wp.zeros(capacity, dtype=p.vec3, device=device)
        if self.rub is not None:
            self.rub.allocate(capacity)

    def _fit_pairs(self) -> None:
        """Room for as many pairs as the list may hold."""
        self.pair_capacity = self.pairs.pair_capacity
        self.pair_row = self._int(self.pair_capacity)
        self.pair_row_count = self._int(self.pair_capacity)
        real = self.model.precision.real
        device = self.model.device
        self.pair_clear = wp.zeros(self.pair_capacity, dtype=real, device=device)
        self.pair_seen: Any = None  # the same of the foreseen motion, where it is another
        if self.foresees:
            self.pair_seen = wp.zeros(self.pair_capacity, dtype=real, device=device)
        self.pair_slots = wp.zeros(self.pair_capacity, dtype=wp.uint8, device=self.model.device)

    def grow(self) -> bool:
        """More room if the last step did not fit; then its launches are to be made again."""
        need = int(host_view(self.row_need)[0])
        if need == 0:
            return False
        kept = self._carried()
        self._allocate_rows(max(int(GROWTH * need), self.capacity + 1))
        self._put(kept)
        self.row_need.zero_()
        return True

    # -- the step ---------------------------------------------------------------------------------

    def launches(self) -> list[Launch | Call]:
        """Rows at the start of the step, `state.node_pos` being where it would end without them.

        To be asked for again after the list or the rows grew.
        """
        if self.pair_capacity != self.pairs.pair_capacity:
            self._fit_pairs()
        segments = self.model.segment_count

        def scan() -> None:
            wp.utils.array_scan(self.segment_rows, self.row_out_start[1:], inclusive=True)

        limit = [
            segments,
            self.capacity,
            self.row_out_start,
            self.state.status,
            self.row_count,
            self.row_need,
            self.pairs_known,
        ]
        rub = self.rub
        return [
            self._carry(),
            *([rub.carry(self.kernels, self)] if rub is not None else []),
            *([] if self.features.chosen else [self._motion(self.state.node_pos, self.pair_clear)]),
            # chooses the rows anew
            *([self._motion(self.node_foreseen, self.pair_seen)] if self.foresees else []),
            self._launch("count_rows", self._count_inputs()),
            Call("row_scan", scan),
            Launch("limit_rows", self.kernels["limit_rows"], 1, limit),
            *(fill_pairs(self) if self.features.filled else []),
            self._launch("fill_rows", self._fill_inputs()),
            *(rub.fill(self.kernels, self) if rub is not None else []),
        ]

    def _launch(self, name: str, inputs: list[Any], follows: bool = False) -> Launch:
        dim = self.model.segment_count
        return Launch(name, self.kernels[name], dim, inputs, split=True, follows=follows)

    def _motion(self, node_pos: Any, pair_clear: Any) -> Launch:
        model, pairs = self.model, self.pairs
        inputs = [
            model.segment_count,
            model.segment_node,
            pairs.out_start,
            pairs.pair_i,
            pairs.pair_j,
            pairs.pair_image,
            self.lattice_back,
            self.lattice_now,
            self.node_back,
            node_pos,
            self.state.status,
            *self._looks(),
            model.segment_fiber,
            self.segment_ends,
            self.pairs_known,
            self.step_strain,
            self.segment_moved,
            pair_clear,
            self.pair_slots,
            self.pair_row_count,
            self.segment_rows,
            self.segment_look,
        ]
        kernel = self.kernels["pair_motion"]
        return Launch("pair_motion", kernel, self.motion_dim, inputs, split=True, follows=True)

    def _looks(self) -> list[Any]:
        """From where on pairs are looked at, and whether radii are all the same."""
        real, radii = self.model.precision.real, [row["radius"] for row in self.model.group_rows]
        widest = max(radii)
        wet = 0.0 if self.features.lubrication == "none" else 2.0 * OUTER * widest
        looked_at = max((2.0 + max(self.keep, self.near_now)) * widest, wet)
        settles = min(radii) == widest and self.near_now <= NEVER and wet == 0.0
        sizes = [widest, self.keep, self.near_now, looked_at, wet]
        alone = ALONE if settles and self.alone else int(settles)
        return [*(real(size) for size in sizes), alone]

    def _carry(self) -> Launch:
        segments, native = self.model.segment_count, self.model.device.startswith("cpu")
        inputs = [
            CHUNK_SEGMENTS if native else 1,
            self.row_out_start,
            self.row_j,
            self.row_key,
            self.row_force,
            self.state.status,
            self.carried_start,
            self.carried_j,
            self.carried_key,
            self.carried_force,
        ]
        runs = native_chunks(segments) if native else segments
        return Launch("carry_rows", self.kernels["carry_rows"], runs, inputs, split=True)

    def _walls(self) -> list[Any]:
        vec3, domain = self.model.precision.vec3, self.model.domain
        low = np.asarray(domain.low)
        return [vec3(*low), vec3(*(low + np.asarray(domain.size))), wall_arrays(self.model)]

    def _fibers(self) -> list[Any]:
        model, pairs = self.model, self.pairs
        return [
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            model.segment_node,
            model.segment_fiber,
            pairs.out_start,
            pairs.pair_j,
            pairs.pair_image,
            self.lattice_back,
            self.lattice_now,
        ]

    def _count_inputs(self) -> list[Any]:
        real = self.model.precision.real
        widest = max(row["radius"] for row in self.model.group_rows)
        return [
            real(self.keep),
            real(self.near_now),
            real(widest),
            *self._walls(),
            *self._fibers(),
            self.node_back,
            self.node_foreseen,
            self.state.status,
            self.chosen,
            self.segment_look,
            self.pair_slots,
            self.pair_row_count,
            self.segment_rows,
        ]

    def _fill_inputs(self) -> list[Any]:
        state = self.state
        return [
            self.model.precision.real(self.keep),
            self.model.precision.real(self.near_now),
            *self._walls(),
            *self._fibers(),
            state.fiber_image,
            self.node_back,
            state.node_pos,
            self.node_foreseen,
            self.step_size,
            self.carried_start,
            self.carried_j,
            self.carried_key,
            self.carried_force,
            self.row_need,
            self.pair_slots,
            self.pair_row_count,
            state.status,
            self.row_out_start,
            self.pair_row,
            *self.written(),
        ]

    def written(self) -> list[Any]:
        """The arrays of the rows, as they are filled."""
        names = "i j key s t normal base compliance force".split()
        return [getattr(self, f"row_{name}") for name in names]

    # -- what is saved ----------------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """Forces of the last rows, by segment, partner and key: where the next step starts."""
        rows = int(self.row_out_start.numpy()[-1])
        return {
            "row_out_start": self.row_out_start.numpy().copy(),
            "row_j": self.row_j.numpy()[:rows].copy(),
            "row_key": self.row_key.numpy()[:rows].copy(),
            "row_force": self.row_force.numpy()[:rows].copy(),
            **({} if self.rub is None else {"friction": self.rub.force.numpy()[:rows].copy()}),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        rows = len(arrays["row_j"])
        if rows > self.capacity:
            self._allocate_rows(int(GROWTH * rows))
        self._put(arrays)

    def _carried(self) -> dict[str, np.ndarray]:
        start = self.carried_start.numpy().copy()
        rows = int(start[-1])
        return {
            "row_out_start": start,
            "row_j": self.carried_j.numpy()[:rows].copy(),
            "row_key": self.carried_key.numpy()[:rows].copy(),
            "row_force": self.carried_force.numpy()[:rows].copy(),
            **({} if self.rub is None else {"friction": self.rub.carried.numpy()[:rows].copy()}),
        }

    def _put(self, arrays: Mapping[str, np.ndarray]) -> None:
        start = np.asarray(arrays["row_out_start"])
        self.row_out_start.assign(start)
        # a step that is halted before its count still takes the running sum
        self.segment_rows.assign(np.diff(start))
        for key in ("row_j", "row_key", "row_force"):
            values = np.asarray(arrays[key])
            array = getattr(self, key)
            whole = np.zeros(self.capacity, dtype=array.numpy().dtype)
            whole[: len(values)] = values
            array.assign(whole)
        if self.rub is not None:
            self.rub.put(np.asarray(arrays["friction"]))
