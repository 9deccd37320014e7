"""Grips of a bed that is pulled or sheared: which nodes they hold, what acts on them, the yield.

A stage freezes what reaches below `freeze_below` and above `freeze_above`; the upper grip moves up
(pull) or along x (shear). `freeze = "fibers"`: whole fibers with a node in a grip; one that reaches
into both belongs to the one with more of its nodes, else to the lower. `"nodes"`: the nodes alone.
Source: Xu, Ma & Guo 2023, sections 4 and 5: stress = force on the upper grip over L_x L_y, yield
    stress = its largest value (pull), its mean over the steady part (shear).
Symbols: strain = speed time / L_s; stresses zz and xz, tension positive. The steady part is the
    second half of the stage.
Limits: forces of walls and weight on gripped nodes do not count. A stage ends in an error where the
    upper grip reaches the top of a box with walls.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import warp as wp

from warpfiber.methods.node_holds import NodeHolds
from warpfiber.model import Model, State
from warpfiber.passes.bonds import FREE, LOWER, UPPER
from warpfiber.passes.executor import Launch
from warpfiber.passes.grip_meter import (
    CHUNK,
    COMPONENT,
    COUNT,
    COURSE_SIZE,
    DEVIATION,
    MEAN,
    PEAK,
    PEAK_STEP,
    SPEED,
    STEADY_FROM,
    STEPS,
    TASK_SIZE,
    WORK,
    make_grip_meter,
    make_grip_sum,
)
from warpfiber.scene import Fault, Scene, SceneError, Stage
from warpfiber.scene.gripping import GRIPPING, HEIGHT, drawn_axis, free_height, grips

STEADY_PART = 0.5  # of a stage, at its end

_CARRIED = ("grip", "mean", "course")


class Grips:
    """Both grips; without a stage that needs them nothing is allocated or launched."""

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, holds: NodeHolds
    ) -> None:
        self.scene, self.model, self.state, self.dt = scene, model, state, dt
        self.used = grips(scene)
        self.holds = holds
        p, device = model.precision, model.device
        self.stage: Stage | None = None  # the one under way, if it grips
        nodes = model.node_count if self.used else 0
        chunks, two = -(-nodes // CHUNK), 2 if self.used else 0
        self.node_grip = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.chunk_low = wp.zeros(chunks, dtype=wp.vec3d, device=device)
        self.chunk_high = wp.zeros(chunks, dtype=wp.vec3d, device=device)
        self.grip = wp.zeros(two, dtype=wp.vec3d, device=device)
        self.mean = wp.zeros(two, dtype=wp.vec3d, device=device)
        self.task = wp.array(_task(), dtype=wp.float64, device=device)
        self.course = wp.zeros(COURSE_SIZE * self.used, dtype=wp.float64, device=device)
        if scene.box is not None:
            self.area = scene.box.size[0] * scene.box.size[1]

    def meter(self) -> list[Launch]:
        """After the loads of a step."""
        if not self.used:
            return []
        chunks = [self.chunk_low, self.chunk_high]
        sums = [self.task, self.holds.hold, self.node_grip, *chunks]
        inputs = [wp.float64(self.dt), self.state.status, self.task, *chunks]
        inputs += [self.grip, self.mean, self.course]
        name = self.model.precision.name
        return [
            Launch("grip sums", make_grip_sum(name), self.chunk_low.shape[0], sums),
            Launch("grip meter", make_grip_meter(), 1, inputs, follows=True),
        ]

    # -- stages -----------------------------------------------------------------------------------

    def begin(self, stage: Stage, nodes: np.ndarray, *, resumed: bool) -> np.ndarray:
        """Hold what the stage grips, of nodes (N, 3; run units), and nothing else.

        Returns the gripped nodes, which move as their `load` says from now on. Raises SceneError if
        a grip is empty.
        """
        gripped = np.zeros(0, dtype=np.int64)
        if not self.used:
            return gripped
        units = self.model.units
        self.stage = stage if stage.kind in GRIPPING else None
        if self.stage is None:
            self.task.assign(_task())
            return gripped
        axis, speed = drawn_axis(stage), (stage.speed or 0.0) / units.velocity
        steps = (stage.end_time or 0.0) / units.time / self.dt
        self.task.assign(_task(axis, (1.0 - STEADY_PART) * steps, speed))
        if resumed:
            return gripped
        hold = self._gripped(stage, nodes)
        velocity = np.zeros_like(nodes)
        velocity[hold == UPPER, axis] = speed
        self.holds.take(hold, velocity)
        course = np.zeros(COURSE_SIZE)
        course[WORK] = self.course.numpy()[WORK]
        self.course.assign(course)
        return np.flatnonzero(hold != FREE)

    def _gripped(self, stage: Stage, nodes: np.ndarray) -> np.ndarray:
        """(N,) LOWER and UPPER of the nodes that the stage holds, FREE of the others."""
        height = nodes[:, HEIGHT] * self.model.units.length
        low, high = height <= (stage.freeze_below or 0.0), height >= (stage.freeze_above or 0.0)
        faults = []
        for key, inside in (("freeze_below", low), ("freeze_above", high)):
            if not inside.any():
                where = f"nodes lie between {height.min():.4g} and {height.max():.4g} m"
                remedy = f"no fiber is there to be gripped; {where}"
                value = getattr(stage, key)
                faults.append(Fault(self.scene.path, f"stage '{stage.name}': {key}", value, remedy))
        if faults:
            raise SceneError(faults)
        if stage.freeze != "nodes":
            start = self.model.host["fiber_node_start"]
            inside_low = np.add.reduceat(low.astype(int), start[:-1])
            inside_high = np.add.reduceat(high.astype(int), start[:-1])
            lower = (inside_low > 0) & (inside_low >= inside_high)
            upper = (inside_high > 0) & ~lower
            low, high = (np.repeat(part, np.diff(start)) for part in (lower, upper))
        return np.where(low, LOWER, np.where(high, UPPER, FREE)).astype(np.int32)

    def steps_left(self, nodes: np.ndarray) -> int | None:
        """Steps to the top of a box with walls; None where nothing is pulled to one.

        Raises SceneError if there is no way left.
        """
        stage, box = self.stage, self.scene.box
        if stage is None or stage.kind != "pull" or box is None or box.boundary[HEIGHT] != "wall":
            return None
        units = self.model.units
        radius = 0.5 * max(group.diameter for group in self.scene.fibers)
        top = float(nodes[self.holds.hold.numpy() == UPPER, HEIGHT].max()) * units.length + radius
        steps = math.floor((box.size[HEIGHT] - top) / ((stage.speed or 0.0) * units.time * self.dt))
        if steps < 1:
            remedy = "the pulled fibers have reached the top of the box; end the stage earlier, "
            where = f"stage '{stage.name}': end_strain"
            raise SceneError(
                [Fault(self.scene.path, where, stage.end_strain, remedy + "or give a higher box")]
            )
        return steps

    # -- what is saved and told -------------------------------------------------------------------

    def stresses(self) -> np.ndarray:
        """(2, 3) Pa: mean stress vectors of the lower and the upper grip; tension is positive z."""
        scale = np.array([[1.0], [-1.0]]) * self.model.units.force / self.area
        means: np.ndarray = self.mean.numpy() * scale
        return means

    def _strain(self, stage: Stage, steps: float) -> float:
        seconds = steps * self.dt * self.model.units.time
        return (stage.speed or 0.0) * seconds / free_height(stage)

    def measure(self) -> dict[str, float]:
        """Strain and stresses (NaN in other stages) and work, where `quantities` ask for them."""
        row: dict[str, float] = {}
        if not self.used:
            return row
        if "stress" in self.scene.record.quantities:
            strain, stress = math.nan, np.full((2, 3), math.nan)
            if self.stage is not None:
                strain = self._strain(self.stage, float(self.course.numpy()[STEPS]))
                stress = self.stresses()
            row["grip_strain"] = strain
            for c, name in ((2, "stress_zz"), (0, "stress_xz")):
                row[name], row[f"{name}_low"] = float(stress[1, c]), float(stress[0, c])
        if "energy" in self.scene.record.quantities:
            row["grip_work"] = float(self.course.numpy()[WORK]) * self.model.units.energy
        return row

    def result(self) -> dict[str, float]:
        """Yield stress (Pa) of the stage under way; nothing if it grips nothing."""
        stage = self.stage
        if stage is None:
            return {}
        course = self.course.numpy()
        scale = self.model.units.force / self.area
        if stage.kind == "pull":
            strain = self._strain(stage, float(course[PEAK_STEP]))
            return {"yield_stress_zz": float(course[PEAK]) * scale, "yield_strain": strain}
        count = max(1.0, float(course[COUNT]))
        scatter = math.sqrt(float(course[DEVIATION]) / count)
        return {
            "yield_stress_xz": float(course[MEAN]) * scale,
            "standard_deviation": scatter * scale,
            "from_strain": self._strain(stage, float(course[STEPS]) - float(course[COUNT])),
        }

    def saved(self) -> dict[str, np.ndarray]:
        """Forces and the course of the stage."""
        if not self.used:
            return {}
        arrays = {f"grips_{name}": getattr(self, name).numpy().copy() for name in _CARRIED}
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        if self.used:
            for name in _CARRIED:
                getattr(self, name).assign(arrays[f"grips_{name}"])


def _task(component: int = -1, steady_from: float = 0.0, speed: float = 0.0) -> np.ndarray:
    task = np.zeros(TASK_SIZE)
    task[COMPONENT], task[STEADY_FROM], task[SPEED] = component, steady_from, speed
    return task
