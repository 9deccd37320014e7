"""Rigid straight rods without inertia: exact maps of a linear flow, no unknown to solve for.

A step (`implicit`): maps (`passes.rigid_rods`: one matrix exponential per group of fibers), fibers,
contact by `rod_response`. Without contact, orientation and position are exact in the strain of a
step of any size, so a step is as long as the times between outputs allow.
Source: Jeffery orbit of a rigid line of N touching beads; a force moves its center by drag
    6 pi eta a N alone, forces on its ends ([[load]]) turn it (`passes.rigid_rods`).
Symbols: lambda_J = Q / (Q + 4 w) with Q = N (N^2 - 1) and w beads that carry torque (N, or N - 1
    with plain weights); mu = (1 - lambda_J)/2 = 2 w / (Q + 4 w).
Limits: contact is first order in dt. Nothing bends: see `scene.rigidity` for what that leaves out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warpfiber.methods.implicit import Implicit, Launches
from warpfiber.methods.loads import node_loads
from warpfiber.model import Model, State
from warpfiber.passes.executor import Launch
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.rigid_rods import (
    CHUNK,
    make_native_rod_step,
    make_rod_maps,
    make_rod_step,
    rod_map,
)
from warpfiber.passes.rod_response import RodResponse
from warpfiber.scene import Fault, Scene, SceneError


class RigidRod(Implicit):
    """Advances a State of fibers of one segment by exact maps."""

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        _check_nodes(scene)
        super().__init__(scene, model, state, dt, workers)
        mu = [turning_share(row) for row in model.group_rows]
        settling = np.asarray([row["body_force"] / row["drag"] for row in model.group_rows])
        self.shape_mu = wp.array(mu, dtype=wp.float64, device=model.device)
        self.shape_settling = wp.array(settling, dtype=wp.vec3d, device=model.device)
        _, load = node_loads(scene, model)
        p = model.precision
        self.node_load = wp.array(load.astype(p.numpy), dtype=p.vec3, device=model.device)
        shape = rod_map(p.name)
        self.maps = wp.zeros(len(mu), dtype=shape, device=model.device)
        self._make_contact(RodResponse(model))

    # -- the step ---------------------------------------------------------------------------------

    def motion(self) -> Launches:
        """Maps of the step, and the rods by them."""
        return [self._maps(), self._move()]

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
        maps = make_rod_maps(self.model.precision.name, self.module)
        return Launch("maps", maps, self.maps.shape[0], inputs)

    def _move(self) -> Launch:
        model, state, p = self.model, self.state, self.model.precision
        inputs = [
            1 if self.keeps else 0,
            p.vec3(*self.flow_origin),
            self.maps,
            model.fiber_group,
            model.groups,
            model.fiber_group,
            self.step_size,
            self.node_load,
            state.node_pos,
            state.node_velocity,
            self.node_back,
            self.velocity_back,
            state.status,
        ]
        loaded = self.node_load.shape[0] > 0
        alike = len(model.group_rows) == 1 and not loaded
        if alike and model.device.startswith("cpu") and model.fiber_count >= CHUNK:
            native = make_native_rod_step(p.name, kernel_module("rod_lanes", p.name))
            chunks = (model.fiber_count + CHUNK - 1) // CHUNK
            return Launch("fibers", native, chunks, inputs, split=True)
        module = kernel_module("loaded_rods", p.name) if loaded else self.module
        kernel = make_rod_step(p.name, loaded, module)
        return Launch("fibers", kernel, model.fiber_count, inputs, split=True)

    # -- what is told -----------------------------------------------------------------------------

    def contact_bending(self) -> float:
        """Most that the contacts of the last step would bend a fiber of this rod's modulus, in L.

        Their forces on a fiber added up, all where they bend most: F l/(75 k_b), with
        k_b l = E I (scene/rigidity.py).
        """
        if self.contact is None:
            return 0.0
        push = self.contact.fiber_push()
        share = [row["rest"] / (75.0 * max(row["bending"], 1e-30)) for row in self.model.group_rows]
        return float((push * np.asarray(share)[self.model.host["fiber_group"]]).max())

    def step_report(self) -> dict[str, float]:
        """What every implicit method tells, and how far contact would bend these rods."""
        return super().step_report() | {"contact_bending": self.contact_bending()}


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
