"""A simulation run into a result folder: stages, records, checkpoints, clean stops, resume.

Events (rows, frames, ends of stages) happen at the first step that reaches their strain or time, so
a resumed run records the same rows as an uninterrupted one. A stop (Ctrl-C, SIGTERM, SIGUSR1, wall
limit) ends the loop after the step under way and writes a checkpoint; a diverged run writes its
last good state and, beside it, the bad one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpfiber.output.checkpoint import write_checkpoint
from warpfiber.output.folder import ResultFolder
from warpfiber.output.saved_stage import write_saved_stage
from warpfiber.recording import Recording
from warpfiber.restart import read_restart
from warpfiber.scene import Fault, Scene, SceneError, Stage
from warpfiber.simulation import BoxExhausted, Diverged, Simulation, preflight, with_device
from warpfiber.stopping import Stopper
from warpfiber.summary import Summary, versions
from warpfiber.trial import after_trial

LOOK_EVERY = 0.2  # s of wall time between looks at stop requests and the progress line
PROFILE_STEPS = 5


class Job:
    """One run of a scene into one folder; `resume` continues a stopped one."""

    def __init__(
        self, simulation: Simulation, folder: ResultFolder, *, progress: Any = None
    ) -> None:
        self.simulation, self.folder = simulation, folder
        self.scene: Scene = simulation.scene
        self.progress = progress
        self.stages = self.scene.stage_sequence
        self.stage_index = 0
        self.stage_start = simulation.origin  # strain and time where the stage began
        self.row_index = 0
        self.frame_index = 0
        self.fresh = True  # the row and the frame of the start are still to be written
        self.good: dict[str, np.ndarray] = {}
        self.good_attrs: dict[str, Any] = {}
        self.summary = Summary(simulation)
        self.record: Recording
        self.passes: dict[str, list[float]] = {}

    # -- starting ---------------------------------------------------------------------------------

    @classmethod
    def start(
        cls,
        scene: Scene,
        *,
        out: str | Path | None = None,
        overwrite: bool = False,
        device: str | None = None,
        workers: int | None = None,
        progress: Any = None,
    ) -> Job:
        """Build the scene, then make the folder: nothing is written if there is a fault.

        Raises SceneError, with all faults of device, dt and folder together before placing fibers.
        """
        scene = with_device(scene, device)
        faults = _faults_of(preflight, scene) + _faults_of(ResultFolder.check, out, overwrite)
        if faults:
            raise SceneError(faults)
        scene = after_trial(scene, workers)
        simulation = Simulation(scene, workers=workers)
        folder = ResultFolder.create(out, scene.name, overwrite)
        job = cls(simulation, folder, progress=progress)
        folder.write_scene(job.scene.as_dict())
        folder.log(f"warpfiber {versions()['warpfiber']}: {job.scene.path}, {job.describe()}")
        for note in job.scene.notes:
            folder.log(f"note: {note}")
        job.record = Recording.start(job.scene, simulation, folder, job._attrs())
        return job

    @classmethod
    def resume(
        cls,
        path: str | Path,
        *,
        device: str | None = None,
        workers: int | None = None,
        progress: Any = None,
    ) -> Job:
        """Continue from the latest whole checkpoint of a folder. Raises SceneError, RecordError."""
        folder = ResultFolder.open(path)
        restart = read_restart(folder)
        attrs = restart.attrs
        simulation = Simulation(
            restart.scene,
            device=device or attrs["device"],
            workers=workers,
            placement=restart.placement,
            dt=float(attrs["dt"]),
        )
        simulation.restore(restart.arrays)
        job = cls(simulation, folder, progress=progress)
        job.scene = dataclasses.replace(simulation.scene, fibers=restart.fibers)
        job.fresh = False
        job.summary.restore(attrs["last_row"], attrs["half_turns"], attrs["stage_results"])
        job.stage_index = int(attrs["stage_index"])
        job.stage_start = (float(attrs["stage_strain"]), float(attrs["stage_time"]))
        if job.stage_index < len(job.stages):
            simulation.begin_stage(job.stages[job.stage_index], resumed=True)
        job.row_index, job.frame_index = int(attrs["row_index"]), int(attrs["frame_index"])
        job.summary.wall_before = float(attrs["wall_seconds"])
        frame_step = int(attrs["frame_step"])
        job.record = Recording.reopen(job.scene, simulation, folder, attrs["last_row"], frame_step)
        folder.log(f"resumed at step {simulation.step_count} from {restart.path.name}")
        return job

    def describe(self) -> str:
        """One line: counts, dt and what limits it."""
        model, limit = self.simulation.model, self.simulation.limits[0]
        warning = f"not {limit.kind}: above its " if self.simulation.dt > limit.dt else ""
        bound = f" ({warning}limit {limit.dt:.4g} s, {limit.term})"
        if not math.isfinite(limit.dt):
            bound = ""
        numerics, reason = self.scene.numerics, self.scene.method_reason
        chosen = f"method {numerics.method} by auto ({reason}), " if reason else ""
        return (
            f"{chosen}{model.fiber_count} fibers, {model.segment_count} segments, "
            f"dt {self.simulation.dt:.4g} s{bound}, "
            f"{self.scene.numerics.precision} on {self.simulation.device}, "
            f"workers {self.simulation.method.workers}"
        )

    # -- the loop ---------------------------------------------------------------------------------

    def run(self, stopper: Stopper | None = None) -> int:
        """Run to the end of the last stage; returns the exit code (0, 3, 130 or 143).

        `stopper` collects the requests to stop; without one, Ctrl-C is caught while this runs.
        """
        if self.stage_index >= len(self.stages):
            self._close()
            self.folder.log("nothing left to do")
            return 0
        code = 0
        with contextlib.nullcontext(stopper) if stopper else Stopper() as stopper:
            try:
                self.simulation.prepare()
                self.summary.begin()
                self._record_due()
                self._keep_good()
                while self.stage_index < len(self.stages) and not stopper.reason:
                    code = self._advance_to_event(stopper)
                    if code:
                        break
                if stopper.reason and not code:
                    self.folder.log(f"stopped by {stopper.reason}")
                    code = stopper.exit_code
            except Diverged as torn:
                code = self._diverged(torn)
            except (BoxExhausted, SceneError) as limit:  # the box, or a segment that outgrew it
                code = self._exhausted(limit)
            else:
                self._write_checkpoint(self.simulation.snapshot(), self._position())
            finally:
                self._close()
        failed = (self.summary.failure or {}).get("outcome", "diverged")
        outcome = {0: "finished", 3: failed, 130: "interrupted", 143: "stopped"}[code]
        self.folder.write_summary(self.summary.as_dict(self, outcome))
        self._log_list()
        self.folder.log(f"{outcome} at step {self.simulation.step_count}")
        return code

    def _log_list(self) -> None:
        report = self.simulation.method.list_report()
        if report:
            self.folder.log(
                f"neighbor list: skin {report['skin_diameters']:.3g} diameters at the end, "
                f"{report['skin_mean_diameters']:.3g} in the mean; {report['builds']} builds, "
                f"{report['steps_per_build']:.4g} steps each; {report['pairs']} pairs listed"
            )

    def _advance_to_event(self, stopper: Stopper) -> int:
        """Run until the next row, frame or end of stage is due, or a stop is asked for."""
        stage = self.stages[self.stage_index]
        simulation = self.simulation
        while not stopper.reason:
            steps = min(self._steps_to_events(stage))
            if steps <= 0:
                break
            self._checkpoint_if_due()  # here all that is due has been recorded
            begin = time.perf_counter()
            before = simulation.step_count
            simulation.step(min(steps, self.summary.steps_within(LOOK_EVERY)))
            self.summary.add(simulation.step_count - before, time.perf_counter() - begin)
            self._show_progress()
            if self._past_time_limit(stage):
                return 3
        if stopper.reason:
            return 0
        ended = simulation.stage_steps(stage, self.stage_start) <= 0
        self._record_due(last=ended)
        if ended:
            self._end_stage(stage)
        return 0

    def _steps_to_events(self, stage: Stage) -> list[int]:
        row = self._event_mark(stage, self.row_index + 1, self.record.row_interval(stage))
        frame = self._event_mark(stage, self.frame_index + 1, self.record.frame_interval(stage))
        steps_to = self.simulation.steps_to
        end = self.simulation.stage_steps(stage, self.stage_start)
        limit = self.simulation.steps_to_limit(stage, self.stage_start)
        return [min(end, max(1, limit)), steps_to(*row), steps_to(*frame)]

    def _event_mark(
        self, stage: Stage, index: int, interval: tuple[str, float]
    ) -> tuple[float | None, float | None]:
        kind, width = interval
        if kind == "strain":
            return self.stage_start[0] + index * width, None
        return None, self.stage_start[1] + index * width

    def _end_stage(self, stage: Stage) -> None:
        strain, seconds = self.simulation.strain, self.simulation.time
        where = f"strain {strain:.6g}" if self.scene.flow else f"time {seconds:.6g} s"
        self.folder.log(f"stage '{stage.name}' ended at {where}")
        self.summary.end_stage(stage.name, self.simulation.method.stage_result(stage))
        if stage.save:
            arrays, attrs = self._saved_state(self.simulation.snapshot(), {"stage": stage.name})
            write_saved_stage(self.folder.path, stage.name, arrays, attrs)
        self.stage_index += 1
        self.stage_start = (self.simulation.strain, self.simulation.time)
        self.row_index = self.frame_index = 0
        if self.stage_index < len(self.stages):
            self.simulation.begin_stage(self.stages[self.stage_index])
            self._write_checkpoint(self.simulation.snapshot(), self._position())

    def _past_time_limit(self, stage: Stage) -> bool:
        if self.simulation.steps_to_limit(stage, self.stage_start) > 0:
            return False
        if self.simulation.stage_steps(stage, self.stage_start) <= 0:
            return False
        message = self.simulation.unmet(stage)
        self.folder.log(message)
        self.summary.failure = {"outcome": "end condition not met", "message": message}
        return True

    # -- recording --------------------------------------------------------------------------------

    def _record_due(self, last: bool = False) -> None:
        """Write the row and the frame whose marks are reached, and those of a stage's ends."""
        simulation = self.simulation
        if self.stage_index >= len(self.stages):
            return
        stage = self.stages[self.stage_index]
        begin = time.perf_counter()
        first, self.fresh = self.fresh, False
        row_index = self._reached(stage, self.row_index, self.record.row_interval(stage))
        frame_index = self._reached(stage, self.frame_index, self.record.frame_interval(stage))
        step, record = simulation.step_count, self.record
        row_due = first or row_index > self.row_index or (last and record.row_step < step)
        if row_due:
            self.summary.look_at(record.write_row())
            self.row_index = row_index
        if first or frame_index > self.frame_index or (last and record.frame_step < step):
            record.write_frame()
            self.frame_index = frame_index
            if not (first or last):
                self._profile(stage)
        self.summary.recording_seconds += time.perf_counter() - begin
        if row_due:
            self._keep_good()

    def _reached(self, stage: Stage, index: int, interval: tuple[str, float]) -> int:
        """Index of the last mark reached: one step may pass several of them."""
        kind, width = interval
        value = self.simulation.strain if kind == "strain" else self.simulation.time
        start = self.stage_start[0 if kind == "strain" else 1]
        index = max(index, int((value - start) / width))
        while self.simulation.steps_to(*self._event_mark(stage, index + 1, interval)) <= 0:
            index += 1
        return index

    def _profile(self, stage: Stage) -> None:
        """A few steps pass by pass, where that many are left before the next event."""
        if min(self._steps_to_events(stage)) > 2 * PROFILE_STEPS:
            before = self.simulation.step_count
            for name, seconds in self.simulation.pass_times(PROFILE_STEPS).items():
                self.passes.setdefault(name, []).append(seconds)
            self.summary.profiled_steps += self.simulation.step_count - before

    def _show_progress(self) -> None:
        if self.progress is not None:
            self.progress.update(self)

    # -- checkpoints ------------------------------------------------------------------------------

    def _attrs(self) -> dict[str, Any]:
        return {
            "version": versions()["warpfiber"],
            "hash": self.scene.hash,
            "device": self.simulation.device,
            "precision": self.scene.numerics.precision,
            "seed": self.scene.seed,
            "dt": self.simulation.dt,
            **versions(),
        }

    def _position(self) -> dict[str, Any]:
        """Where the run stands among its stages and events."""
        return {
            "stage_index": self.stage_index,
            "stage_strain": self.stage_start[0],
            "stage_time": self.stage_start[1],
            "row_index": self.row_index,
            "frame_index": self.frame_index,
            "wall_seconds": self.summary.wall_seconds,
            "last_row": self.record.last_row,
            "frame_step": self.record.frame_step,
            "half_turns": list(self.summary.half_turns),
            "stage_results": list(self.summary.stage_results),
        }

    def _keep_good(self) -> None:
        """Remember the present state in case a later step diverges."""
        arrays = self.simulation.snapshot()
        if all(np.isfinite(a).all() for a in arrays.values()):
            self.good, self.good_attrs = arrays, self._position()

    def _write_checkpoint(self, arrays: dict[str, np.ndarray], position: dict[str, Any]) -> Path:
        arrays, attrs = self._saved_state(arrays, position)
        self.summary.checkpoint_time = time.perf_counter()
        return write_checkpoint(self.folder.path, int(arrays["step"][0]), arrays, attrs)

    def _saved_state(
        self, arrays: dict[str, np.ndarray], position: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays and attributes of a state with what is needed to build its simulation again."""
        start, group = self.simulation.fiber_node_start, self.simulation.model.host["fiber_group"]
        length = np.asarray(self.simulation.model.units.length)
        layout = {"fiber_node_start": start, "fiber_group": group, "length": length}
        attrs = self._attrs() | position | {"scene": json.dumps(self.scene.as_dict())}
        return arrays | layout, attrs

    def _checkpoint_if_due(self) -> None:
        due = self.scene.record.checkpoint_every
        if time.perf_counter() - self.summary.checkpoint_time > due:
            self._write_checkpoint(self.simulation.snapshot(), self._position())

    def _diverged(self, torn: Diverged) -> int:
        """Last good state as the checkpoint, the bad one beside it for a look."""
        if self.good:
            path = self._write_checkpoint(self.good, self.good_attrs)
            torn.report["message"] += f"; last good state: {path}"
        bad = self.simulation.snapshot()
        write_bad = self.folder.path / "diverged.npz"
        np.savez(write_bad, fiber_node_start=self.simulation.fiber_node_start, **bad)  # type: ignore[arg-type]
        self.folder.log(torn.report["message"])
        self.summary.failure = torn.report
        return 3

    def _exhausted(self, limit: BoxExhausted | SceneError) -> int:
        """A run that met a limit of its scene: its state is good and is kept."""
        path = self._write_checkpoint(self.simulation.snapshot(), self._position())
        message = f"{limit}; state: {path}"
        self.summary.failure = {"outcome": "limit reached", "message": message}
        self.folder.log(str(limit))
        return 3

    def _close(self) -> None:
        self.record.close()
        self.simulation.close()
        if self.progress is not None:
            self.progress.close()


def _faults_of(check: Callable[..., None], *arguments: Any) -> list[Fault]:
    """The faults that a check raises; none if it passes."""
    try:
        check(*arguments)
    except SceneError as found:
        return list(found.faults)
    return []
