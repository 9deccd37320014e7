"""Rigid straight rods without inertia: exact maps of a linear flow, no unknown to solve for.

A step: begin (time, flow, lattice), maps (`passes.rigid_rods`: one matrix exponential per group of
fibers), fibers, end. Orientation and position are exact in the strain of a step of any size, so a
step is as long as the times between outputs allow.
Source: Jeffery orbit of a rigid line of N touching beads; a force moves its center by drag
    6 pi eta a N alone.
Symbols: lambda_J = Q / (Q + 4 w) with Q = N (N^2 - 1) and w beads that carry torque (N, or N - 1
    with plain weights); mu = (1 - lambda_J)/2 = 2 w / (Q + 4 w).
Limits: no forces between fibers or of walls. Nothing bends: see `scene.rigidity` for what that
    leaves out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warpfiber.methods.method import Method
from warpfiber.model import Model, State
from warpfiber.passes.executor import Call, Launch
from warpfiber.passes.rigid_rods import make_rod_maps, make_rod_step, rod_map
from warpfiber.passes.step_control import make_step_begin, make_step_end
from warpfiber.scene import Fault, Scene, SceneError


class RigidRod(Method):
    """Advances a State of fibers of one segment by exact maps."""

    inertia = False

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        _check_nodes(scene)
        super().__init__(scene, model, state, dt, workers)
        p, device = model.precision, model.device
        self.node_back = wp.zeros(0, dtype=p.vec3, device=device)
        self.velocity_back = wp.zeros(0, dtype=p.vec3, device=device)
        mu = [turning_share(row) for row in model.group_rows]
        settling = np.asarray([row["body_force"] / row["drag"] for row in model.group_rows])
        self.shape_mu = wp.array(mu, dtype=wp.float64, device=device)
        self.shape_settling = wp.array(settling, dtype=wp.vec3d, device=device)
        self.maps = wp.zeros(len(mu), dtype=rod_map(p.name), device=device)
        self.stage_gradient = wp.zeros(2, dtype=p.mat33, device=device)
        self.strain_next = wp.zeros(1, dtype=wp.float64, device=device)
        self.ends_lattice = wp.zeros(2, dtype=p.mat33, device=device)  # of the step under way
        self.deformation_next = wp.zeros(1, dtype=wp.mat33d, device=device)
        self.rejected = wp.zeros(2, dtype=wp.int32, device=device)
        self.step_size = wp.array([self.dt], dtype=wp.float64, device=device)

    def keep_start(self) -> None:
        """From the first step on, leave the start of each in `node_back` and `velocity_back`."""
        p, nodes = self.model.precision, self.model.node_count
        self.node_back = wp.zeros(nodes, dtype=p.vec3, device=self.model.device)
        self.velocity_back = wp.zeros(nodes, dtype=p.vec3, device=self.model.device)

    # -- the step ---------------------------------------------------------------------------------

    def launches(self) -> list[Launch | Call]:
        """Begin, maps, fibers and end of a step."""
        return [self._begin(), self._maps(), self._move(), self._end()]

    def _begin(self) -> Launch:
        state = self.state
        inputs = [
            wp.float64(self.flow_rate),
            wp.mat33d(*self.full_gradient.ravel()),
            self._schedule(),
            self.step_size,
            state.strain,
            state.lattice,
            state.deformation,
            state.status,
            self.rejected,
            self.strain_next,
            self.stage_gradient,
            self.ends_lattice,
            self.deformation_next,
        ]
        begin = make_step_begin(self.model.precision.name, self.model.domain.sheared)
        return Launch("begin", begin, 1, inputs)

    def _maps(self) -> Launch:
        inputs = [
            wp.float64(self.flow_rate),
            wp.mat33d(*self.full_gradient.ravel()),
            self.shape_mu,
            self.shape_settling,
            self.step_size,
            self.state.strain,
            self.strain_next,
            self.stage_gradient,
            self.state.status,
            self.maps,
        ]
        maps = make_rod_maps(self.model.precision.name)
        return Launch("maps", maps, self.maps.shape[0], inputs)

    def _move(self) -> Launch:
        model, state, p = self.model, self.state, self.model.precision
        inputs = [
            1 if self.node_back.shape[0] else 0,
            p.vec3(*self.flow_origin),
            self.maps,
            model.fiber_group,
            model.groups,
            model.fiber_group,
            state.node_pos,
            state.node_velocity,
            self.node_back,
            self.velocity_back,
            state.status,
        ]
        return Launch("fibers", make_rod_step(p.name), model.fiber_count, inputs, split=True)

    def _end(self) -> Launch:
        model, state = self.model, self.state
        none, nobody = (wp.zeros(0, dtype=t, device=model.device) for t in (wp.float64, wp.int32))
        inputs = [
            wp.mat33d(*self.full_gradient.ravel()),
            self._schedule(),
            wp.float64(0.0),  # no tolerance: no step is rejected
            wp.float64(self.dt),
            none,
            nobody,
            nobody,
            self.strain_next,
            self.step_size,
            self.rejected,
            state.step,
            state.time,
            state.strain,
            state.gradient,
            state.lattice,
            state.lattice_now,
            state.deformation,
            state.status,
        ]
        end = make_step_end(model.precision.name, model.domain.sheared, adaptive=False)
        return Launch("end", end, 1, inputs)

    def _schedule(self) -> wp.array:
        return wp.array(self.schedule, dtype=wp.vec2d, device=self.model.device)

    # -- what is saved and told -------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """Nothing: the nodes are all that the next step depends on."""
        return {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""


def turning_share(row: Mapping[str, float]) -> float:
    """mu = (1 - lambda_J)/2 of the rods of a group."""
    beads = row["spacing"] + 1.0
    torque = row["weight"] + 2.0 * row["weight_excess"]
    drag = beads * (beads * beads - 1.0)
    return 2.0 * torque / (drag + 4.0 * torque)


def _check_nodes(scene: Scene) -> None:
    """Raise SceneError for nodes from a file that are no rods."""
    faults = [
        Fault(
            scene.path,
            f"fibers.{index}.node_file",
            group.node_file,
            f"its fibers have {group.segments + 1} nodes, a rod has 2; give the ends alone, or use "
            'method = "overdamped"',
        )
        for index, group in enumerate(scene.fibers)
        if group.segments != 1
    ]
    if faults:
        raise SceneError(faults)
