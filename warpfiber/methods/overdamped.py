"""Fibers without inertia: linearly implicit SDIRK2 or BDF2, one banded solve per fiber and stage.

A step (`implicit`): its fibers by `chain_solve`, frozen fibers, contact by `chain_response`. The
tension is carried from step to step.
Source: Galerkin drag of the beads, hydrodynamic torque, stretching in compliance form (modulus, or
    segments that keep their length), bending of straight rest shapes; SDIRK2 and its embedded
    first-order error estimate, BDF2 started by one SDIRK2 step.
Limits: contact is first order in dt. Lengths err by O(dt^2) in a turn: a strain of
    `strain_steps.LARGEST_STRAIN` per step is the most that is sensible.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.methods.implicit import Implicit, Launches
from warpfiber.methods.loads import node_loads
from warpfiber.model import Model, State
from warpfiber.passes.chain_load import ChainLoad
from warpfiber.passes.chain_pace import make_chain_pace
from warpfiber.passes.chain_response import ChainResponse
from warpfiber.passes.chain_solve import CHI, make_chain_step
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.executor import Executor, Launch
from warpfiber.passes.held_nodes import make_carry_fibers
from warpfiber.passes.native_chain import MOST_NODES, chain_blocks, make_native_chain
from warpfiber.passes.native_factor import axes_stride
from warpfiber.scene import Scene

# Fibers per block of lanes from which vectors pay: a block costs 175 ns per node and solve, a fiber
# alone 75 (`tools/bench.py accuracy`).
FILLED = 3
# Arrays that the next step depends on beside the State and those of every implicit method.
_CARRIED = ("tension", "tension_back", "node_motion")


class Overdamped(Implicit):
    """Advances a State without inertia; with a tolerance `dt` is the largest step."""

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        super().__init__(scene, model, state, dt, workers)
        p, device = model.precision, model.device
        self.stages = 1 if scene.numerics.integrator == "bdf2" else 2
        self.tension = wp.zeros(model.segment_count, dtype=p.real, device=device)
        self.tension_back = wp.zeros(model.segment_count, dtype=p.real, device=device)
        self.node_motion = wp.zeros(model.node_count, dtype=p.vec3, device=device)  # last step
        # The fibers of a worker run one after the other and share rows, which then stay in its
        # cache; what is allocated for the others is never touched. Contact needs them all.
        most = 1 + max(row["segments"] for row in model.group_rows)
        shares = device.startswith("cpu") and not self.meets
        self.row_stride = -most if shares else most
        row = elimination_row(p.name)
        self.rows = wp.empty(most * model.fiber_count, dtype=row, device=device)
        hold, load = node_loads(scene, model)
        self.node_hold = wp.array(hold, dtype=wp.uint8, device=device)
        self.node_load = wp.array(load.astype(p.numpy), dtype=p.vec3, device=device)
        # the guess of the first step is the start: nothing is known of the velocity
        state.node_velocity.zero_()
        self.fiber_pace = wp.full(model.fiber_count, p.real(1.0), p.real, device=device)
        # vectors know neither held nodes nor fibers that are carried whole
        self.native = device.startswith("cpu") and self.stages == 2 and most <= MOST_NODES
        self.native = self.native and self.node_hold.shape[0] == 0
        blocks = chain_blocks(p.name, model.host["fiber_group"])
        self.native = self.native and model.fiber_count >= FILLED * (len(blocks) - 1)
        # what factors are found by again, where nothing but a solve for contact asks for them
        self.axes_stride = 0
        if self.native and self.meets and not model.starts_bent:
            self.axes_stride = axes_stride(p.name, most)
        size = self.axes_stride * model.fiber_count
        self.axes = wp.zeros(size, dtype=p.real, device=device)
        self.load: ChainLoad | None = None
        if self.meets:
            response = ChainResponse(
                model,
                self.rows,
                self.row_stride,
                self.tension,
                fiber_pace=self.fiber_pace,
                axes=self.axes,
            )
            # others hold bent what is packed; straight fibers would carry the load to no use
            if model.starts_bent:
                self.load = ChainLoad(model, state, response, self.node_hold, self.node_load)
            self._make_contact(response, self.load)
        # packed fibers near the load at which they buckle would answer contact without bounds
        self.clips = self.contact is not None and self.contact.packed
        self.paced = self.clips
        self.block_start = wp.array(blocks, dtype=wp.int32, device=device)

    # -- the step ---------------------------------------------------------------------------------

    def motion(self) -> Launches:
        """The fibers by their integrator, and the frozen ones."""
        return self._motion(self.stages)

    def _motion(self, stages: int) -> Launches:
        found: Launches = [self._solve(stages)]
        if self.paced:
            found += [self._set_pace(), self._solve(stages, again=True)]
        if any(group.frozen for group in self.scene.fibers):
            found.append(self._carry())
        if self.load is not None:
            found = [self.load.lay_on(), *found, self.load.take_off(self.step_size)]
        return found

    def after(self) -> Launches:
        """The contact forces of a step that is kept."""
        return [] if self.load is None else [self.load.keep(self.rejected)]

    def tensions(self) -> tuple[Any, Any]:
        """Tensions now and at the start of the step."""
        return self.tension, self.tension_back

    def _kept(self) -> int:
        """1 if the start of a step is kept, 2 if a fiber that tears is spared by a shorter one."""
        # forces may tear a packed fiber in one step
        spared = self.adaptive or self.paced
        return (2 if spared else 1) if self.keeps else 0

    def _solve(self, stages: int, again: bool = False) -> Launch:
        if self.native and not again:
            return self._native_solve()
        model, state, p = self.model, self.state, self.model.precision
        hold, given = self.node_hold, self.node_load
        if self.load is not None:
            hold, given = self.load.step_hold, self.load.step_load
        inputs = [
            stages,
            self._kept(),
            1 if again else 0,
            1 if self.clips else 0,
            self.row_stride,
            p.vec3(*self.flow_origin),
            self.step_size,
            self.fiber_pace,
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
            hold,
            given,
            state.fiber_image,
            state.lattice,
            state.status,
        ]
        held = self.node_hold.shape[0] > 0
        kernel = make_chain_step(p.name, hold.shape[0] > 0, held and model.domain.sheared)
        name = "fibers_again" if again else "fibers"
        return Launch(name, kernel, model.fiber_count, inputs, split=True, follows=again)

    def _native_solve(self) -> Launch:
        model, state, p = self.model, self.state, self.model.precision
        loaded = self.load is not None
        inputs = [
            self.block_start,
            self._kept(),
            1 if self.clips else 0,
            0 if self.axes_stride > 0 else self.row_stride,
            self.axes_stride,
            p.vec3(*self.flow_origin),
            self.step_size,
            self.fiber_pace,
            self.stage_gradient,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            self.rows,
            self.axes,
            state.node_pos,
            state.node_velocity,
            self.tension,
            self.tension_back,
            self.node_back,
            self.velocity_back,
            self.fiber_error,
            self.load.step_load if self.load is not None else self.node_load,
            state.status,
        ]
        kernel = make_native_chain(p.name, loaded)
        return Launch("fibers", kernel, self.block_start.shape[0] - 1, inputs, split=True)

    def _set_pace(self) -> Launch:
        model, state, p = self.model, self.state, self.model.precision
        assert self.load is not None
        inputs = [
            p.vec3(*self.flow_origin),
            state.deformation,
            self.deformation_next,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            self.load.step_hold,
            self.node_back,
            self.velocity_back,
            self.tension_back,
            state.status,
            state.node_pos,
            state.node_velocity,
            self.tension,
            self.fiber_pace,
        ]
        kernel = make_chain_pace(p.name)
        # workers share blocks of fibers before, fibers here
        ahead = not self.native
        return Launch("set_pace", kernel, model.fiber_count, inputs, split=True, follows=ahead)

    def _carry(self) -> Launch:
        model, state = self.model, self.state
        inputs = [
            1 if self.keeps else 0,
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

    def advance(self, steps: int) -> bool:
        """Run up to `steps` steps, the first of BDF2 by SDIRK2; False if a fiber tore."""
        if steps > 0 and self.stages == 1 and self.step_count == 0 and not self._halted():
            self.prepare()
            first = Executor(self._around(self._motion(2)), self.model.device)
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
        """Tensions and last displacements beside what every implicit method saves."""
        own = {f"overdamped_{name}": getattr(self, name).numpy().copy() for name in _CARRIED}
        if self.load is not None:
            own["overdamped_contact_load"] = self.load.contact_load.numpy().copy()
        return super().saved() | own

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        super().restore(arrays)
        for name in _CARRIED:
            getattr(self, name).assign(arrays[f"overdamped_{name}"])
        if self.load is not None:
            self.load.restore(arrays["overdamped_contact_load"])


def overdamped_bytes(nodes: int, segments: int, real: int, adaptive: bool) -> int:
    """Bytes of the arrays above for reals of `real` bytes.

    On the CPU the rows, by far the largest, are allocated but hardly touched.
    """
    # a row of the elimination or axes instead, motion, kept state
    per_node = 29 + 4 + 3 + (6 if adaptive else 0)
    return real * (nodes * per_node + 2 * segments)
