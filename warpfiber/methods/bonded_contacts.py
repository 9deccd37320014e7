"""Pairs of bonded spheres that may touch: their list, what they do, and the memory of friction.

Fibers stay unwrapped, so a pair keeps its image from list to list and its memory can be found
again.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.methods.skin import LEAST_SKIN, MOST_SKIN, START_SKIN, SkinChoice
from warpfiber.model import PAIR_COUNT, Model, State
from warpfiber.passes.capsule_pairs import CapsuleFeatures, carry_memories, make_carry_memory
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.pairs import PairFeatures
from warpfiber.scene import Scene

STRETCH_GROWTH = 1.2  # how much longer segments may be after they outgrew the cells of the list


class BondedContacts:
    """Neighbor list and pair arrays of one run."""

    def __init__(
        self, scene: Scene, model: Model, state: State, workers: int, stretch: float
    ) -> None:
        self.model, self.state = model, state
        contact, units = scene.contact, model.units
        self.features = CapsuleFeatures(
            periodic=any(model.domain.periodic),
            dashpot=contact.damping > 0.0,
            friction=contact.friction > 0.0,
        )
        self.measured = PairFeatures(repulsion=False, periodic=self.features.periodic)
        rows = model.group_rows
        largest = max(row["radius"] for row in rows)
        skin = START_SKIN * 2.0 * largest
        if scene.numerics.skin is not None:
            skin = scene.numerics.skin / units.length
        self.list = NeighborList(
            model,
            state,
            reach=2.0 * largest,
            skin=skin,
            longest_rest=max(row["rest"] for row in rows),
            stretch=stretch,
            workers=workers,
        )
        counts = np.bincount(model.host["fiber_group"], minlength=len(rows))
        segments = counts * np.asarray([row["segments"] for row in rows])
        periodic = [
            edge
            for edge, wraps in zip(model.domain.size, model.domain.periodic, strict=True)
            if wraps
        ]
        room = min(periodic, default=np.inf) - (self.list.cell_width - skin)
        self.skin = SkinChoice(
            skin=skin,
            start=skin,
            radius=largest,
            largest=max(skin, min(2.0 * MOST_SKIN * largest, room * (1.0 - 1e-9))),
            least=min(skin, 2.0 * LEAST_SKIN * largest),
            reach=self.list.reach,
            core=2.0 * min(row["radius"] for row in rows),
            length=float(np.average([row["rest"] for row in rows], weights=segments)),
            pieces_per_segment=self.list.piece_count / model.segment_count,
            fixed=scene.numerics.skin is not None,
        )
        self.seconds = 0.0
        self._allocate()

    def _allocate(self) -> None:
        p, device, size = self.model.precision, self.model.device, self.list.pair_capacity
        self.acts = wp.zeros(size, dtype=wp.uint8, device=device)
        self.force = wp.zeros(size, dtype=p.vec3, device=device)
        self.moment = wp.zeros(size, dtype=p.vec3, device=device)
        self.arms = wp.zeros(size, dtype=p.vec4, device=device)
        kept = size if self.features.friction else 0
        self.memory = wp.zeros(kept, dtype=p.vec3, device=device)
        self.stiffness = wp.zeros(kept, dtype=p.real, device=device)

    def kernels(self) -> list[Any]:
        """What a build launches."""
        return [*self.list.kernels.values(), make_carry_memory(self.model.precision.name)]

    def build(self, step: int) -> bool:
        """Build the list now and take the memories over; True if arrays were replaced."""
        begin = time.perf_counter()
        pairs = self.list
        carries = self.features.friction and pairs.build_count > 0
        before = [pairs.out_start, pairs.pair_j, pairs.pair_image]
        before += [self.acts, self.memory, self.stiffness]
        if carries:
            before = [wp.clone(array) for array in before]
        replaced = pairs.build(wrap=False)
        if replaced:
            self._allocate()
        if carries:
            after = [pairs.out_start, pairs.pair_j, pairs.pair_image]
            after += [self.acts, self.memory, self.stiffness]
            model = self.model
            carry_memories(model.precision.name, model.segment_count, before, after, model.device)
        else:
            self.acts.zero_()
        self.skin.built(step)
        self.seconds += time.perf_counter() - begin
        return replaced

    def expire(self, step: int, stretched: bool) -> bool:
        """Another skin, or wider cells, and a new list; True if arrays were replaced."""
        if stretched:
            self.list.set_stretch(STRETCH_GROWTH * self.list.stretch_allowed)
            self.state.status.zero_()
        else:
            listed = float(self.state.status.numpy()[PAIR_COUNT]) / self.model.segment_count
            self._set_skin(self.skin.choose(step, listed))
        return self.build(step)

    def _set_skin(self, skin: float) -> None:
        self.skin.set_skin(skin)
        if skin != self.list.skin:
            self.list.set_skin(skin)

    def saved(self) -> dict[str, np.ndarray]:
        """Skin, stretch and memories by pair: what the next list depends on."""
        count = self.list.pair_count
        arrays = {
            "stretch_allowed": np.asarray(self.list.stretch_allowed),
            "skin": self.skin.saved(),
            "contact_acts": self.acts.numpy()[:count].copy(),
        }
        if self.features.friction:
            arrays["contact_memory"] = self.memory.numpy()[:count].copy()
            arrays["contact_stiffness"] = self.stiffness.numpy()[:count].copy()
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray], step: int) -> None:
        """Build again the list of the saved run from its positions (in `list_pos`)."""
        state, pairs = self.state, self.list
        pairs.set_stretch(float(arrays["stretch_allowed"]))
        self._set_skin(float(arrays["skin"][0]))
        self.skin.begun = step
        state.node_pos.assign(arrays["list_pos"])
        pairs.build(wrap=False)
        self._allocate()
        count = pairs.pair_count
        self.acts[:count].assign(arrays["contact_acts"])
        if self.features.friction:
            self.memory[:count].assign(arrays["contact_memory"])
            self.stiffness[:count].assign(arrays["contact_stiffness"])
        self.skin.built(step)
        self.skin.restore(arrays["skin"])
        state.node_pos.assign(arrays["node_pos"])
