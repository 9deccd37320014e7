"""The rows and frames of a run: what `[record]` asks for, written as it is measured."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from warpfiber.methods.bond_constants import is_closed
from warpfiber.output.columns import write_columns
from warpfiber.output.folder import ResultFolder
from warpfiber.output.placement_table import write_placement
from warpfiber.output.scalars import ScalarsWriter
from warpfiber.output.trajectory import TrajectoryWriter
from warpfiber.scene import Scene, Stage
from warpfiber.simulation import Simulation

MOMENT = ("step", "time", "strain")


class Recording:
    """Open `scalars.csv`, `layers.csv` and `run.vtkhdf` of one run."""

    def __init__(
        self,
        scene: Scene,
        simulation: Simulation,
        scalars: ScalarsWriter,
        layers: ScalarsWriter | None,
        trajectory: TrajectoryWriter | None,
        last_row: Mapping[str, float],
        frame_step: int,
    ) -> None:
        self.scene, self.simulation = scene, simulation
        self.scalars, self.layers, self.trajectory = scalars, layers, trajectory
        self.last_row = dict(last_row)
        self.frame_step = frame_step  # step of the last frame, -1 before the first

    @classmethod
    def start(
        cls,
        scene: Scene,
        simulation: Simulation,
        folder: ResultFolder,
        attrs: Mapping[str, Any],
    ) -> Recording:
        """New files, `placement.csv` whole; `attrs` go into the trajectory. Raises RecordError."""
        scalars = ScalarsWriter(folder.scalars_path, list(simulation.measure()))
        columns = {folder.scalars_path.name: scalars.columns}
        layers = trajectory = None
        if scene.record.layers:
            names = [*MOMENT, "layer", *simulation.measure_layers()]
            layers = ScalarsWriter(folder.layers_path, names)
            columns[folder.layers_path.name] = layers.columns
        write_columns(folder.path / "columns.csv", columns)
        write_placement(folder.path / "placement.csv", simulation.placement_report)
        if scene.record.trajectory:
            trajectory = TrajectoryWriter(
                folder.trajectory_path,
                fiber_node_start=simulation.fiber_node_start,
                fiber_group=simulation.model.host["fiber_group"],
                closed_groups=[is_closed(group) for group in scene.fibers],
                scene_json=json.dumps(scene.as_dict()),
                attrs=attrs,
                node_fields=[f"node_{name}" for name in scene.record.node_fields],
                layer_columns=layers.columns[len(MOMENT) + 1 :] if layers is not None else (),
            )
        return cls(scene, simulation, scalars, layers, trajectory, {}, -1)

    @classmethod
    def reopen(
        cls,
        scene: Scene,
        simulation: Simulation,
        folder: ResultFolder,
        last_row: Mapping[str, float],
        frame_step: int,
    ) -> Recording:
        """The files of a stopped run, cut to the present step. Raises RecordError."""
        step = simulation.step_count
        scalars = ScalarsWriter.reopen(folder.scalars_path, step)
        layers = trajectory = None
        if scene.record.layers:
            layers = ScalarsWriter.reopen(folder.layers_path, step)
        if scene.record.trajectory:
            trajectory = TrajectoryWriter.reopen(folder.trajectory_path, step)
        return cls(scene, simulation, scalars, layers, trajectory, last_row, frame_step)

    @property
    def row_step(self) -> int:
        """Step of the last row, -1 before the first."""
        return int(self.last_row.get("step", -1))

    def row_interval(self, stage: Stage) -> tuple[str, float]:
        """What counts ("strain" or "time") from row to row of a stage, and how much of it."""
        return self._share(stage, self.scene.record.scalars)

    def frame_interval(self, stage: Stage) -> tuple[str, float]:
        """The same from frame to frame."""
        record = self.scene.record
        if record.every_strain is not None:
            return "strain", record.every_strain
        if record.every_time is not None:
            return "time", record.every_time
        return self._share(stage, record.frames or 100)

    def _share(self, stage: Stage, count: int) -> tuple[str, float]:
        """`count` even parts of the whole run, in strain where the stages end by strain."""
        flow, stages = self.scene.flow, self.scene.stage_sequence
        if stage.end_strain is not None and flow is not None and flow.rate > 0.0:
            ends = [s.end_strain for s in stages]
            return "strain", sum(e for e in ends if e is not None) / count
        times = [s.end_time or s.time_limit for s in stages]
        return "time", sum(t for t in times if t is not None) / count

    def write_row(self) -> dict[str, float]:
        """Measure now and append the row."""
        self.last_row = self.simulation.measure()
        self.scalars.append(self.last_row)
        return self.last_row

    def write_frame(self) -> None:
        """Append the present positions, what is measured of them, and the layers."""
        simulation = self.simulation
        self.frame_step = simulation.step_count
        layers = simulation.measure_layers()
        self._write_layers(layers)
        if self.trajectory is None:
            return
        row = self.last_row if self.row_step == self.frame_step else simulation.measure()
        fields = simulation.method.node_fields()
        if "velocity" in self.scene.record.node_fields:
            fields["node_velocity"] = simulation.node_velocity
        values: dict[str, Any] = {k: v for k, v in row.items() if k not in MOMENT}
        if layers:
            values["layers"] = np.stack(list(layers.values()), axis=1)
        self.trajectory.append(
            simulation.step_count,
            simulation.time,
            simulation.strain,
            simulation.node_pos,
            simulation.lattice,
            fields,
            values,
        )

    def _write_layers(self, layers: Mapping[str, np.ndarray]) -> None:
        """One row per layer, from low to high."""
        if self.layers is None:
            return
        simulation = self.simulation
        moment = simulation.step_count, simulation.time, simulation.strain
        for k in range(self.scene.record.layers):
            row: dict[str, float | int] = dict(zip(MOMENT, moment, strict=True))
            row["layer"] = k
            self.layers.append(row | {name: float(column[k]) for name, column in layers.items()})

    def close(self) -> None:
        """Close all files."""
        self.scalars.close()
        if self.layers is not None:
            self.layers.close()
        if self.trajectory is not None:
            self.trajectory.close()
