"""Pairs of bonded spheres that may touch: their list, what they do, and the memory of friction.

Fibers stay unwrapped, so a pair keeps its image from list to list and its memory can be found
again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.methods.pair_search import PairSearch
from warpfiber.model import Model, State
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.capsule_hits import part_count
from warpfiber.passes.contact_losses import RECORD
from warpfiber.passes.contact_memory import NEVER, launch_memories, make_carry_memory
from warpfiber.passes.pairs import PairFeatures
from warpfiber.scene import Scene


class BondedContacts:
    """Neighbor list and pair arrays of one run."""

    def __init__(
        self,
        scene: Scene,
        model: Model,
        state: State,
        workers: int,
        stretch: float,
        pair_cost: float,
        *,
        vectors: bool,
    ) -> None:
        self.model, self.state, self.vectors = model, state, vectors
        self.features = CapsuleFeatures(
            periodic=any(model.domain.periodic),
            dashpot=scene.contact.damping > 0.0,
            friction=scene.contact.friction > 0.0,
            closed=len(model.segment_end) > 0,
            recorded="energy" in scene.record.quantities,
        )
        self.measured = PairFeatures(
            repulsion=False, periodic=self.features.periodic, closed=self.features.closed
        )
        reach = 2.0 * max(row["radius"] for row in model.group_rows)
        self.search = PairSearch(
            scene,
            model,
            state,
            reach=reach,
            stretch=stretch,
            workers=workers,
            pair_cost=pair_cost,
        )
        self._allocate()

    def _allocate(self) -> None:
        p, device = self.model.precision, self.model.device
        size = self.search.list.pair_capacity
        self.acts = wp.zeros(size, dtype=wp.uint8, device=device)
        self.force = wp.zeros(size, dtype=p.vec3, device=device)
        self.arms = wp.zeros(size, dtype=p.vec4, device=device)
        recorded = RECORD * size if self.features.recorded else 0
        self.record = wp.zeros(recorded, dtype=p.vec4, device=device)
        kept = size if self.features.friction else 0
        # of even and odd steps, which a pair has beside each other where it runs in vectors
        shape = (kept, 2) if self.vectors else (2, kept)
        self.memory = wp.zeros(shape, dtype=p.vec4, device=device)
        self.written = wp.full(shape, NEVER, dtype=wp.int32, device=device)
        if self.vectors:
            self.memory, self.written = self.memory.transpose(), self.written.transpose()
        segments = self.model.segment_count
        self.kept = [wp.zeros(segments, dtype=wp.int32, device=device) for _ in range(2)]
        self.kept += [wp.zeros(size, dtype=wp.int32, device=device) for _ in range(2)]
        self.kept += [wp.zeros(size, dtype=kind, device=device) for kind in (p.vec3, p.vec4)]
        self.kept += [wp.zeros(kept, dtype=kind, device=device) for kind in (p.vec4, wp.int32)]

        if not self.vectors:
            self.allocate_scratch()

    def allocate_scratch(self) -> None:
        """What the plain sweeps hand from one to the next."""
        p, device = self.model.precision, self.model.device
        size, nodes = self.search.list.pair_capacity, self.model.node_count
        self.pair_hit = wp.zeros(size, dtype=wp.int32, device=device)  # of those that act
        # by hit, which lie beside each other
        self.moment = wp.zeros(size, dtype=p.vec3, device=device)
        self.beside = wp.zeros(2 * size, dtype=p.vec3, device=device)  # of i, of j
        self.hit_pair = wp.zeros(size, dtype=wp.int32, device=device)
        self.hit_closest = wp.zeros(size, dtype=p.vec2, device=device)
        self.hit_count = wp.zeros(part_count(size, str(device)), dtype=wp.int32, device=device)
        # pairs that act, packed by fiber: once as outgoing, once as incoming ones, and one ahead
        self.acting = wp.zeros(2 * size + 1, dtype=wp.int32, device=device)
        # of the sweep over bonds, zero between steps
        self.node_force = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.node_moment = wp.zeros(nodes, dtype=p.vec3, device=device)

    def kernels(self) -> list[Any]:
        """What a build launches."""
        return [*self.search.list.kernels.values(), *self._carrying()]

    def _carrying(self) -> Any:
        return make_carry_memory(self.model.precision.name, self.features.friction)

    def _launch(self, kernel: Any, kept: list[Any]) -> None:
        pairs, model = self.search.list, self.model
        listed = [pairs.out_start, pairs.pair_j, pairs.pair_image]
        listed += [self.acts, self.force, self.arms, self.memory, self.written]
        step, device = self.state.step, model.device
        launch_memories(kernel, model.segment_count, step, listed, kept, device)

    def build(self, step: int) -> bool:
        """Build the list now and take the memories over; True if arrays were replaced."""
        carries = self.search.list.build_count > 0
        keep, carry = self._carrying()
        kept = self.kept
        if carries:
            self._launch(keep, kept)
        replaced = self.search.refresh(step, wrap=False)
        if replaced:
            self._allocate()
        if carries:
            self._launch(carry, kept)
        else:
            self.acts.zero_()
        return replaced

    def expire(self, step: int) -> bool | None:
        """Another skin and a new list; True if arrays were replaced, None if none lasts a step."""
        return self.build(step) if self.search.use_up(step) else None

    def saved(self) -> dict[str, np.ndarray]:
        """Skin, stretch and memories by pair: what the next list depends on."""
        count = self.search.list.pair_count
        arrays = self.search.saved()
        acts = self.acts.numpy()[:count].copy()
        arrays["contact_acts"] = acts
        for name in ("force", "arms"):  # what does not act keeps stale values
            values = getattr(self, name).numpy()[:count].copy()
            values[acts == 0] = 0.0
            arrays[f"contact_{name}"] = values
        if self.features.friction:
            side = int(self.state.step.numpy()[0]) % 2
            memory = self.memory.numpy()[side, :count].copy()
            written = self.written.numpy()[side, :count].copy()
            stale = written != int(self.state.step.numpy()[0])
            memory[stale], written[stale] = 0.0, NEVER
            arrays["contact_memory"], arrays["contact_written"] = memory, written
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray], step: int) -> None:
        """Build again the list of the saved run, and give its pairs their memories."""
        self.search.restore(arrays, step)
        self._allocate()
        count = self.search.list.pair_count
        for name in ("acts", "force", "arms"):
            getattr(self, name)[:count].assign(arrays[f"contact_{name}"])
        if self.features.friction:
            side = step % 2
            self.memory[side, :count].assign(arrays["contact_memory"])
            self.written[side, :count].assign(arrays["contact_written"])
