"""Explicit bead chain of Sasayama & Inagaki 2018, Eq. (16); N_R = 0 is their SBCM.

A step: clock (time, flow, lattice), pair sweep (repulsion, lubrication), node sweep (gather, drag,
stretching, bending, hydrodynamic torque, closure; velocity first, with the drag at the middle of
the step, then position).
Limits: first order in dt (torque, first half step); dt below `stability.step_limits`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.laws.lubrication import OUTER
from warpfiber.laws.repulsion import RANGE
from warpfiber.methods.method import Method
from warpfiber.methods.pair_search import PairSearch
from warpfiber.methods.skin import PAIR_COST, PLAIN_PAIR_COST
from warpfiber.methods.step_launches import step_launches
from warpfiber.model import EXPIRED, TORN, Model, State
from warpfiber.passes.executor import Call, Launch, Repeat
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
        self.search: PairSearch | None = None
        if self.has_pairs:
            self.search = PairSearch(
                scene,
                model,
                state,
                reach=contact_reach(scene) * 2.0 * max(row["radius"] for row in model.group_rows),
                stretch=float(self._segment_stretch().max()),
                workers=self.workers,
                native=self.native,
                pair_cost=PAIR_COST if self.native else PLAIN_PAIR_COST,
                prunes=True,
            )
            self.list, self.skin = self.search.list, self.search.skin
            self.strain_end = self.search.strain_end
        self._allocate_pair_results()

    def launches(self) -> list[Launch | Call | Repeat]:
        """Clock, pairs and nodes."""
        return [*step_launches(self)]

    @property
    def box_width(self) -> float:
        """Smallest height that a periodic box may have, run units."""
        return self.search.box_width if self.search is not None else 0.0

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

    def refresh_list(self, *, wrap: bool = True) -> None:
        """Build the neighbor list now (also clears its expiry)."""
        if self.search is None:
            return
        replaced = self.search.refresh(self.step_count, wrap=wrap)
        self.list_seconds, self.strain_end = self.search.seconds, self.search.strain_end
        if replaced:
            self._allocate_pair_results()
            self._stop_executor()

    def list_report(self) -> dict[str, float]:
        """Skins in largest diameters, builds and what they looked at; nothing without a list."""
        return self.search.report(self.step_count) if self.search is not None else {}

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
        if status[EXPIRED] and self.search is not None:
            if not self.search.prune(self.step_count):
                self.search.choose_skin(self.step_count)
                self.refresh_list()
            self.list_seconds = self.search.seconds
        return True

    def close(self) -> None:
        """Stop worker threads."""
        super().close()
        if self.search is not None:
            self.search.close()

    # -- what is saved ----------------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """What the next list depends on."""
        return self.search.saved() if self.search is not None else {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Build again the list that the saved run had, which was built from older positions."""
        if self.search is None:
            return
        self.search.restore(arrays, self.step_count)
        self.list_seconds, self.strain_end = self.search.seconds, self.search.strain_end
        self._allocate_pair_results()
        self._stop_executor()
