"""What a run cost and where it ended: `summary.json`, and the step rate that paces the loop."""

from __future__ import annotations

import math
import platform
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from warpfiber.simulation import Simulation


def versions() -> dict[str, str]:
    """Versions of what decides a result."""
    names = ("warpfiber", "warp-lang", "numpy", "h5py")
    found = {}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "source tree" if name == "warpfiber" else "not installed"
    return found | {"python": platform.python_version()}


class Summary:
    """Counts wall time and steps of a run."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.wall_before = 0.0
        self.started = self.checkpoint_time = time.perf_counter()
        self.stepping_seconds = 0.0
        self.recording_seconds = 0.0
        self.steps = 0
        self.profiled_steps = 0
        self.failure: dict[str, Any] | None = None
        self.half_turns: list[float] = []
        self.stage_results: list[dict[str, Any]] = []
        self._last: dict[str, float] = {}

    def begin(self) -> None:
        """Start the clocks: compilation is over."""
        self.setup_seconds = time.perf_counter() - self.started
        self.checkpoint_time = time.perf_counter()

    setup_seconds = 0.0

    def add(self, steps: int, seconds: float) -> None:
        """Count steps that were taken."""
        self.steps += steps
        self.stepping_seconds += seconds

    def steps_within(self, seconds: float) -> int:
        """Steps that take about this long, at least one; few as long as nothing is known."""
        if self.stepping_seconds < 1e-3:
            return 8 if self.steps == 0 else 2 * self.steps
        return max(1, int(seconds * self.steps / self.stepping_seconds))

    @property
    def step_rate(self) -> float:
        """Steps per second so far."""
        return self.steps / max(self.stepping_seconds, 1e-9)

    @property
    def wall_seconds(self) -> float:
        """Wall time of the run so far, earlier parts of a resumed run included."""
        return self.wall_before + time.perf_counter() - self.started

    def restore(
        self,
        last_row: dict[str, float],
        half_turns: list[float],
        stage_results: list[dict[str, Any]],
    ) -> None:
        """Go on looking for half turns where the stopped run left off; keep what stages showed."""
        self._last, self.half_turns = last_row, list(half_turns)
        self.stage_results = list(stage_results)

    def end_stage(self, name: str, result: dict[str, float]) -> None:
        """Keep what a stage has shown, if anything."""
        if result:
            self.stage_results.append({"stage": name, **result})

    def look_at(self, row: dict[str, float]) -> None:
        """Find the strains at which the mean end-to-end angle passes -k pi (half turns)."""
        if "angle" in row and self._last:
            target = -3.141592653589793 * (len(self.half_turns) + 1)
            before, now = self._last["angle"], row["angle"]
            if now <= target < before:
                part = (before - target) / (before - now)
                start = self._last["strain"]
                self.half_turns.append(start + part * (row["strain"] - start))
        self._last = row

    def as_dict(self, job: Any, outcome: str) -> dict[str, Any]:
        """Everything for `summary.json`."""
        simulation, model = self.simulation, self.simulation.model
        segments = model.segment_count
        pairs, limit = simulation.method.list, simulation.limits[0]
        per_segment = 1e9 / max(1, segments)
        passes = {
            name: round(sorted(times)[len(times) // 2] * per_segment, 2)
            for name, times in job.passes.items()
        }
        taken = max(1, self.steps + self.profiled_steps)
        if pairs is not None:
            passes["list"] = round(simulation.method.list_seconds / taken * per_segment, 2)
        result: dict[str, Any] = {
            "outcome": outcome,
            "final": job.record.last_row,
            "counts": {
                "fibers": model.fiber_count,
                "nodes": model.node_count,
                "segments": segments,
                "pairs_listed": pairs.pair_count if pairs else 0,
                "list_builds": pairs.build_count if pairs else 0,
                "list_growths": pairs.grow_count if pairs else 0,
            },
            "list": simulation.method.list_report(),
            "method": simulation.scene.numerics.method,
            "method_reason": simulation.scene.method_reason,
            "steps": simulation.step_count,
            "dt": simulation.dt,
            **simulation.method.step_report(),
            "dt_limit": limit.dt if math.isfinite(limit.dt) else None,
            "dt_limit_term": limit.term,
            "wall_seconds": round(self.wall_seconds, 3),
            "setup_seconds": round(self.setup_seconds, 3),
            "stepping_seconds": round(self.stepping_seconds, 3),
            "recording_seconds": round(self.recording_seconds, 3),
            "ns_per_segment_step": round(
                self.stepping_seconds / max(1, self.steps) * per_segment, 2
            ),
            "ns_per_segment_step_by_pass": passes,
            "device": simulation.device,
            "workers": simulation.method.workers,
            "precision": simulation.scene.numerics.precision,
            "placement": simulation.placement_report,
            "hash": simulation.scene.hash,
            "scene_path": str(Path(simulation.scene.path).resolve()),
            "versions": versions(),
        }
        if self.half_turns:
            result["half_turn_strain"] = self.half_turns
            flow = simulation.scene.flow
            if flow is not None and not flow.schedule:
                first = self.half_turns[0]
                result["period_from_first_half_turn"] = 2.0 * first / flow.rate
                if len(self.half_turns) > 1:
                    second = self.half_turns[1] - first
                    result["period_from_second_half_turn"] = 2.0 * second / flow.rate
        if self.stage_results:
            result["stages"] = self.stage_results
        if self.failure is not None:
            result["failure"] = self.failure
        return result
