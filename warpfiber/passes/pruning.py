"""A wide list of pairs from which the list of the next steps is pruned, several times.

The wide list holds what is within reach + skin + margin of its build. From it the pairs within
reach + skin of the present positions are kept in order, again whenever the skin is used up, for as
long as the margin lasts: sweeps look at the few pairs of a thin skin, and cells are searched as
seldom as for a thick one.

Source: dual pair list with pruning (Pall et al. 2020, J. Chem. Phys. 153, 134110); that the wide
    list still holds all of reach + skin is the skin test of `nodes.skin_limit` with the margin in
    place of the skin: 2 max|u| + (1 - sigma_min(F)) h_wide <= margin.
Symbols: F deformation since the wide list was built, u motion beside it, h_wide = reach + skin +
    margin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpfiber.model import PAIR_COUNT
from warpfiber.passes.executor import Call, Executor, Launch
from warpfiber.passes.host_arrays import host_view
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.native import PREFETCH_NODES, PREFETCH_SHARED
from warpfiber.passes.native_pairs import BLOCK
from warpfiber.passes.prune_kernels import make_native_prune, make_plain_prune, make_wide_kernels

if TYPE_CHECKING:
    from warpfiber.passes.neighbors import NeighborList


ROOM, GROWTH = 0.8, 1.3  # kept pairs per segment that plain kernels sort; more of them where short


class Pruning:
    """The wide list of a NeighborList, and what keeps the pairs of its public arrays from it.

    `margin` beyond the skin (run units) may change between builds.
    """

    def __init__(self, pairs: NeighborList, flow_origin: np.ndarray) -> None:
        model, state = pairs.model, pairs.state
        p, device = model.precision, model.device
        self.pairs, self.flow_origin = pairs, flow_origin
        self.margin = 0.0
        self.count = 0
        module = kernel_module("prune", p.name, model.domain.periodic, pairs.native)
        self.kernels = make_wide_kernels(p.name, module)
        periodic = any(model.domain.periodic)
        if pairs.native:
            self.kernels |= make_native_prune(p.name, periodic, module)
            self.kernels |= {"index_partners": pairs.kernels["index_partners"]}
        else:
            self.kernels |= make_plain_prune(p.name, periodic)
            self.kernels |= {"mark_starts": pairs.kernels["mark_starts"]}
        self.wide_sizes = wp.zeros(2, dtype=p.real, device=device)
        self.wide_pos = wp.clone(state.node_pos)
        self.wide_lattice = wp.clone(state.lattice)
        self.wide_deformation = wp.clone(state.deformation)
        self.wide_total = wp.zeros(1, dtype=wp.int32, device=device)
        self.wide_start = wp.zeros(model.segment_count + 1, dtype=wp.int32, device=device)
        self.short = wp.zeros(1, dtype=wp.int32, device=device)
        self.lattice = wp.zeros(1, dtype=p.mat33, device=device)
        self.affine = wp.zeros(1, dtype=p.mat33, device=device)
        self.limit = wp.zeros(1, dtype=p.real, device=device)
        self._executor: Executor | None = None

    def allocate(self, size: int) -> None:
        """Room for as many listed pairs."""
        device = self.pairs.model.device

        def put(count: int, kind: Any = wp.int32) -> Any:
            return wp.zeros(count, dtype=kind, device=device)

        self.wide_i, self.wide_j, self.wide_image = put(size), put(size), put(size)
        if self.pairs.native:
            self.near_bits = put(math.ceil(size / BLOCK), wp.uint64)
            self.kept = put(self.pairs.workers)
        else:
            segments = self.pairs.model.segment_count
            self.near = put(size)
            self.near_count, self.near_end = put(segments), put(segments)
            self.room = min(size, math.ceil(ROOM * segments) + 64)
        self.close()

    def close(self) -> None:
        """End the extra worker threads."""
        if self._executor is not None:
            self._executor.close()
            self._executor = None

    def write_sizes(self) -> None:
        """Tell the kernels what the next wide list holds."""
        wide = self.pairs.reach + self.pairs.skin + self.margin
        told = np.asarray([wide, self.margin])
        self.wide_sizes.assign(told.astype(self.pairs.model.precision.numpy))

    # -- what is saved ----------------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """What the next wide list, and the next pruning of this one, depend on."""
        return {
            "wide_pos": self.wide_pos.numpy().copy(),
            "wide_lattice": self.wide_lattice.numpy().copy(),
            "wide_deformation": self.wide_deformation.numpy().copy(),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Prune again as the saved run did, at the positions and the lattice of the State."""
        state = self.pairs.state
        state.deformation.assign(np.eye(3)[None])
        self.wide_deformation.assign(arrays["wide_deformation"])
        self.prune()

    # -- running ----------------------------------------------------------------------------------

    def prune(self) -> bool:
        """Keep the pairs of the present positions; False if the margin did not hold the motion.

        Then pairs may be missing, and a build is due.
        """
        pairs = self.pairs
        while True:
            if self._executor is None:
                launches, device = self._launches(), pairs.model.device
                self._executor = Executor(
                    launches, device, pairs.workers, single=True, choice=pairs.worker_choice
                )
            self._executor.run(1, _never)
            if pairs.native or pairs.pair_count <= self.room:
                break
            self.room = min(pairs.pair_capacity, math.ceil(GROWTH * pairs.pair_count))
            self.close()
        self.count += 1
        return not bool(host_view(self.short)[0])

    def begin(self) -> list[Launch | Call]:
        """Launches after those of a build."""
        state = self.pairs.state
        return [
            Launch(
                "remember_wide",
                self.kernels["remember_wide"],
                1,
                [
                    state.lattice,
                    state.status,
                    self.wide_lattice,
                    self.wide_deformation,
                    self.wide_total,
                ],
            ),
            Launch(
                "remember_nodes",
                self.kernels["remember_nodes"],
                self.pairs.model.node_count,
                [state.node_pos, self.wide_pos],
                split=True,
            ),
        ]

    def _launches(self) -> list[Launch | Call]:
        model, state = self.pairs.model, self.pairs.state
        begin = Launch(
            "begin_prune",
            self.kernels["begin_prune"],
            1,
            [
                self.wide_sizes,
                state.lattice,
                state.list_lattice,
                self.lattice,
                state.deformation,
                self.wide_deformation,
                self.affine,
                self.limit,
                self.short,
                state.status,
            ],
        )
        origin = model.precision.vec3(*self.flow_origin)
        place = [origin, self.affine, self.limit, self.wide_pos, state.node_pos, state.list_pos]
        nodes = Launch(
            "place_nodes",
            self.kernels["place_nodes"],
            model.node_count,
            [*place, self.short],
            split=True,
        )
        keep = self._native_launches() if self.pairs.native else self._plain_launches()
        return [begin, nodes, *keep]

    def _native_launches(self) -> list[Launch | Call]:
        pairs, model, state = self.pairs, self.pairs.model, self.pairs.state
        workers, wide = pairs.workers, (self.wide_i, self.wide_j, self.wide_image)
        ahead = PREFETCH_NODES if workers == 1 else PREFETCH_SHARED
        mark = [ahead, pairs.skin_out, model.segment_node, self.lattice, self.wide_total, *wide]
        keep = [model.segment_count, self.wide_total, self.near_bits, self.kept, *wide]
        listed = [pairs.pair_i, pairs.pair_j, pairs.pair_image]
        partners = [model.segment_count, state.status, pairs.pair_j, pairs.in_start, pairs.in_pair]
        total = state.status[PAIR_COUNT : PAIR_COUNT + 1]
        inputs = {
            "mark_near": [*mark, state.node_pos, self.near_bits, self.kept],
            "keep_near": [*keep, pairs.out_start, *listed, state.status],
            "index_partners": [*partners, total],
        }
        launches: list[Launch | Call] = [
            Launch(name, self.kernels[name], workers, [workers, *values], split=True)
            for name, values in inputs.items()
        ]
        launches[0].follows = True  # after what places nodes, which it does not read
        return launches

    def _plain_launches(self) -> list[Launch | Call]:
        pairs, model, state = self.pairs, self.pairs.model, self.pairs.state
        segments, room = model.segment_count, self.room
        wide = (self.wide_start, self.wide_j, self.wide_image)
        bits = max(1, math.ceil(math.log2(segments + 1)))

        def scan() -> None:
            wp.utils.array_scan(self.near_count, self.near_end, inclusive=True)

        def sort() -> None:
            wp.utils.radix_sort_pairs(pairs.in_key, pairs.in_pair, room, 0, bits)

        mark = [pairs.skin_out, model.segment_node, self.lattice, *wide, state.node_pos]
        kept = [pairs.out_start, pairs.pair_i, pairs.pair_j, pairs.pair_image]
        keep = [segments, room, self.near, self.near_end, *wide, *kept, pairs.in_key, pairs.in_pair]
        starts = [state.status, PAIR_COUNT, segments, pairs.in_key, pairs.in_start]
        kernels = self.kernels
        return [
            Launch(
                "mark_near", kernels["mark_near"], segments, [*mark, self.near, self.near_count]
            ),
            Call("scan", scan),
            Launch("keep_near", kernels["keep_near"], max(segments, room), [*keep, state.status]),
            Call("sort", sort),
            Launch("in_start", kernels["mark_starts"], room + 1, starts),
        ]


def _never() -> bool:
    return False
