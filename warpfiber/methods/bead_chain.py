"""Explicit bead chain of Sasayama & Inagaki 2018, Eq. (16); N_R = 0 is their SBCM.

A step: clock (time, flow, lattice), pair sweep (repulsion, lubrication), node sweep (gather, drag,
stretching, bending, hydrodynamic torque, closure; velocity first, with the drag at the middle of
the step, then position).
Limits: first order in dt (torque, first half step); dt below `stability.step_limits`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.laws.lubrication import OUTER
from warpfiber.laws.repulsion import RANGE
from warpfiber.methods.box_limits import bearable_strain, lasting_height
from warpfiber.methods.method import Method
from warpfiber.methods.skin import LEAST_SKIN, MOST_SKIN, START_SKIN, SkinChoice
from warpfiber.methods.step_launches import step_launches
from warpfiber.model import EXPIRED, PAIR_COUNT, TORN, Model, State
from warpfiber.passes.executor import Call, Launch, Repeat
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.pairs import PairFeatures
from warpfiber.scene import Scene

NATIVE = True  # vectorized sweeps on the CPU; False runs there what CUDA runs


def contact_reach(scene: Scene) -> float:
    """Largest distance of center lines that interact, in sums of radii; 0 without pairs."""
    if scene.contact.lubrication != "none":
        return OUTER
    return RANGE if scene.contact.law != "none" else 0.0


class BeadChain(Method):
    """Advances a State by the explicit bead chain."""

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        super().__init__(scene, model, state, dt, workers)
        self.native = NATIVE and model.device.startswith("cpu")
        self.native_nodes = self.native  # where it applies; both are read by `prepare`
        units, contact, domain = model.units, scene.contact, model.domain
        self.strength = (contact.strength or 0.0) / units.force
        self.decay = contact.decay or 0.0
        self.has_pairs = contact_reach(scene) > 0.0 and model.segment_count > 1
        self.pair_features = PairFeatures(
            repulsion=contact.law != "none",
            lubrication=contact.lubrication,
            periodic=any(domain.periodic),
            sheared=domain.sheared,
        )
        if self.has_pairs:
            largest = max(row["radius"] for row in model.group_rows)
            longest = max(row["rest"] for row in model.group_rows)
            skin = START_SKIN * 2.0 * largest
            if scene.numerics.skin is not None:
                skin = scene.numerics.skin / units.length
            self.list = NeighborList(
                model,
                state,
                reach=contact_reach(scene) * 2.0 * largest,
                skin=skin,
                longest_rest=longest,
                stretch=float(self._segment_stretch().max()),
                workers=self.workers,
                native=self.native,
            )
            self.skin = self._skin_choice(skin, largest)
            self.check_box()
        self._allocate_pair_results()

    def launches(self) -> list[Launch | Call | Repeat]:
        """Clock, pairs and nodes."""
        return [*step_launches(self)]

    def _skin_choice(self, skin: float, largest: float) -> SkinChoice:
        """The start skin, and between what it may change."""
        assert self.list is not None
        rows, pairs = self.model.group_rows, self.list
        counts = np.bincount(self.model.host["fiber_group"], minlength=len(rows))
        segments = counts * np.asarray([row["segments"] for row in rows])
        return SkinChoice(
            skin=skin,
            start=skin,
            radius=largest,
            largest=self._largest_skin(skin, largest),
            least=min(skin, 2.0 * LEAST_SKIN * largest),
            reach=pairs.reach,
            core=2.0 * min(row["radius"] for row in rows),
            length=float(np.average([row["rest"] for row in rows], weights=segments)),
            pieces_per_segment=pairs.piece_count / self.model.segment_count,
            fixed=self.scene.numerics.skin is not None,
        )

    def _largest_skin(self, start: float, radius: float) -> float:
        """What a lasting box has room for; a box that is flattened keeps the start skin."""
        assert self.list is not None
        room = lasting_height(self.scene) / self.model.units.length
        room -= self.list.cell_width - self.list.skin
        return max(start, min(2.0 * MOST_SKIN * radius, room * (1.0 - 1e-9)))

    def check_box(self) -> None:
        """Find the strain the box can bear; raises SceneError if it is too small from the start."""
        self.strain_end = bearable_strain(self.scene, self.box_width * self.model.units.length)

    @property
    def box_width(self) -> float:
        """Smallest height that a periodic box may have, run units.

        With the start skin: a run and its continuation have chosen others when they ask.
        """
        if self.list is None or self.skin is None:
            return 0.0
        return self.list.cell_width - self.list.skin + self.skin.start

    def _allocate_pair_results(self) -> None:
        p, device = self.model.precision, self.model.device
        size = self.list.pair_capacity if self.list else 0
        arms = size if self.pair_features.storage == "arms" else 0
        self.pair_acts = wp.zeros(size, dtype=wp.uint8, device=device)
        self.pair_force = wp.zeros(size, dtype=p.vec3, device=device)
        self.pair_closest = wp.zeros(size - arms, dtype=p.vec2, device=device)
        self.pair_arm_i = wp.zeros(arms, dtype=p.vec3, device=device)
        self.pair_arm_j = wp.zeros(arms, dtype=p.vec3, device=device)

    # -- the step ---------------------------------------------------------------------------------

    def set_stretch(self, stretch: float) -> None:
        """Take over the stretch that cells must hold; the next list uses it."""
        pairs, choice = self.list, self.skin
        assert pairs is not None and choice is not None
        pairs.set_stretch(stretch)
        choice.largest = self._largest_skin(choice.start, choice.radius)
        self.set_skin(min(choice.skin, choice.largest))
        self.check_box()

    def set_skin(self, skin: float) -> None:
        """Take over a skin; the next list and step use it."""
        assert self.list is not None and self.skin is not None
        self.skin.set_skin(skin)
        if skin != self.list.skin:
            self.list.set_skin(skin)

    def refresh_list(self, *, wrap: bool = True) -> None:
        """Build the neighbor list now (also clears its expiry)."""
        if self.list is None:
            return
        pairs = self.list
        begin, allowed, skin = time.perf_counter(), pairs.stretch_allowed, pairs.skin
        replaced = pairs.build(wrap=wrap)
        if pairs.stretch_allowed > allowed:  # wider cells may leave less room for the skin
            self.set_stretch(pairs.stretch_allowed)
            if pairs.skin < skin:
                replaced |= pairs.build(wrap=False)
        self.list_seconds += time.perf_counter() - begin
        assert self.skin is not None
        self.skin.built(self.step_count)
        if replaced:
            self._allocate_pair_results()
            self._stop_executor()

    def list_report(self) -> dict[str, float]:
        """Skins in largest diameters, builds and what they looked at; nothing without a list."""
        pairs, choice = self.list, self.skin
        if pairs is None or choice is None:
            return {}
        diameter, step = 2.0 * choice.radius, self.step_count
        report: dict[str, float] = {
            "skin_diameters": round(choice.skin / diameter, 4),
            "skin_mean_diameters": round(choice.mean(step) / diameter, 4),
            "builds": pairs.build_count,
            "growths": pairs.grow_count,
            "steps_per_build": round(choice.steps_counted(step) / max(1, pairs.build_count), 2),
            "pairs": pairs.pair_count,
            "pieces": pairs.piece_count,
        }
        return report | pairs.search_counts()

    def prepare(self, measuring: Iterable[Any] = ()) -> None:
        """Compile, build the first list and capture, so that the next `advance` only steps.

        `measuring`: further kernels of the run, compiled along with these.
        """
        listing = self.list.kernels.values() if self.list is not None else ()
        super().prepare([*listing, *measuring])
        if self.list is not None and self.list.build_count == 0:
            self.refresh_list()
            super().prepare()  # a list that grew has other arrays

    def _settle(self) -> bool:
        """Do what halted the steps asks for, so that nothing is pending; False if a fiber tore."""
        status = self._status()
        if status[TORN]:
            return False
        if status[EXPIRED] and self.list is not None and self.skin is not None:
            listed = float(status[PAIR_COUNT]) / self.model.segment_count
            self.set_skin(self.skin.choose(self.step_count, listed))
            self.refresh_list()
        return True

    def close(self) -> None:
        """Stop worker threads."""
        super().close()
        if self.list is not None:
            self.list.close()

    # -- what is saved ----------------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """What the next list depends on."""
        if self.list is None or self.skin is None:
            return {}
        allowed = np.asarray(self.list.stretch_allowed)
        return {"stretch_allowed": allowed, "skin": self.skin.saved()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Build again the list that the saved run had, which was built from older positions."""
        if self.list is None or self.skin is None:
            return
        state = self.state
        self.set_stretch(float(arrays["stretch_allowed"]))
        self.set_skin(float(arrays["skin"][0]))
        self.skin.begun = self.step_count
        state.node_pos.assign(arrays["list_pos"])
        state.lattice.assign(arrays["list_lattice"])
        self.refresh_list(wrap=False)
        self.skin.restore(arrays["skin"])
        for name in ("node_pos", "lattice", "deformation"):
            getattr(state, name).assign(arrays[name])
