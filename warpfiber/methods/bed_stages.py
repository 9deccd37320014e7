"""What stages do to a bed of bonded spheres: walls, grips, pouring, held nodes, and how they end.

Every stage begins with the nodes held that loads hold; walls, grips and pouring then take what they
need. A stage with `end_speed` ends when all nodes were slower for STILL_TIME.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from warpfiber.methods.grips import Grips
from warpfiber.methods.node_holds import NodeHolds
from warpfiber.methods.pour import Pour
from warpfiber.methods.press import Press
from warpfiber.passes.bonds import FREE
from warpfiber.scene import Stage
from warpfiber.scene.gripping import GRIPPING, grips
from warpfiber.scene.pressing import PRESSING

if TYPE_CHECKING:
    from warpfiber.methods.bonded_spheres import BondedSpheres

STILL_TIME = 0.01  # s for which all nodes must be slower than `end_speed`


class BedStages:
    """Walls, grips, pouring and holds of one run, which act on the nodes of `spheres`."""

    def __init__(self, spheres: BondedSpheres) -> None:
        scene, model, dt = spheres.scene, spheres.model, spheres.dt
        self.spheres = spheres
        self.press = Press(scene, model, spheres.state, dt)
        self.pour = Pour(scene, model, spheres.state, dt)
        self.holds = NodeHolds(scene, model, changing=self.pour.used or grips(scene))
        self.grips = Grips(scene, model, spheres.state, dt, self.holds)
        self.still_needed = math.ceil(STILL_TIME / (dt * model.units.time))

    def begin_stage(self, stage: Stage, *, resumed: bool) -> None:
        """Place walls, grips and fibers that are poured; count anew how long all was still."""
        if resumed:
            self.pour.resume(stage)
            self.grips.begin(stage, self._nodes(), resumed=True)
            return
        self.spheres.still_steps.zero_()
        self.holds.release()
        lifted = self.pour.begin(stage, self.spheres.step_count)
        self.press.fibers = self.pour.count
        if lifted is not None:
            self._put(np.arange(len(lifted)), lifted)
        nodes = self._nodes()
        self.press.begin(stage, nodes)
        told = self.grips.begin(stage, nodes, resumed=False)
        if self.pour.stage is not None:
            told = self._wait()
        self._move_as_told(told)

    def pour_due(self, step: int) -> None:
        """Let the fibers fall that are due, with the velocity of their placement."""
        spheres = self.spheres
        if self.pour.steps_left(step) > 0:
            return
        spheres.prepare()
        fallen = self.pour.due(step, self._nodes())
        if not fallen:
            return
        self.press.fibers = self.pour.count
        self._wait()
        velocity = spheres.state.node_velocity.numpy()
        for fiber, place in fallen:
            nodes = np.arange(self.pour.start[fiber], self.pour.start[fiber + 1])
            self._put(nodes, place)
            velocity[nodes] = self.pour.velocity[nodes]
        spheres.state.node_velocity.assign(velocity)
        spheres.still_steps.zero_()
        spheres.rebuild_list()

    def _wait(self) -> np.ndarray:
        """Hold the fibers that are not poured yet; returns their nodes."""
        hold = self.pour.holds()
        self.holds.take(hold, np.zeros((len(hold), 3)))
        return np.flatnonzero(hold != FREE)

    def _nodes(self) -> np.ndarray:
        """(N, 3) positions now, run units, as exact as they are kept."""
        spheres = self.spheres
        nodes = spheres.place if spheres.started else spheres.state.node_pos
        found: np.ndarray = nodes.numpy().astype(float)
        return found

    def _put(self, nodes: np.ndarray, place: np.ndarray) -> None:
        """Set nodes elsewhere (run units)."""
        arrays = {id(array): array for array in (self.spheres.state.node_pos, self.spheres.place)}
        for array in arrays.values():
            values = array.numpy()
            values[nodes] = place
            array.assign(values)

    def _move_as_told(self, nodes: np.ndarray) -> None:
        """Give nodes that are held from now on the velocity that they are held at."""
        if len(nodes) == 0:
            return
        spheres, told = self.spheres, self.holds.load.numpy()
        velocity = spheres.state.node_velocity
        for array in (velocity, spheres.node_spin, spheres.node_rate, spheres.node_spin_rate):
            values = array.numpy()
            values[nodes] = told[nodes] if array is velocity else 0.0
            array.assign(values)

    # -- how stages end ---------------------------------------------------------------------------

    def steps_left(self, stage: Stage) -> int | None:
        """Steps before which no condition but strain and time surely ends the stage."""
        if stage.kind in PRESSING:
            return self.press.steps_left(stage, self.spheres.step_count)
        if stage.kind in GRIPPING:
            return self.grips.steps_left(self._nodes())
        if stage.end_speed is None:
            return None
        if self.pour.stage is not None and self.pour.waits:
            return max(1, self.pour.steps_left(self.spheres.step_count))
        return max(0, self.still_needed - int(self.spheres.still_steps.numpy().min()))

    def unmet(self, stage: Stage) -> str:
        """What the stage still waits for."""
        if stage.kind in PRESSING:
            return self.press.unmet(stage)
        if self.pour.stage is not None and self.pour.waits:
            return self.pour.unmet()
        if stage.end_speed is None:
            return ""
        spheres = self.spheres
        velocity = spheres.state.node_velocity.numpy().astype(float)
        fastest = float(np.linalg.norm(velocity, axis=1).max()) * spheres.model.units.velocity
        return f"end_speed = {stage.end_speed:g} m/s; the fastest node moves at {fastest:.4g} m/s"

    # -- what is saved ----------------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """What all parts must keep."""
        arrays: dict[str, np.ndarray] = {}
        for part in (self.press, self.grips, self.holds, self.pour):
            arrays |= part.saved()
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for part in (self.press, self.grips, self.holds, self.pour):
            part.restore(arrays)
        self.press.fibers = self.pour.count
