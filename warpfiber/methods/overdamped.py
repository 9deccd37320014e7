"""Fibers without inertia: linearly implicit SDIRK2 or BDF2, one banded solve per fiber and stage.

A step: begin (flow at the stages), fibers (`chain_solve`), frozen fibers, end (time, flow, and with
a tolerance the acceptance and the size of the next step). The tension is carried from step to step.
Source: Galerkin drag of the beads, hydrodynamic torque, stretching in compliance form (modulus, or
    segments that keep their length), bending of straight rest shapes; SDIRK2 and its embedded
    first-order error estimate, BDF2 started by one SDIRK2 step.
Limits: no forces between fibers or of walls. Lengths err by O(dt^2) in a turn: a strain of
    `strain_steps.LARGEST_STRAIN` per step is the most that is sensible.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warpfiber.methods.loads import node_loads
from warpfiber.methods.method import Method
from warpfiber.methods.strain_steps import step_start
from warpfiber.model import Model, State
from warpfiber.passes.chain_solve import CHI, make_chain_step
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.executor import Call, Executor, Launch
from warpfiber.passes.held_nodes import make_carry_fibers
from warpfiber.passes.step_control import (
    ERROR_CHUNKS,
    make_largest_error,
    make_step_begin,
    make_step_end,
    make_take_back,
)
from warpfiber.scene import Scene

# Arrays that the next step depends on beside the State.
_CARRIED = ("tension", "tension_back", "node_motion", "step_size", "rejected")


class Overdamped(Method):
    """Advances a State without inertia; with a tolerance `dt` is the largest step."""

    inertia = False

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        super().__init__(scene, model, state, dt, workers)
        p, device, numerics = model.precision, model.device, scene.numerics
        self.adaptive = numerics.tolerance is not None
        self.stages = 1 if numerics.integrator == "bdf2" else 2
        nodes, segments = model.node_count, model.segment_count
        kept = nodes if self.adaptive else 0
        self.tension = wp.zeros(segments, dtype=p.real, device=device)
        self.tension_back = wp.zeros(segments, dtype=p.real, device=device)
        self.node_motion = wp.zeros(nodes, dtype=p.vec3, device=device)  # of the last step
        self.node_back = wp.zeros(kept, dtype=p.vec3, device=device)
        self.velocity_back = wp.zeros(kept, dtype=p.vec3, device=device)
        # The fibers of a worker run one after the other and share rows, which then stay in its
        # cache; what is allocated for the others is never touched.
        most = 1 + max(row["segments"] for row in model.group_rows)
        self.row_stride = -most if device.startswith("cpu") else most
        row = elimination_row(p.name)
        self.rows = wp.empty(most * model.fiber_count, dtype=row, device=device)
        hold, load = node_loads(scene, model)
        self.node_hold = wp.array(hold, dtype=wp.uint8, device=device)
        self.node_load = wp.array(load.astype(p.numpy), dtype=p.vec3, device=device)
        self.fiber_error = wp.zeros(model.fiber_count, dtype=p.real, device=device)
        chunks = min(ERROR_CHUNKS, model.fiber_count) if self.adaptive else 0
        self.error = wp.zeros(chunks, dtype=wp.float64, device=device)
        self.error_fiber = wp.zeros(chunks, dtype=wp.int32, device=device)
        self.stage_gradient = wp.zeros(2, dtype=p.mat33, device=device)
        self.strain_next = wp.zeros(1, dtype=wp.float64, device=device)
        self.ends_lattice = wp.zeros(2, dtype=p.mat33, device=device)  # of the step under way
        self.deformation_next = wp.zeros(1, dtype=wp.mat33d, device=device)
        self.verdict = wp.zeros(2, dtype=wp.int32, device=device)
        self.rejected = wp.zeros(2, dtype=wp.int32, device=device)  # the last step, and in all
        first = step_start(scene) / model.units.time if self.adaptive else self.dt
        self.step_size = wp.array([min(first, self.dt)], dtype=wp.float64, device=device)
        # the guess of the first step is the start: nothing is known of the velocity
        state.node_velocity.zero_()

    # -- the step ---------------------------------------------------------------------------------

    def launches(self) -> list[Launch | Call]:
        """Begin, fibers and end of a step, and what a step that may be rejected needs."""
        return self._launches(self.stages)

    def _launches(self, stages: int) -> list[Launch | Call]:
        model, state = self.model, self.state
        name = model.precision.name
        steps: list[Launch | Call] = [self._begin(), self._solve(stages)]
        if any(group.frozen for group in self.scene.fibers):
            steps.append(self._carry())
        if self.adaptive:
            chunks = self.error.shape[0]
            errors = [chunks, self.fiber_error, self.error, self.error_fiber]
            steps.append(Launch("errors", make_largest_error(name), chunks, errors))
        steps.append(self._end())
        if self.adaptive:
            inputs = [
                self.rejected,
                model.fiber_node_start,
                self.node_back,
                self.velocity_back,
                self.tension_back,
                state.node_pos,
                state.node_velocity,
                self.tension,
            ]
            back = make_take_back(name)
            steps.append(Launch("take_back", back, model.fiber_count, inputs, split=True))
        return steps

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

    def _solve(self, stages: int) -> Launch:
        model, state, p = self.model, self.state, self.model.precision
        inputs = [
            stages,
            1 if self.adaptive else 0,
            self.row_stride,
            p.vec3(*self.flow_origin),
            self.step_size,
            self.stage_gradient,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            self.rows,
            state.node_pos,
            state.node_velocity,
            self.node_motion,
            self.tension,
            self.tension_back,
            self.node_back,
            self.velocity_back,
            self.fiber_error,
            self.node_hold,
            self.node_load,
            state.fiber_image,
            state.lattice,
            state.status,
        ]
        loaded = self.node_hold.shape[0] > 0
        kernel = make_chain_step(p.name, loaded, loaded and model.domain.sheared)
        return Launch("fibers", kernel, model.fiber_count, inputs, split=True)

    def _carry(self) -> Launch:
        model, state = self.model, self.state
        inputs = [
            1 if self.adaptive else 0,
            self.row_stride,
            self.step_size,
            self.stage_gradient,
            model.fiber_node_start,
            self.node_hold,
            self.node_load,
            state.fiber_image,
            state.lattice,
            self.rows,
            state.node_pos,
            state.node_velocity,
            self.node_motion,
            self.node_back,
            self.velocity_back,
            state.status,
        ]
        kernel = make_carry_fibers(model.precision.name, model.domain.sheared, CHI)
        return Launch("frozen", kernel, model.fiber_count, inputs, split=True)

    def _end(self) -> Launch:
        model, state = self.model, self.state
        tolerance = self.scene.numerics.tolerance or 0.0
        kernel = make_step_end(model.precision.name, model.domain.sheared, self.adaptive)
        inputs = [
            wp.mat33d(*self.full_gradient.ravel()),
            self._schedule(),
            wp.float64(tolerance),
            wp.float64(self.dt),
            self.error,
            self.error_fiber,
            self.verdict,
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
        return Launch("end", kernel, 1, inputs)

    def _schedule(self) -> wp.array:
        return wp.array(self.schedule, dtype=wp.vec2d, device=self.model.device)

    def advance(self, steps: int) -> bool:
        """Run up to `steps` steps, the first of BDF2 by SDIRK2; False if a fiber tore."""
        if steps > 0 and self.stages == 1 and self.step_count == 0 and not self._halted():
            self.prepare()
            first = Executor(self._launches(2), self.model.device)
            first.run(1, self._halted)
            first.close()
            steps -= 1
        return super().advance(steps) and self._settle()

    def time_passes(self, steps: int) -> dict[str, float]:
        """Seconds per step of every launch, over `steps` steps of the run."""
        if self.step_count == 0:
            self.advance(1)
        return super().time_passes(steps)

    # -- what is saved and told -------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """Tensions, last displacements and the size of the next step."""
        return {f"overdamped_{name}": getattr(self, name).numpy().copy() for name in _CARRIED}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for name in _CARRIED:
            getattr(self, name).assign(arrays[f"overdamped_{name}"])

    def step_report(self) -> dict[str, float]:
        """Rejected steps and the next dt in s, where there is a tolerance."""
        if not self.adaptive:
            return {}
        return {
            "rejected_steps": int(self.rejected.numpy()[1]),
            "next_dt": float(self.step_size.numpy()[0]) * self.model.units.time,
        }


def overdamped_bytes(nodes: int, segments: int, real: int, adaptive: bool) -> int:
    """Bytes of the arrays above for reals of `real` bytes.

    On the CPU the rows, by far the largest, are allocated but hardly touched.
    """
    per_node = 29 + 3 + (6 if adaptive else 0)  # a row of the elimination, motion, kept state
    return real * (nodes * per_node + 2 * segments)
