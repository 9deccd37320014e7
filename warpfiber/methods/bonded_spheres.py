"""Fibers as spheres joined by elastic bonds, after Xu, Ma & Guo 2023: translation and rotation.

A step: clock, bonds (kick, drift, loads of bonds, walls, weight and single nodes, kick).
Source: bonds in total form with the placed shape as the stress-free one (`laws.bond`), velocity
    Verlet, plane walls by Hertz. The paper adds up moments step by step; here they follow from the
    state.
Limits: no contact between fibers, frictionless walls; dt below `bond_constants.bond_steps`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.methods.bond_constants import bond_constants, is_closed
from warpfiber.methods.method import Method
from warpfiber.model import Model, State
from warpfiber.passes.bond_energy import ENERGIES, make_measure_bonds, measure_bond_energies
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.bonds import (
    CLAMPED,
    END_SPEED,
    FREE,
    HELD,
    SETTLING,
    STAGE_SIZE,
    BondFeatures,
    make_bond_sweep,
)
from warpfiber.passes.clock import make_clock
from warpfiber.passes.executor import Call, Executor, Launch
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.scene import FiberGroup, Scene, Stage

STILL_TIME = 0.01  # s for which all nodes must be slower than `end_speed`

# Arrays that the next step depends on beside the State.
_CARRIED = (
    "bond_axis bond_length node_turn node_spin node_rate node_spin_rate still_steps place"
).split()
_HOLDS = {"free": FREE, "position": HELD, "clamp": CLAMPED}


class BondedSpheres(Method):
    """Advances a State of nodes that also turn."""

    own_energy = True

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        super().__init__(scene, model, state, dt, workers)
        p, device, nodes = model.precision, model.device, model.node_count
        self.started = False
        self.features = BondFeatures(
            dashpots=any(group.bond_damping > 0.0 for group in scene.fibers),
            walls=model.domain.wall,
            loads=bool(scene.loads),
            closed=any(is_closed(group) for group in scene.fibers),
        )
        self.groups = wp.array(
            [self._group(group) for group in scene.fibers],
            dtype=bond_group_struct(p.name),
            device=device,
        )
        axis, length = self._stress_free()
        self.bond_axis = wp.array(axis.astype(p.numpy), dtype=p.vec3, device=device)
        self.bond_length = wp.array(length.astype(p.numpy), dtype=p.real, device=device)
        hold, load = self._loads()
        self.node_hold = wp.array(hold, dtype=wp.int32, device=device)
        self.node_load = wp.array(load.astype(p.numpy), dtype=p.vec3, device=device)
        identity = np.tile(np.array([0.0, 0.0, 0.0, 1.0], dtype=p.numpy), (nodes, 1))
        self.node_turn = wp.array(identity, dtype=p.vec4, device=device)
        self.node_spin = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.node_rate = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.node_spin_rate = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.still_steps = wp.zeros(model.fiber_count, dtype=wp.int32, device=device)
        self.stage = wp.zeros(STAGE_SIZE, dtype=p.real, device=device)
        self.still_needed = math.ceil(STILL_TIME / (self.dt * model.units.time))
        # float64 in every precision: world positions in float32 lose slow motion
        self.place = state.node_pos
        if p.name == "float32":
            self.place = wp.zeros(nodes, dtype=wp.vec3d, device=device)

    # -- building ---------------------------------------------------------------------------------

    def _group(self, group: FiberGroup) -> Any:
        """Constants of a group in run units."""
        p, units = self.model.precision, self.model.units
        c = bond_constants(self.scene, group)
        linear, angular = units.force / units.length, units.force * units.length
        scale = np.array([linear, linear, angular, angular])
        inertia = units.mass * units.length**2
        row = bond_group_struct(p.name)()
        row.radius = group.radius / units.length
        row.stiffness = p.vec4(*(np.asarray(c.stiffness) / scale))
        row.dashpots = p.vec4(*(np.asarray(c.dashpots) / (scale * units.time)))
        row.mass, row.end_mass = c.mass / units.mass, c.end_mass / units.mass
        row.inertia, row.end_inertia = c.inertia / inertia, c.end_inertia / inertia
        weight = np.zeros(3)
        if self.scene.gravity is not None and group.density:
            buoyant = 1.0 - self.scene.gravity.fluid_density / group.density
            weight = buoyant * np.asarray(self.scene.gravity.acceleration)
        row.weight = p.vec3(*(weight * units.time**2 / units.length))
        row.wall_modulus = c.wall_modulus * units.length**2 / units.force
        row.torn_length = TEAR_STRETCH * c.segment_length / units.length
        row.closed = int(is_closed(group))
        return row

    def _stress_free(self) -> tuple[np.ndarray, np.ndarray]:
        """Direction and length of the bond from every node to the next one of its fiber."""
        nodes = self.state.node_pos.numpy().astype(float)
        start = self.model.host["fiber_node_start"]
        after = np.arange(len(nodes)) + 1
        after[start[1:] - 1] = start[:-1]
        chord = nodes[after] - nodes
        length = np.linalg.norm(chord, axis=1)
        return chord / length[:, None], length

    def _loads(self) -> tuple[np.ndarray, np.ndarray]:
        """How every node is held, and its force, or its velocity where it is held."""
        model, units = self.model, self.model.units
        count = model.node_count if self.features.loads else 0
        hold, load = np.zeros(count, dtype=np.int32), np.zeros((count, 3))
        start, group = model.host["fiber_node_start"], model.host["fiber_group"]
        for entry in self.scene.loads:
            fiber = np.flatnonzero(group == entry.group % len(self.scene.fibers))[entry.fiber]
            node = np.arange(start[fiber], start[fiber + 1])[entry.node]
            hold[node] = _HOLDS[entry.hold]
            if entry.hold == "free":
                load[node] += np.asarray(entry.force or (0.0, 0.0, 0.0)) / units.force
            else:
                load[node] = np.asarray(entry.velocity or (0.0, 0.0, 0.0)) / units.velocity
        return hold, load

    # -- the step ---------------------------------------------------------------------------------

    def launches(self) -> list[Launch | Call]:
        """Clock and bonds."""
        return [self._clock(), self._bonds(moves=True)]

    def _clock(self) -> Launch:
        state, model = self.state, self.model
        inputs = [
            wp.float64(self.dt),
            wp.float64(0.0),
            wp.mat33d(),
            wp.array(self.schedule, dtype=wp.vec2d, device=model.device),
            state.status,
            state.step,
            state.time,
            state.strain,
            state.gradient,
            state.lattice,
            state.lattice_now,
            state.deformation,
        ]
        return Launch("clock", make_clock(model.precision.name, False, False), 1, inputs)

    def _bonds(self, moves: bool) -> Launch:
        model, state, p = self.model, self.state, self.model.precision
        low, high = self._walls()
        inputs = [
            p.real(self.dt),
            low,
            high,
            p.real(self.scene.contact.damping),
            self.stage,
            self.groups,
            model.fiber_node_start,
            model.fiber_group,
            self.bond_axis,
            self.bond_length,
            self.node_hold,
            self.node_load,
            self.place,
            state.node_pos,
            state.node_velocity,
            self.node_turn,
            self.node_spin,
            self.node_rate,
            self.node_spin_rate,
            self.still_steps,
            state.status,
        ]
        kernel = make_bond_sweep(p.name, self.features, moves)
        return Launch("bonds", kernel, model.fiber_count, inputs, split=True)

    def _walls(self) -> tuple[Any, Any]:
        low = np.asarray(self.model.domain.low)
        return wp.vec3d(*low), wp.vec3d(*(low + np.asarray(self.model.domain.size)))

    def prepare(self, measuring: Iterable[Any] = ()) -> None:
        """Compile and capture; find the accelerations of the start."""
        kernels = list(measuring)
        if self.executor is None and "energy" in self.scene.record.quantities:
            kernels.append(make_measure_bonds(self.model.precision.name, self.features.walls))
        super().prepare(kernels)
        if self.started:
            return
        self.started = True
        if self.place is not self.state.node_pos:
            self.place.assign(self.state.node_pos.numpy().astype(float))
        begin = Executor([self._bonds(moves=False)], self.model.device)
        begin.run(1, self._halted)
        begin.close()

    def begin_stage(self, stage: Stage, *, resumed: bool = False) -> None:
        """Take over the damping of a stage; count anew how long all nodes have been still."""
        units = self.model.units
        numbers = np.zeros(STAGE_SIZE, dtype=self.model.precision.numpy)
        numbers[SETTLING] = stage.damping * units.time
        numbers[END_SPEED] = ((stage.end_speed or 0.0) / units.velocity) ** 2
        self.stage.assign(numbers)
        if not resumed:
            self.still_steps.zero_()

    def steps_left(self, stage: Stage) -> int | None:
        """Steps before which `end_speed` surely does not end the stage; None without it."""
        if stage.end_speed is None:
            return None
        return max(0, self.still_needed - int(self.still_steps.numpy().min()))

    def unmet(self, stage: Stage) -> str:
        """What `end_speed` still waits for."""
        if stage.end_speed is None:
            return ""
        velocity = self.state.node_velocity.numpy().astype(float)
        fastest = float(np.linalg.norm(velocity, axis=1).max()) * self.model.units.velocity
        return f"end_speed = {stage.end_speed:g} m/s; the fastest node moves at {fastest:.4g} m/s"

    # -- what is saved and told -------------------------------------------------------------------

    def measure(self) -> dict[str, float]:
        """Energies in J, where `record.quantities` asks for them."""
        if "energy" not in self.scene.record.quantities:
            return {}
        model, walls = self.model, self.features.walls
        inputs = [
            *self._walls(),
            self.groups,
            model.fiber_node_start,
            model.fiber_group,
            self.bond_axis,
            self.bond_length,
            self.place,
            self.state.node_velocity,
            self.node_turn,
            self.node_spin,
        ]
        found = measure_bond_energies(
            model.precision.name, walls, model.fiber_count, inputs, model.device
        )
        absent = {"gravity"} if self.scene.gravity is None else set()
        absent |= set() if any(walls) else {"wall"}
        return {
            f"energy_{name}": found[name] * model.units.energy
            for name in ENERGIES
            if name not in absent
        }

    def saved(self) -> dict[str, np.ndarray]:
        """Stress-free shape, turns, spins and accelerations of the nodes."""
        return {f"bonds_{name}": getattr(self, name).numpy().copy() for name in _CARRIED}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for name in _CARRIED:
            getattr(self, name).assign(arrays[f"bonds_{name}"])
        self.started = True

    def torn_fiber(self) -> dict[str, Any]:
        """First torn fiber, its worst node, and the pull (N) of its longest bond."""
        found = super().torn_fiber()
        return found | {
            "terms": {"stretching": found["terms"]["stretching"]},
            "largest_term": "stretching",
        }
