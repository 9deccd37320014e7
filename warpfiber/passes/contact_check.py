"""Check of a step with contact: does its end overlap or cross, and does the list still hold.

Source: see `check_sweeps` and `list_bound`.
Symbols: run units; overlap in radii of the thinner fiber.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import Model, State
from warpfiber.passes.array_rows import wall_arrays
from warpfiber.passes.check_sweeps import CheckFeatures, make_check_sweeps
from warpfiber.passes.contact_rows import ContactRows
from warpfiber.passes.contact_verdict import make_contact_verdict
from warpfiber.passes.executor import Call, Launch
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.list_bound import make_list_bound
from warpfiber.passes.native_check import make_native_check
from warpfiber.passes.native_strays import LANES, PLANES, make_native_strays, most_strays
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.pair_motion import native_chunks
from warpfiber.passes.unilateral import ContactDual

CHUNKS = 128


class ContactCheck:
    """What a step did: read `largest`, `found` and `list_short` after the launches.

    `largest` (1) float64: largest overlap at the end of the step, radii (0: none); 1e30 where a
    position is not finite, with `tears` where a segment is longer than it may be. `found` (5)
    int32: how many pairs passed through each other and nodes through walls; segment and partner of
    the largest overlap; segment and partner of a crossing (-1: none, as a partner a wall).
    `list_short` (1) int32: 1 if the list may miss a pair that is within its reach where the step
    would end; `list_use` (1) vec3: see `list_bound`.
    `renews`: the second of two solves is looked at by `launches_again`, where it moved anything.
    `recalls`: the rows are made for where the step would end, which the list is asked for.
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
        fiber_frozen: Any = None,
        solves: Sequence[tuple[ContactRows, ContactDual]] = (),
        tears: bool = False,
        renews: bool = False,
        recalls: bool = False,
    ) -> None:
        self.model, self.state, self.pairs = model, state, pairs
        self.solves, self.renews = solves, renews
        self.node_back = node_back
        self.lattice_back, self.lattice_now = lattice_back, lattice_now
        domain, name = model.domain, model.precision.name
        none = wp.zeros(0, dtype=wp.uint8, device=model.device)
        self.fiber_frozen = none if fiber_frozen is None else fiber_frozen
        reals = partial(wp.zeros, dtype=model.precision.real, device=model.device)
        self.no_shift = reals(model.segment_count if len(solves) < 2 else 0)
        # rows that are made for another motion learn nothing of this one
        told = solves[0][0] if recalls else None
        self.segment_moved = told.segment_moved if told else reals(model.segment_count)
        self.step_strain = told.step_strain if told else reals(1)
        self.pairs_known = told.pairs_known if told else self._int(1)
        features = CheckFeatures(
            any(domain.periodic),
            domain.wall,
            frozen=fiber_frozen is not None,
            shifted=len(solves) > 0,
            again=len(solves) > 1 and not renews,
            arrays=bool(domain.arrays),
            tears=tears,
        )
        self.native = model.device.startswith("cpu")
        radii = {row["radius"] for row in model.group_rows}
        # what is held needs the law of pairs for itself
        picked = self.native and len(radii) == 1 and fiber_frozen is None
        self.features = features = dataclasses.replace(features, picked=picked)
        module = kernel_module("check", name, features)
        self.kernels = dict(make_check_sweeps(name, features, module))
        if picked:
            known = features.periodic, features.shifted, features.again
            self.kernels["check_pairs"] = make_native_check(name, *known, module)
        self.segment_look = wp.zeros(
            model.segment_count if picked else 0, dtype=wp.uint8, device=model.device
        )
        if renews:
            second = dataclasses.replace(features, again=True, renewed=True, picked=False)
            renewed = make_check_sweeps(name, second, kernel_module("check", name, second))
            self.kernels["check_again"] = renewed["check_segments"]
            self.kernels["reduce_again"] = renewed["reduce_check"]
        self.kernels |= make_list_bound(name, module, self.native)
        # segments off their lines that the list may still hold
        self.strays = most_strays(model.segment_count) if self.native else 0
        if self.strays > 0:
            self.kernels["bound_list"] = make_native_strays(name, module)
        planes = PLANES * (model.segment_count + LANES) if self.strays else 0
        self.stray_planes = wp.zeros(planes, dtype=wp.float32, device=model.device)
        self.kernels |= make_contact_verdict(module)
        segments = model.segment_count
        self.overlap = wp.zeros(segments, dtype=model.precision.real, device=model.device)
        self.overlap_partner, self.crossed = self._int(segments), self._int(segments)
        self.crossed_partner = self._int(segments)
        chunks = min(CHUNKS, segments)
        self.overlap_at, self.crossed_of = self._int(chunks), self._int(chunks)
        self.crossed_at = self._int(chunks)
        self.largest = wp.zeros(1, dtype=wp.float64, device=model.device)
        self.found = self._int(5)
        # by runs of segments or by fibers
        bounded = native_chunks(segments) if self.native else model.fiber_count
        self.part_short = wp.zeros(bounded, dtype=wp.int64, device=model.device)
        self.list_short = self._int(1)
        vec3, device = model.precision.vec3, model.device
        self.part_use = wp.zeros(bounded, dtype=vec3, device=device)
        self.list_use = wp.zeros(1, dtype=vec3, device=device)
        self.part_share = wp.zeros(bounded, dtype=model.precision.real, device=device)
        self.list_share = wp.zeros(1, dtype=model.precision.real, device=device)
        self.share_back = wp.zeros(1, dtype=model.precision.real, device=device)

    def _int(self, size: int) -> Any:
        return wp.zeros(size, dtype=wp.int32, device=self.model.device)

    def launches(self) -> list[Launch | Call]:
        """Overlaps and crossings at the end of the step; anew after the list grew."""
        return self._sweep("check_segments")

    def launches_again(self) -> list[Launch | Call]:
        """The same after the second solve, where the first has been looked at."""
        return self._sweep("check_again")

    def _sweep(self, name: str) -> list[Launch | Call]:
        model, state, pairs = self.model, self.state, self.pairs
        p, domain = model.precision, model.domain
        low = np.asarray(domain.low)
        widest = max(row["radius"] for row in model.group_rows)
        segments = [
            p.real(widest),
            p.vec3(*low),
            p.vec3(*(low + np.asarray(domain.size))),
            wall_arrays(model),
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            model.segment_node,
            model.segment_fiber,
            self.fiber_frozen,
            pairs.out_start,
            pairs.pair_j,
            pairs.pair_image,
            self.lattice_back,
            self.lattice_now,
            self.node_back,
            state.node_pos,
            self.solves[0][0].pair_clear if self.solves else self.overlap,
            *self._shifts(),
            self.solves[1][0].row_count if self.renews else self.found,
            self.segment_look,
            state.status,
            self.overlap,
            self.overlap_partner,
            self.crossed,
            self.crossed_partner,
        ]
        chunks = self.overlap_at.shape[0]
        reduced = [self.overlap_at, self.crossed_of, self.crossed_at]
        reduce = "reduce_again" if name == "check_again" else "reduce_check"
        moved = self.solves[1][0].row_count if self.renews else self.found
        finish = [self.overlap, self.overlap_partner, self.crossed_partner, *reduced]
        return [
            *([] if name == "check_again" else self._pairs(widest)),
            self._launch(name, model.segment_count, segments, split=True),
            self._launch(
                reduce,
                chunks,
                [chunks, self.overlap, self.crossed, moved, state.status, *reduced],
            ),
            self._launch("finish_check", 1, [*finish, state.status, self.largest, self.found]),
        ]

    def _pairs(self, radius: float) -> list[Launch | Call]:
        """Overlaps of pairs in vectors, where these can tell them."""
        if "check_pairs" not in self.kernels:
            return []
        model, state, pairs = self.model, self.state, self.pairs
        inputs = [
            model.precision.real(radius),
            model.segment_node,
            pairs.out_start,
            pairs.pair_i,
            pairs.pair_j,
            pairs.pair_image,
            self.lattice_back,
            self.lattice_now,
            self.node_back,
            state.node_pos,
            self.solves[0][0].pair_clear if self.solves else self.overlap,
            *self._shifts(),
            state.status,
            self.overlap,
            self.overlap_partner,
            self.crossed,
            self.crossed_partner,
            self.segment_look,
        ]
        return [self._launch("check_pairs", native_chunks(model.segment_count), inputs, split=True)]

    def _shifts(self) -> list[Any]:
        """How far both solves moved each segment at most."""
        shifts = [dual.segment_shift for _, dual in self.solves]
        return (shifts + 2 * [self.no_shift])[:2]

    def list_launches(
        self, node_pos: Any, deformation: Any, flow_origin: np.ndarray
    ) -> list[Launch | Call]:
        """Whether the list holds for `node_pos`, its flow since the build being `deformation`."""
        model, state = self.model, self.state
        bound = [
            model.precision.vec3(*flow_origin),
            model.segment_count,
            self.strays,
            model.segment_node,
            self.pairs.skin_out,
            self.pairs.segment_extension,
            model.fiber_node_start,
            state.deformation,
            deformation,
            state.list_pos,
            self.node_back,
            node_pos,
            *self._shifts(),
            state.status,
            self.pairs_known,
            self.step_strain,
            self.segment_moved,
            self.part_short,
            self.part_use,
            self.part_share,
        ]
        reduced = [self.part_short, self.part_use, self.part_share, state.status]
        if self.strays > 0:
            reduced = self._strays(node_pos)
        reduced += [self.list_short, self.list_use, self.list_share]
        return [
            self._launch("bound_fibers", self.part_short.shape[0], bound, split=True),
            self._launch("bound_list", 1, reduced),
        ]

    def _strays(self, node_pos: Any) -> list[Any]:
        model, pairs = self.model, self.pairs
        return [
            self.strays,
            pairs.skin_out,
            wp.vec3i(*(int(wraps) for wraps in model.domain.periodic)),
            model.segment_node,
            model.segment_fiber,
            pairs.fiber_skip,
            pairs.out_start,
            pairs.pair_j,
            pairs.pair_image,
            self.lattice_now,
            node_pos,
            self.part_short,
            self.part_use,
            self.state.status,
            self.stray_planes,
        ]

    def foresee(self, rejected: Any) -> Launch:
        """After the end of a step: whether the list would not last the next."""
        inputs = [rejected, self.list_share, self.state.status, self.share_back, self.pairs_known]
        return self._launch("foresee_list", 1, inputs)

    def _launch(self, name: str, dim: int, inputs: list[Any], split: bool = False) -> Launch:
        return Launch(name, self.kernels[name], dim, inputs, split=split)
