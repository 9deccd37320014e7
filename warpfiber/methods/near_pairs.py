"""The near pairs of a run of bonded spheres: when they are found anew among the listed ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpfiber.methods.bonded_contacts import BondedContacts
from warpfiber.methods.bonded_launches import REACH_MARGIN
from warpfiber.passes.executor import Executor, Launch
from warpfiber.passes.native_capsules_source import PARTS, READ_AHEAD
from warpfiber.passes.near_pairs import LEAST, make_near_pairs, part_starts
from warpfiber.passes.node_blocks import NodeBlocks

if TYPE_CHECKING:
    from warpfiber.methods.bonded_spheres import BondedSpheres


class NearPairs:
    """Skins of nodes and the near pairs that go with them."""

    def __init__(
        self, spheres: BondedSpheres, contacts: BondedContacts, blocks: NodeBlocks
    ) -> None:
        self.spheres, self.contacts, self.blocks = spheres, contacts, blocks
        model = spheres.model
        p, device, nodes = model.precision, model.device, model.node_count
        self.pos = wp.zeros(nodes, dtype=wp.vec3d, device=device)
        self.skin = wp.zeros(nodes, dtype=p.real, device=device)
        self.slot = wp.array(blocks.slot, dtype=wp.int32, device=device)
        self.block_pos = blocks.zeros(3, wp.float64, device)
        self.block_skin = blocks.zeros(1, p.real, device)
        self.short = wp.zeros(2, dtype=wp.int32, device=device)
        self.count = wp.zeros(PARTS, dtype=wp.int32, device=device)
        starts = part_starts(model.segment_count)
        self.part_start = wp.array(starts, dtype=wp.int32, device=device)
        begins = np.concatenate([[True], np.diff(model.host["segment_fiber"]) != 0])
        tips = begins + 2 * np.roll(begins, -1)  # whether first, whether last of its fiber
        self.tips = wp.array(tips.astype(np.uint8), dtype=wp.uint8, device=device)
        self.found = 0  # times
        self._executors: list[Executor] = []
        self._allocate()

    def _allocate(self) -> None:
        device = self.spheres.model.device
        size = self.contacts.search.list.pair_capacity + READ_AHEAD
        self.pair = wp.zeros(size, dtype=wp.int32, device=device)
        self.i = wp.zeros(size, dtype=wp.int32, device=device)
        self.j = wp.zeros(size, dtype=wp.int32, device=device)
        self.image = wp.zeros(size, dtype=wp.int32, device=device)

    def arrays(self) -> list[Any]:
        """What the pair sweep takes."""
        return [self.part_start, self.count, self.pair, self.i, self.j, self.image]

    def launches(self) -> list[Launch]:
        """Skins of the nodes, and the pairs that they make near."""
        spheres, pairs = self.spheres, self.contacts.search.list
        model, state, p = spheres.model, spheres.state, spheres.model.precision
        skins, near = make_near_pairs(p.name, self.contacts.features)
        least = LEAST * 2.0 * self.contacts.search.radius
        inputs = [p.real(spheres.dt), p.real(least), pairs.skin_out, state.list_pos]
        inputs += [spheres.place, state.node_velocity, self.pos, self.skin]
        inputs += [self.slot, self.block_pos, self.block_skin, self.short]
        chosen = Launch("skins", skins, model.node_count, inputs, split=True)
        inputs = [p.real(REACH_MARGIN * pairs.reach), model.segment_node, self.tips]
        inputs += [state.lattice_now]
        inputs += [pairs.out_start, self.part_start, pairs.pair_i, pairs.pair_j, pairs.pair_image]
        inputs += [self.pos, self.skin, self.pair, self.i, self.j, self.image]
        inputs += [self.count]
        return [chosen, Launch("near pairs", near, PARTS, inputs, split=True)]

    def _run(self, which: int) -> None:
        if not self._executors:
            workers, device = self.spheres.workers, self.spheres.model.device
            choice = self.spheres.worker_choice
            self._executors = [
                Executor([launch], device, workers, single=True, choice=choice)
                for launch in self.launches()
            ]
        self._executors[which].run(1, _never)

    def lasts(self) -> bool:
        """Choose skins now; False if the list leaves some node too little."""
        self.short.zero_()
        self._run(0)
        return not self.short.numpy()[0]

    def lasts_a_step(self) -> bool:
        """Whether the skins that were chosen do."""
        return not self.short.numpy()[1]

    def find(self) -> None:
        """Near pairs of the skins that were chosen; the list may be a new one."""
        if self.pair.shape[0] != self.contacts.search.list.pair_capacity + READ_AHEAD:
            self.close()
            self._allocate()
        self._run(1)
        self.found += 1

    def report(self) -> dict[str, float]:
        """How many there are, and how often they were found."""
        return {"near_pairs": int(self.count.numpy().sum()), "near_builds": self.found}

    def saved(self) -> dict[str, np.ndarray]:
        """Skins, and positions when they were chosen."""
        return {"near_pos": self.pos.numpy().copy(), "near_skin": self.skin.numpy().copy()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Find the near pairs of the saved run again; its list has been restored."""
        self.close()
        if "near_pos" not in arrays:  # saved by a run without vectors
            self.lasts()
        else:
            self.pos.assign(arrays["near_pos"])
            self.skin.assign(arrays["near_skin"])
            self.blocks.fill(self.block_pos, arrays["near_pos"])
            self.blocks.fill(self.block_skin, arrays["near_skin"])
        self.find()

    def close(self) -> None:
        """Stop worker threads."""
        for executor in self._executors:
            executor.close()
        self._executors = []


def _never() -> bool:
    return False
