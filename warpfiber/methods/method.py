"""What every method shares: flow, workers, queued steps, and what is said of a torn fiber.

A method owns the arrays that only it needs, and advances a State by `launches`. `list` and `skin`
are None where no pairs are searched for.
"""

from __future__ import annotations

import math
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.methods.skin import SkinChoice
from warpfiber.model import BAD_FIBER, EXPIRED, TORN, Model, State
from warpfiber.passes.executor import (
    Call,
    Executor,
    Launch,
    Repeat,
    StepTimes,
    flat,
    load_kernels,
    median_times,
)
from warpfiber.passes.measure import TERMS
from warpfiber.passes.measurement import measure_fiber_terms
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.passes.pairs import PairFeatures
from warpfiber.passes.worker_choice import WorkerChoice
from warpfiber.scene import Scene, Stage

# Below this many segments the hand-off between workers costs more than it saves.
WORKER_BREAK_EVEN = 5000
MOST_REPEATED = 10  # tries per step that is timed: each may be halted or taken back


class Method(ABC):
    """Advances a State by steps of `dt` (run units)."""

    inertia = True  # nodes have a mass, and so a kinetic energy
    own_energy = False  # `measure` has the energies: they are not those of a chain

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        self.scene, self.model, self.state = scene, model, state
        self.dt = dt / model.units.time
        self.workers = self._choose_workers(workers)
        # a number that was asked for holds for every step
        chosen = workers is None and self.workers > 1
        self.worker_choice = WorkerChoice() if chosen else None
        units = model.units
        self.flow_rate = scene.flow.rate * units.time if scene.flow else 0.0
        self.flow_origin = np.zeros(3)
        if scene.flow is not None and scene.flow.origin is not None:
            self.flow_origin = np.asarray(scene.flow.origin) / units.length
        self.strength = self.decay = 0.0  # of the repulsion
        self.pair_features = PairFeatures()
        self.list: NeighborList | None = None
        self.skin: SkinChoice | None = None
        self.list_seconds = 0.0
        self.strain_end = math.inf  # where a deforming box becomes too flat
        self.set_gradient()
        self.executor: Executor | None = None
        self._status_view: np.ndarray | None = None
        self._step_view: np.ndarray | None = None
        self.pair_acts = wp.zeros(0, dtype=wp.uint8, device=model.device)
        self.pair_force = wp.zeros(0, dtype=model.precision.vec3, device=model.device)

    @abstractmethod
    def launches(self) -> list[Launch | Call | Repeat]:
        """The launches of one step."""

    def _worker_break_even(self) -> float:
        """Segments from which a second worker pays."""
        return WORKER_BREAK_EVEN

    def _choose_workers(self, workers: int | None) -> int:
        if not self.model.device.startswith("cpu"):
            return 1
        if workers is not None:
            return workers
        if self.model.segment_count < self._worker_break_even():
            return 1
        try:
            cores = len(os.sched_getaffinity(0))
        except AttributeError:  # only Linux tells which cores this process may use
            cores = os.cpu_count() or 1
        return min(2, cores)

    def set_gradient(self) -> None:
        """The flow's gradient at the present strain, before the first step sets it."""
        p, scene = self.model.precision, self.scene
        full = np.zeros((3, 3))
        if scene.flow is not None and scene.flow.velocity_gradient is not None:
            full = np.asarray(scene.flow.velocity_gradient) * self.model.units.time
        self.full_gradient = full
        schedule = scene.flow.schedule if scene.flow and scene.flow.schedule else ((0.0, 1.0),)
        self.schedule = np.asarray(schedule, dtype=np.float64)
        strain = float(self.state.strain.numpy()[0])
        factor = scene.flow.factor(strain) if scene.flow else 1.0
        self.state.gradient.assign((full * factor)[None].astype(p.numpy))

    # -- the step ---------------------------------------------------------------------------------

    def prepare(self, measuring: Iterable[Any] = ()) -> None:
        """Compile and capture, so that the next `advance` only steps.

        `measuring`: further kernels of the run, compiled along with these.
        """
        if self.list is not None:
            self.list.worker_choice = self.worker_choice
        if self.executor is None:
            launches = self.launches()
            stepping = [launch.kernel for launch in flat(launches) if isinstance(launch, Launch)]
            load_kernels([*stepping, *measuring], self.model.device)
            self.executor = Executor(
                launches, self.model.device, self.workers, choice=self.worker_choice
            )

    def advance(self, steps: int) -> bool:
        """Run up to `steps` steps, doing what halts them; False if a fiber tore."""
        target = self.step_count + steps
        while self.step_count < target:
            self.prepare()
            assert self.executor is not None
            begin, before = time.perf_counter(), self.step_count
            self.executor.run(target - before, self._halted)
            lasts = self._settle()
            if self.worker_choice is not None:
                self.worker_choice.note(self.step_count - before, time.perf_counter() - begin)
            if not lasts:
                return False
        return True

    def time_passes(self, steps: int) -> dict[str, float]:
        """Seconds per step of every launch, over `steps` steps of the run that are kept."""
        times: list[StepTimes] = []
        for _ in range(MOST_REPEATED * steps):
            self.prepare()
            assert self.executor is not None
            taken = self.step_count
            found = self.executor.time_step()
            if found is not None and self.step_count > taken:
                times.append(found)
            # a torn fiber is left to the next `advance`
            if len(times) == steps or (self._halted() and not self._settle()):
                break
        self._settle()
        return median_times(times)

    def _settle(self) -> bool:
        """Do what halted the steps asks for; False if a fiber tore."""
        return not self._status()[TORN]

    def _halted(self) -> bool:
        status = self._status()
        return bool(status[EXPIRED] or status[TORN])

    def _status(self) -> np.ndarray:
        """The status words: on the CPU a view that is made once, looked at after every graph."""
        if self._status_view is None or not self.model.device.startswith("cpu"):
            self._status_view = self.state.status.numpy()
        return self._status_view

    @property
    def step_count(self) -> int:
        """Steps taken."""
        if self._step_view is None or not self.model.device.startswith("cpu"):
            self._step_view = self.state.step.numpy()
        return int(self._step_view[0])

    @property
    def counted_fibers(self) -> int:
        """Fibers that are simulated now; measurements leave the later ones out."""
        return self.model.fiber_count

    @property
    def box_width(self) -> float:
        """Smallest height that a periodic box may have, run units."""
        return 0.0

    def close(self) -> None:
        """Stop worker threads."""
        self._stop_executor()

    def _stop_executor(self) -> None:
        if self.executor is not None:
            self.executor.close()
            self.executor = None

    # -- stages -----------------------------------------------------------------------------------

    def begin_stage(self, stage: Stage, *, resumed: bool = False) -> None:  # noqa: B027
        """Take over what a stage changes, if anything; `resumed`: it began before a restart."""

    def steps_left(self, stage: Stage) -> int | None:
        """Steps before which the method's own condition surely does not end it; None without."""
        return None

    def stage_result(self, stage: Stage) -> dict[str, float]:
        """What the whole stage under way has shown, SI; nothing for most."""
        return {}

    def unmet(self, stage: Stage) -> str:
        """What that condition still waits for."""
        return ""

    # -- what is saved and told -------------------------------------------------------------------

    def measure(self) -> dict[str, float]:
        """Columns of the record beside those that all methods have, SI."""
        return {}

    def node_fields(self) -> dict[str, np.ndarray]:
        """Values by node of `record.node_fields` beside the velocity, SI."""
        return {}

    @abstractmethod
    def saved(self) -> dict[str, np.ndarray]:
        """What the next step depends on beside the State, in run units."""

    @abstractmethod
    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned; the State has been restored."""

    def list_report(self) -> dict[str, float]:
        """What the search for pairs did; nothing without a list."""
        return {}

    def step_report(self) -> dict[str, float]:
        """What the choice of the step did; nothing where it never changes."""
        return {}

    def _segment_stretch(self) -> np.ndarray:
        """(S,) length of every segment now, in its rest length."""
        model = self.model
        nodes = self.state.node_pos.numpy().astype(float)
        first = model.host["segment_node"]
        rest = np.asarray([row["rest"] for row in model.group_rows])
        mine = rest[model.host["fiber_group"][model.host["segment_fiber"]]]
        end = model.host["segment_end"]
        lengths: np.ndarray = np.linalg.norm(nodes[end] - nodes[first], axis=1) / mine
        return lengths

    def torn_fiber(self) -> dict[str, Any]:
        """First torn fiber, its worst node, and its largest force term (N) after `advance`."""
        model, state = self.model, self.state
        stretch = self._segment_stretch()
        bad = np.flatnonzero(~(stretch < TEAR_STRETCH))
        fiber = int(state.status.numpy()[BAD_FIBER])
        if len(bad):  # several may have torn in one step, in any order
            fiber = int(model.host["segment_fiber"][bad[0]])
        stored = self.list if self.pair_acts.shape[0] else None  # forces by listed pair
        sizes = measure_fiber_terms(
            model, state, fiber, self.flow_origin, stored, self.pair_acts, self.pair_force
        )
        mine = stretch[model.host["segment_fiber"] == fiber]
        worst = int(np.argmax(np.where(np.isfinite(mine), mine, math.inf)))
        known = np.isfinite(sizes).any()
        largest = int(np.argmax(np.where(np.isfinite(sizes), sizes, -1.0 if known else 0.0)))
        return {
            "fiber": fiber,
            "node": worst,
            "terms": dict(zip(TERMS, map(float, sizes), strict=True)),
            "largest_term": TERMS[largest],
            "stretch": float(mine[worst]),
            "contact": self.refused_contact(),
        }

    def refused_contact(self) -> dict[str, Any] | None:
        """What two fibers did that no step could prevent; None if contact is not the cause."""
        return None
