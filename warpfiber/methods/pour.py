"""Fibers that are poured: they wait above the box and fall from its top, some at a time.

The placed fibers are lifted by more than the height of the box, where they neither move nor count.
Every `interval`, `batch` of them, in their order, are set below the top of the box with the speed
and shape that they were placed with; one that would touch a poured fiber waits until it does not.
The upper wall is out of the way until the next stage.
Symbols: the state of pouring is the step of its begin, the number of poured fibers, and the step
    of the next look.
Limits: each fiber keeps the x and y of its placement.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import numpy as np

from warpfiber.methods.bond_constants import is_closed
from warpfiber.model import Model, State
from warpfiber.passes.bonds import CLAMPED, FREE
from warpfiber.placement.capsules import axis_distance
from warpfiber.scene import Fault, Scene, SceneError, Stage
from warpfiber.scene.pouring import UP, pours

LIFT = 1.05  # heights of the box
LOOK = 16  # steps after which a fiber that found no room is tried again
GAP = 1e-3  # radii of air around a poured fiber, as around placed ones

_CARRIED = ("progress", "nodes", "velocity")


class Pour:
    """What has been poured; without such a stage all fibers are in the box from the start."""

    def __init__(self, scene: Scene, model: Model, state: State, dt: float) -> None:
        self.scene, self.model, self.dt = scene, model, dt
        self.used = pours(scene)
        self.stage: Stage | None = None
        self.progress = np.array([-1, model.fiber_count, 0], dtype=np.int64)
        self.nodes = state.node_pos.numpy().astype(float) if self.used else np.zeros((0, 3))
        velocity = state.node_velocity.numpy().astype(float)
        self.velocity = velocity if self.used else np.zeros((0, 3))
        self.start = model.host["fiber_node_start"]
        low, size = np.asarray(model.domain.low), np.asarray(model.domain.size)
        self.top, self.lift = float(low[UP] + size[UP]), LIFT * float(size[UP])
        radius = np.asarray([row["radius"] for row in model.group_rows])
        self.radius = radius[model.host["fiber_group"]]
        self.closed = np.asarray([is_closed(group) for group in scene.fibers])

    @property
    def count(self) -> int:
        """Fibers that have been poured."""
        return int(self.progress[1])

    @property
    def waits(self) -> bool:
        """Whether some are left."""
        return self.count < self.model.fiber_count

    # -- stages -----------------------------------------------------------------------------------

    def begin(self, stage: Stage, step: int) -> np.ndarray | None:
        """All nodes (N, 3; run units) lifted above the box; None where nothing is lifted now.

        Raises SceneError if the stage before ended too early for the last fibers.
        """
        self.stage = stage if stage.kind == "pour" else None
        if self.stage is None:
            if self.waits:
                remedy = f"{self.count} of {self.model.fiber_count} fibers were poured until then;"
                where = f"stage '{stage.name}'"
                raise SceneError([Fault(self.scene.path, where, None, f"{remedy} pour longer")])
            return None
        if self.progress[0] >= 0:
            return None
        self.progress[:] = step, 0, step
        lifted: np.ndarray = self.nodes + self.lift * np.eye(3)[UP]
        return lifted

    def resume(self, stage: Stage) -> None:
        """Go on with a stage that has begun."""
        self.stage = stage if stage.kind == "pour" else None

    def holds(self) -> np.ndarray:
        """(N,) CLAMPED of the nodes that wait, FREE of the others."""
        hold = np.full(self.model.node_count, FREE, dtype=np.int32)
        hold[self.start[self.count] :] = CLAMPED
        return hold

    def steps_left(self, step: int) -> int:
        """Steps to the next look; many if nothing waits."""
        return int(self.progress[2]) - step if self.waits and self.stage else 2**62

    def due(self, step: int, place: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """(fiber, its nodes) of all that fall from now on, beside the others in `place` (N, 3)."""
        fallen: list[tuple[int, np.ndarray]] = []
        stage = self.stage
        if stage is None or not self.waits or step < self.progress[2]:
            return fallen
        place = place.copy()
        target = min(self.model.fiber_count, self._target(stage, step))
        while self.count < target:
            fiber = self.count
            mine = slice(self.start[fiber], self.start[fiber + 1])
            nodes = self.nodes[mine].copy()
            nodes[:, UP] += self.top - GAP - self.radius[fiber] - nodes[:, UP].max()
            if not self._fits(fiber, nodes, place):
                break
            place[mine] = nodes
            fallen.append((fiber, nodes))
            self.progress[1] += 1
        blocked = self.count < target
        self.progress[2] = step + LOOK if blocked else self._next(stage)
        return fallen

    def _target(self, stage: Stage, step: int) -> int:
        """Fibers that should have been poured by a step."""
        interval = stage.interval / self.model.units.time / self.dt
        if interval == 0.0:
            return self.model.fiber_count
        rounds = math.floor((step - int(self.progress[0])) / interval * (1.0 + 1e-12) + 1e-9)
        return stage.batch * (rounds + 1)

    def _next(self, stage: Stage) -> int:
        """Step at which the next batch is due."""
        interval = stage.interval / self.model.units.time / self.dt
        rounds = self.count // stage.batch
        return int(self.progress[0]) + max(1, math.ceil(rounds * interval - 1e-6))

    def _fits(self, fiber: int, nodes: np.ndarray, place: np.ndarray) -> bool:
        """Whether the nodes keep the gap to all poured fibers and their images."""
        if self.count == 0:
            return True
        heights = place[: self.start[self.count], UP]
        highest = np.maximum.reduceat(heights, self.start[: self.count])
        reach = (1.0 + GAP) * (self.radius[fiber] + self.radius)
        near = highest + reach[: self.count] > nodes[:, UP].min()
        mine = self._segments(fiber, nodes)
        for other in np.flatnonzero(near):
            theirs = place[self.start[other] : self.start[other + 1]]
            if self._distance(mine, self._segments(int(other), theirs)) < reach[other]:
                return False
        return True

    def _segments(self, fiber: int, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centers, directions and half lengths of one fiber's segments."""
        ends = np.roll(nodes, -1, axis=0)
        if not self.closed[self.model.host["fiber_group"][fiber]]:
            nodes, ends = nodes[:-1], ends[:-1]
        length = np.linalg.norm(ends - nodes, axis=1)
        return 0.5 * (nodes + ends), (ends - nodes) / length[:, None], 0.5 * length

    def _distance(self, mine: tuple[np.ndarray, ...], theirs: tuple[np.ndarray, ...]) -> float:
        """Least distance of two fibers' axes, images included."""
        axes = np.asarray(self.model.domain.periodic)
        size = np.where(axes, np.asarray(self.model.domain.size), np.inf)
        counts = len(mine[0]), len(theirs[0])
        first = [np.repeat(part, counts[1], axis=0) for part in mine]
        second = [np.tile(part, (counts[0], *(1,) * (part.ndim - 1))) for part in theirs]
        offset = first[0] - second[0]
        offset -= np.where(axes, np.rint(offset / size) * np.where(axes, size, 0.0), 0.0)
        least = math.inf
        around = [(-1, 0, 1) if periodic else (0,) for periodic in axes]
        for image in itertools.product(*around):
            shifted = offset + np.asarray(image) * np.where(axes, size, 0.0)
            between = axis_distance(shifted, first[1], first[2], second[1], second[2])[2]
            least = min(least, float(np.linalg.norm(between, axis=1).min()))
        return least

    # -- what is saved and told -------------------------------------------------------------------

    def unmet(self) -> str:
        """How many wait; nothing if none do."""
        if not self.waits:
            return ""
        return f"{self.count} of {self.model.fiber_count} fibers are poured"

    def saved(self) -> dict[str, np.ndarray]:
        """Progress, and fibers as they were placed."""
        return {f"pour_{name}": getattr(self, name).copy() for name in _CARRIED if self.used}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for name in _CARRIED if self.used else ():
            setattr(self, name, np.array(arrays[f"pour_{name}"]))
