"""One simulation in memory: build, step, measure, save and restore its state. Writes no files.

`job` runs a simulation into a result folder; from Python, `Simulation(scene)` is all one needs.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.build import build, foresee_kernels, realized_scene
from warpfiber.methods.bead_chain import BeadChain
from warpfiber.methods.bonded_spheres import BondedSpheres
from warpfiber.methods.method import Method
from warpfiber.methods.overdamped import Overdamped
from warpfiber.methods.rigid_rod import RigidRod
from warpfiber.methods.stability import StepLimit, chosen_step, step_limits
from warpfiber.output.saved_stage import merged_arrays, read_saved_stage
from warpfiber.passes.host_arrays import host_view
from warpfiber.passes.layer_profile import LayerProfile
from warpfiber.passes.measurement import Measurement
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.placement import Placement, place_fibers, split_tables
from warpfiber.scene import Fault, Scene, SceneError, Stage
from warpfiber.scene.derived import group_volume

CUDA_BREAK_EVEN = 20_000  # segments from which `auto` prefers a CUDA device

METHODS: dict[str, type[Method]] = {
    "bead_chain": BeadChain,
    "overdamped": Overdamped,
    "rigid_rod": RigidRod,
    "bonded_spheres": BondedSpheres,
}

# What a checkpoint holds beside what the method saves: arrays that the next step depends on.
_ARRAYS = (
    "node_pos node_velocity fiber_image lattice deformation list_pos list_lattice step time strain"
).split()


class Diverged(Exception):
    """A fiber was torn: the step was too large, or the scene starts in a state that explodes."""

    def __init__(self, report: Mapping[str, Any]) -> None:
        self.report = dict(report)
        super().__init__(report["message"])


class StageUnfinished(Exception):
    """A stage has not met its end condition within its time limit."""


class BoxExhausted(Exception):
    """The flow has deformed a periodic box until a segment and its reach no longer fit into it."""


def choose_device(scene: Scene, segments: int) -> str:
    """Device of the run; raises SceneError if the one asked for does not exist."""
    wanted = scene.numerics.device
    known = [str(device) for device in wp.get_devices()]
    cuda = [name for name in known if name.startswith("cuda")]
    if wanted == "auto":
        return cuda[0] if cuda and segments >= CUDA_BREAK_EVEN else "cpu"
    if wanted == "cuda" and cuda:
        return cuda[0]
    if wanted in known:
        return wanted
    remedy = f"no such device on this machine; there is: {', '.join(known)}"
    raise SceneError([Fault(scene.path, "numerics.device", wanted, remedy)])


def check_step(scene: Scene) -> tuple[float, tuple[StepLimit, ...]]:
    """Chosen dt in s and all limits; raises SceneError if dt is above the smallest limit."""
    limits, dt = step_limits(scene), chosen_step(scene)
    smallest = limits[0]
    if not math.isfinite(dt):
        remedy = "nothing limits the step of this scene; give numerics.dt in s"
        raise SceneError([Fault(scene.path, "numerics.dt", "auto", remedy)])
    if dt > smallest.dt and not scene.numerics.allow_unstable_dt:
        remedy = (
            f"above what is {smallest.kind}, {smallest.dt:.4g} s, set by {smallest.term}; take "
            'dt = "auto" or a smaller one, or set numerics.allow_unstable_dt = true'
        )
        raise SceneError([Fault(scene.path, "numerics.dt", dt, remedy)])
    return dt, limits


def with_device(scene: Scene, device: str | None) -> Scene:
    """The scene on another device; None leaves it."""
    if device is None:
        return scene
    return dataclasses.replace(scene, numerics=dataclasses.replace(scene.numerics, device=device))


def preflight(scene: Scene) -> None:
    """All faults that need no fibers: device, dt. Raises SceneError with every one of them."""
    probes: list[Callable[[Scene], object]] = [lambda scene: choose_device(scene, 0)]
    if not any(group.node_file for group in scene.fibers):
        probes.append(lambda scene: check_step(split_tables(scene)))
    faults: list[Fault] = []
    for probe in probes:
        try:
            probe(scene)
        except SceneError as found:
            faults += found.faults
    if faults:
        raise SceneError(faults)


class Simulation:
    """A scene under way. Positions and velocities are NumPy arrays in SI, fibers unwrapped."""

    def __init__(
        self,
        scene: Scene,
        *,
        device: str | None = None,
        workers: int | None = None,
        placement: Placement | None = None,
        dt: float | None = None,
    ) -> None:
        """Place the fibers and allocate; `device`, `workers`, `dt` (s) override the numerics.

        Raises SceneError if the device does not exist, the fibers cannot be placed or dt is not
        stable.
        """
        scene = split_tables(with_device(scene, device))
        saved = None
        if placement is None:
            preflight(scene)
            foresee_kernels(scene, choose_device(scene, CUDA_BREAK_EVEN))
            if scene.start is None:
                placement = place_fibers(scene)
            else:
                saved, placement = read_saved_stage(scene)
        self.scene = realized_scene(scene, placement)
        self.limits = step_limits(self.scene)
        self.dt = check_step(self.scene)[0] if dt is None else dt
        segments = len(placement.node_pos) - len(placement.fiber_group)
        self.device = choose_device(self.scene, segments)
        self.model, self.state, self.placement_report = build(self.scene, self.device, placement)
        wanted = workers if workers is not None else scene.numerics.workers
        method = METHODS[self.scene.numerics.method]
        self.method = method(self.scene, self.model, self.state, self.dt, wanted)
        quantities = self.scene.record.quantities
        if method.own_energy:
            quantities = tuple(name for name in quantities if name != "energy")
        self.measurement = Measurement(
            self.model,
            self.state,
            quantities,
            self.method.pair_features,
            self.method.strength,
            self.method.decay,
            self.method.inertia,
        )
        self.layers: LayerProfile | None = None
        if self.scene.record.layers:
            self.layers = LayerProfile(
                self.model,
                self.state,
                self.scene.record.layers,
                [group_volume(self.scene, group) for group in self.scene.fibers],
                "orientation4" in self.scene.record.quantities,
            )
        if saved is not None:
            self.restore(merged_arrays(saved, self.snapshot()))
        self.origin = (self.strain, self.time)  # where the first stage begins; s
        self.begin_stage(self.scene.stage_sequence[0])

    # -- stepping ---------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Compile everything that the run needs and build the first list."""
        layers = [self.layers.kernel] if self.layers is not None else []
        self.method.prepare([*self.measurement.kernels(self.method.list), *layers])

    def step(self, count: int = 1) -> None:
        """Advance `count` steps of dt.

        Raises Diverged if a fiber tears, BoxExhausted or SceneError if the flow or a stretched
        segment leaves the periodic box too small.
        """
        target = self.step_count + count
        while (left := target - self.step_count) > 0:
            end = self.method.strain_end
            allowed = left if math.isinf(end) else min(left, self.steps_to(end, None))
            if allowed == 0:
                height = self.method.box_width * self.model.units.length
                raise BoxExhausted(
                    f"stopped at strain {self.strain:.6g}: the flow has deformed the periodic box "
                    f"until its smallest height is {height:.4g} m "
                    "(longest segment + reach + skin); take a larger box or more segments"
                )
            if not self.method.advance(allowed):
                raise Diverged(self._torn_report())

    def run(self, until: float | None = None, *, time: float | None = None) -> None:
        """Advance to the strain `until`, or to `time` in s; default: the end of the last stage.

        The end is reached to within one step. Raises what `step` raises.
        """
        if until is not None or time is not None:
            while (steps := self.steps_to(until, time)) > 0:
                self.step(steps)
            return
        start = self.origin
        for stage in self.scene.stage_sequence:
            self.begin_stage(stage)
            while (steps := self.stage_steps(stage, start)) > 0:
                left = self.steps_to_limit(stage, start)
                if left <= 0:
                    raise StageUnfinished(self.unmet(stage))
                self.step(min(steps, left))
            # what ended by another condition ends where it is
            ended = stage.end_time is not None and (
                self.steps_to(None, start[1] + stage.end_time) <= 0
            )
            start = (
                self.strain if stage.end_strain is None else start[0] + stage.end_strain,
                start[1] + stage.end_time if ended and stage.end_time else self.time,
            )

    def begin_stage(self, stage: Stage, *, resumed: bool = False) -> None:
        """Take over what a stage changes; `resumed`: it began before the state was saved."""
        self.method.begin_stage(stage, resumed=resumed)

    def stage_steps(self, stage: Stage, start: tuple[float, float]) -> int:
        """Steps that surely do not pass the end of a stage begun at `start` = (strain, time)."""
        flow = self.scene.flow  # a fluid at rest never reaches a strain
        moving = flow is not None and flow.rate > 0.0
        marks = (
            start[0] + stage.end_strain if moving and stage.end_strain is not None else None,
            start[1] + stage.end_time if stage.end_time is not None else None,
        )
        own = self.method.steps_left(stage)
        if own is None:
            return self.steps_to(*marks)
        return own if marks == (None, None) else min(own, self.steps_to(*marks))

    def steps_to_limit(self, stage: Stage, start: tuple[float, float]) -> int:
        """Steps that surely do not pass the time limit of such a stage; many without one."""
        if stage.time_limit is None:
            return sys.maxsize
        return self.steps_to(None, start[1] + stage.time_limit)

    def unmet(self, stage: Stage) -> str:
        """That a stage did not end within its time limit, and what it waits for."""
        condition = self.method.unmet(stage)
        message = f"stage '{stage.name}': end condition not met within {stage.time_limit:g} s"
        return f"{message}: {condition}" if condition else message

    def steps_to(self, strain: float | None, time: float | None) -> int:
        """Steps that surely do not pass the first of the two marks; 0 if one is reached."""
        counts = []
        if strain is not None:
            flow = self.scene.flow
            factor = 1.0
            if flow is not None and flow.schedule:
                factor = max(abs(row[1]) for row in flow.schedule)
            rate = flow.rate * factor if flow else 0.0
            if rate == 0.0:
                return 0
            counts.append((strain - self.strain) / (rate * self.dt))
        if time is not None:
            counts.append((time - self.time) / self.dt)
        if not counts:
            return 0
        # a mark counts as reached within a millionth of a step: rounding must not add a step
        return max(0, math.ceil(min(counts) - 1e-6))

    def close(self) -> None:
        """Stop worker threads; the state stays readable."""
        self.method.close()

    # -- reading ----------------------------------------------------------------------------------

    @property
    def step_count(self) -> int:
        """Steps taken since the start."""
        return int(host_view(self.state.step)[0])

    @property
    def time(self) -> float:
        """s since the start."""
        return float(host_view(self.state.time)[0]) * self.model.units.time

    @property
    def strain(self) -> float:
        """Time integral of the flow's rate."""
        return float(host_view(self.state.strain)[0])

    @property
    def node_pos(self) -> np.ndarray:
        """(N, 3) m, unwrapped: whole fibers follow their way through the periodic box."""
        return self._unwrapped() * self.model.units.length

    @property
    def node_velocity(self) -> np.ndarray:
        """(N, 3) m/s of the unwrapped nodes."""
        velocity: np.ndarray = self.state.node_velocity.numpy().astype(float)
        if self.model.domain.sheared:  # an image moves with the flow's difference between the two
            gradient = np.asarray(self.state.gradient.numpy()[0], dtype=float)
            velocity = velocity + self._image_shift() @ gradient.T
        return velocity * self.model.units.velocity

    @property
    def fiber_node_start(self) -> np.ndarray:
        """(F+1,) first node of every fiber."""
        start: np.ndarray = self.model.host["fiber_node_start"]
        return start

    @property
    def lattice(self) -> np.ndarray | None:
        """(3, 3) m, columns are the box vectors now; None without a box."""
        if self.scene.box is None:
            return None
        return np.asarray(self.state.lattice.numpy()[0]) * self.model.units.length

    def _unwrapped(self) -> np.ndarray:
        unwrapped: np.ndarray = self.state.node_pos.numpy().astype(float) + self._image_shift()
        return unwrapped

    def _image_shift(self) -> np.ndarray:
        """(N, 3) from the image inside the box to the unwrapped node, run units."""
        image = np.asarray(self.state.fiber_image.numpy(), dtype=float)
        shift = image @ np.asarray(self.state.lattice.numpy()[0]).T
        return np.repeat(shift, np.diff(self.fiber_node_start), axis=0)

    def measure(self) -> dict[str, float]:
        """Step, time (s), strain, and what `record.quantities` asks for, in SI."""
        self.prepare()
        self.measurement.counted = self.method.counted_fibers
        row = {"step": self.step_count, "time": self.time, "strain": self.strain}
        return row | self.measurement.row(self.method.list) | self.method.measure()

    def measure_layers(self) -> dict[str, np.ndarray]:
        """What each of `record.layers` holds, SI: z_low, z_high and the columns of LayerProfile."""
        if self.layers is None:
            return {}
        edges = self.layers.edges()
        return {"z_low": edges[:-1], "z_high": edges[1:]} | self.layers.measure()

    # -- saving -----------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of every array that the next step depends on, in run units and full precision."""
        self.prepare()
        arrays = {name: getattr(self.state, name).numpy().copy() for name in _ARRAYS}
        arrays |= self.method.saved()
        if self.measurement.angle is not None:
            arrays["angle"] = self.measurement.angle.copy()
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue from a snapshot exactly as the run that took it would have."""
        self.state.status.fill_(0)
        for name in _ARRAYS:
            getattr(self.state, name).assign(arrays[name])
        self.method.restore(arrays)
        self.method.set_gradient()
        if self.measurement.angle is not None:
            self.measurement.angle = np.asarray(arrays["angle"])

    # -- failing ----------------------------------------------------------------------------------

    def _torn_report(self) -> dict[str, Any]:
        torn = self.method.torn_fiber()
        smallest = self.limits[0]
        force = torn["terms"][torn["largest_term"]]
        reason = ""
        if self.dt < smallest.dt:
            reason = "; dt is below it: too soft a fiber for this flow, or a start that overlaps"
        limit = ""
        if math.isfinite(smallest.dt):
            limit = f", limit {smallest.dt:.4g} s set by {smallest.term}{reason}"
        stretch = f"segment at {torn['stretch']:.3g} times its rest length"
        what = f"fiber {torn['fiber']} is torn at node {torn['node']} ({stretch})"
        if torn["stretch"] < TEAR_STRETCH:  # rejected steps have been taken back
            what = f"fiber {torn['fiber']} meets the tolerance with no step that is worth taking"
        cause = f"; largest term: {torn['largest_term']} ({force:.3g} N)"
        if torn["contact"] is not None:
            what, cause, limit = torn["contact"]["message"], "", ""
        torn["message"] = (
            f"diverged at step {self.step_count}, time {self.time:.6g} s, strain "
            f"{self.strain:.6g}: {what}{cause}; dt = {self.dt:.4g} s{limit}"
        )
        return torn

    def pass_times(self, repeats: int = 20) -> dict[str, float]:
        """Seconds per step of each pass, measured on real steps (the run goes on from them)."""
        return self.method.time_passes(repeats)
