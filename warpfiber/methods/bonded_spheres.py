"""Fibers as spheres joined by elastic bonds, after Xu, Ma & Guo 2023: translation and rotation.

A step: clock, bonds (kick, drift, loads of bonds, walls, weight and single nodes, kick). Where
fibers meet, drift (kick, drift), pairs (contact of segments) and bonds (loads, kick). Walls move
after the clock and are metered in the end. On the CPU many fibers that meet take the same steps in
vectors (`native_bonds`).
Source: bonds in total form with the placed shape as the stress-free one (`laws.bond`), velocity
    Verlet, contacts by Hertz, Mindlin and Coulomb. The paper adds up bond moments step by step;
    here they follow from the state.
Limits: walls are planes of the box; dt below `stability.step_limits`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.methods.bed_measures import NODE_FIELDS, contact_forces, inclination_row
from warpfiber.methods.bed_stages import BedStages
from warpfiber.methods.bond_constants import bond_constants, is_closed
from warpfiber.methods.bonded_contacts import BondedContacts
from warpfiber.methods.bonded_launches import (
    bond_launch,
    clock_launch,
    drift_launch,
    pair_launches,
)
from warpfiber.methods.energies import Energies
from warpfiber.methods.method import Method
from warpfiber.methods.native_bonds import NativeBonds
from warpfiber.model import EXPIRED, TORN, Model, State
from warpfiber.passes.bond_groups import bond_group_struct
from warpfiber.passes.bonds import END_SPEED, SETTLING, STAGE_SIZE, BondFeatures
from warpfiber.passes.executor import Call, Executor, Launch, Repeat, load_kernels
from warpfiber.passes.native_bonds import native_bonds_apply
from warpfiber.passes.native_bonds_source import FROM_NODES, LOADS
from warpfiber.passes.near_pairs import PAIR_COST
from warpfiber.passes.node_walls import SIDES
from warpfiber.passes.nodes import TEAR_STRETCH
from warpfiber.passes.pair_groups import make_pair_group_table
from warpfiber.scene import Fault, FiberGroup, Scene, SceneError, Stage
from warpfiber.scene.containers import container
from warpfiber.scene.gripping import GRIPPING
from warpfiber.scene.planes import free_planes, rubs, wall_faces

NATIVE = True  # vectorized sweeps on the CPU; False runs there what CUDA runs

LISTED_COST = 8.0  # as `skin.PAIR_COST`, of the plain sweeps; from 4 to 16 within 10 %

# Arrays that the next step depends on beside the State.
_CARRIED = (
    "bond_axis bond_length node_turn node_spin node_rate node_spin_rate still_steps place "
    "wall_memory wall_depth"
).split()


class BondedSpheres(Method):
    """Advances a State of nodes that also turn."""

    own_energy = True

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        super().__init__(scene, model, state, dt, workers)
        p, device, nodes = model.precision, model.device, model.node_count
        self.started = False
        self.bed = BedStages(self)
        self.press, self.grips, self.holds = self.bed.press, self.bed.grips, self.bed.holds
        self.features = BondFeatures(
            dashpots=any(group.bond_damping > 0.0 for group in scene.fibers),
            walls=model.domain.wall,
            loads=self.holds.used,
            closed=any(is_closed(group) for group in scene.fibers),
            pairs=scene.contact.law != "none" and model.segment_count > 1,
            wall_friction=rubs(scene),
            container=container(scene) is not None,
            planes=len(free_planes(scene)),
            press=self.press.axis,
            grips=self.grips.used,
        )
        self.groups = wp.array(
            [self._group(group) for group in scene.fibers],
            dtype=bond_group_struct(p.name),
            device=device,
        )
        self.pair_groups = make_pair_group_table(p.name, self.groups, device)
        axis, length = self._stress_free()
        self.bond_axis = wp.array(axis.astype(p.numpy), dtype=p.vec3, device=device)
        self.bond_length = wp.array(length.astype(p.numpy), dtype=p.real, device=device)
        identity = np.tile(np.array([0.0, 0.0, 0.0, 1.0], dtype=p.numpy), (nodes, 1))
        self.node_turn = wp.array(identity, dtype=p.vec4, device=device)
        self.node_spin = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.node_rate = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.node_spin_rate = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.still_steps = wp.zeros(model.fiber_count, dtype=wp.int32, device=device)
        kept = (SIDES + self.features.planes) * nodes if self.features.wall_friction else 0
        faces = np.asarray(wall_faces(scene)) / [1.0, *[model.units.velocity] * 3]
        self.wall_face = wp.array(faces.astype(p.numpy), dtype=p.vec4, device=device)
        self.wall_memory = wp.zeros(kept, dtype=p.vec3, device=device)
        self.wall_depth = wp.zeros(kept, dtype=p.real, device=device)
        self.stage = wp.zeros(STAGE_SIZE, dtype=p.real, device=device)
        # float64 in every precision: world positions in float32 lose slow motion
        self.place = state.node_pos
        if p.name == "float32":
            self.place = wp.zeros(nodes, dtype=wp.vec3d, device=device)
        vectors = NATIVE and native_bonds_apply(model, self.features)
        self.contacts: BondedContacts | None = None
        if self.features.pairs:
            stretch = float(self._segment_stretch().max())
            self.contacts = BondedContacts(
                scene,
                model,
                state,
                self.workers,
                stretch,
                PAIR_COST if vectors else LISTED_COST,
                vectors=vectors,
            )
            self.list = self.contacts.search.list
            self.pair_features = self.contacts.measured
        self.native: NativeBonds | None = None
        if vectors:
            self.native = NativeBonds(self)
        self.energies = Energies(self)

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
        stress = units.force / units.length**2
        row.wall_modulus = c.wall_modulus / stress
        row.compliance = c.compliance * stress
        row.shear_compliance = c.shear_compliance * stress
        row.segments = group.segments - is_closed(group)  # without a ring's closing one
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

    # -- the step ---------------------------------------------------------------------------------

    def launches(self) -> list[Launch | Call | Repeat]:
        """Clock and bonds; drift and pairs before the bonds where fibers meet."""
        begin = [clock_launch(self), *self.press.motion()]
        end = [*self.press.meter(), *self.grips.meter(), *self.energies.losses()]
        if self.contacts is None:
            return [*begin, bond_launch(self, drifts=True, kicks=True), *end]
        return [
            *begin,
            drift_launch(self),
            *pair_launches(self, self.dt),
            bond_launch(self, drifts=False, kicks=True),
            *end,
        ]

    @property
    def counted_fibers(self) -> int:
        """Those that are poured; at least one, so that there is something to measure."""
        return max(1, self.bed.pour.count)

    @property
    def box_width(self) -> float:
        """Smallest height that a periodic box may have, run units; with the start skin."""
        return self.contacts.search.box_width if self.contacts is not None else 0.0

    def prepare(self, measuring: Iterable[Any] = ()) -> None:
        """Compile and capture; find the accelerations of the start."""
        kernels = list(measuring)
        if self.executor is None:
            kernels += self.energies.kernels()
        if self.contacts is not None:
            kernels += self.contacts.kernels()
        self._prepare_steps(kernels)
        if self.started:
            return
        self.started = True
        if self.place is not self.state.node_pos:
            self.place.assign(self.state.node_pos.numpy().astype(float))
        first: list[Launch | Call | Repeat] = [self._rates()]
        if self.contacts is not None:
            replaced = self.contacts.build(self.step_count)
            self._find_near()
            if replaced:
                self._stop_executor()
                self._prepare_steps([])  # a list that grew has other arrays
            if self.native is not None:
                first = [self.native.pair_launch(0.0, keeps=True), self._rates()]
            else:
                first = [*pair_launches(self, 0.0), self._rates()]
        begin = Executor(first, self.model.device)
        begin.run(1, self._halted)
        begin.close()

    def _prepare_steps(self, kernels: list[Any]) -> None:
        if self.executor is None and self.native is not None:
            load_kernels([*self.native.kernels(), *kernels], self.model.device)
            self.executor = self.native.steps()
        super().prepare(kernels)

    def _rates(self) -> Launch:
        """Accelerations of the start."""
        if self.native is not None:
            return self.native.launch(LOADS | FROM_NODES)
        return bond_launch(self, drifts=False, kicks=False)

    def _settle(self) -> bool:
        """Build the list anew if it has expired; False if a fiber tore."""
        status = self._status()
        if status[TORN]:
            return False
        if status[EXPIRED] and self.native is not None and self.native.near.lasts():
            self.native.near.find()
            status[EXPIRED] = 0
        if status[EXPIRED] and self.contacts is not None:
            replaced = self.contacts.expire(self.step_count)
            if replaced is None or not self._find_near():
                remedy = "fibers move farther in one step than any skin; give a smaller dt"
                raise SceneError([Fault(self.scene.path, "numerics.dt", None, remedy)])
            if replaced:
                self._stop_executor()
            self.list_seconds = self.contacts.search.seconds
        return True

    def _find_near(self) -> bool:
        """Near pairs of a new list; False if they do not last a step."""
        if self.native is None:
            return True
        near = self.native.near
        lasting = near.lasts() or near.lasts_a_step()
        near.find()
        return lasting

    def rebuild_list(self) -> None:
        """List the pairs of the present positions: some node was set elsewhere."""
        if self.contacts is None:
            return
        replaced = self.contacts.build(self.step_count)
        self._find_near()
        if replaced:
            self._stop_executor()

    def list_report(self) -> dict[str, float]:
        """What the search for pairs did; nothing without a list."""
        if self.contacts is None:
            return {}
        report = self.contacts.search.report(self.step_count)
        return report | (self.native.near.report() if self.native is not None else {})

    def close(self) -> None:
        """Stop worker threads."""
        super().close()
        if self.contacts is not None:
            self.contacts.search.close()
        if self.native is not None:
            self.native.near.close()

    # -- stages -----------------------------------------------------------------------------------

    def begin_stage(self, stage: Stage, *, resumed: bool = False) -> None:
        """Take over the damping of a stage and what it does to the bed."""
        units = self.model.units
        numbers = np.zeros(STAGE_SIZE, dtype=self.model.precision.numpy)
        numbers[SETTLING] = stage.damping * units.time
        numbers[END_SPEED] = ((stage.end_speed or 0.0) / units.velocity) ** 2
        self.stage.assign(numbers)
        self.bed.begin_stage(stage, resumed=resumed)

    def advance(self, steps: int) -> bool:
        """Run `steps` steps, with a stop wherever fibers are due to be poured."""
        target = self.step_count + steps
        while (step := self.step_count) < target:
            self.bed.pour_due(step)
            if not super().advance(min(target - step, self.bed.pour.steps_left(step))):
                return False
        return True

    def time_passes(self, steps: int) -> dict[str, float]:
        """As of every method; nothing while fibers are poured, which is between steps."""
        return {} if self.bed.pour.waits else super().time_passes(steps)

    def steps_left(self, stage: Stage) -> int | None:
        """Steps before which no condition but strain and time surely ends the stage."""
        return self.bed.steps_left(stage)

    def stage_result(self, stage: Stage) -> dict[str, float]:
        """Yield stress of a bed that is pulled or sheared."""
        return self.grips.result() if stage.kind in GRIPPING else {}

    def unmet(self, stage: Stage) -> str:
        """What the stage still waits for."""
        return self.bed.unmet(stage)

    # -- what is saved and told -------------------------------------------------------------------

    def measure(self) -> dict[str, float]:
        """Energies in J and what walls feel, where `record.quantities` asks for them."""
        row = self.press.measure() | self.grips.measure() | self.energies.measure()
        wanted = self.scene.record.quantities
        row |= contact_forces(self) if "contacts" in wanted else {}
        return row | (inclination_row(self) if "inclination" in wanted else {})

    def node_fields(self) -> dict[str, np.ndarray]:
        """Those of `record.node_fields` that this method knows."""
        wanted = [name for name in NODE_FIELDS if name in self.scene.record.node_fields]
        return {f"node_{name}": NODE_FIELDS[name](self) for name in wanted}

    def saved(self) -> dict[str, np.ndarray]:
        """Stress-free shape, turns, spins and accelerations of the nodes."""
        arrays = {f"bonds_{name}": getattr(self, name).numpy().copy() for name in _CARRIED}
        arrays |= self.bed.saved() | self.energies.saved()
        if self.native is not None:
            arrays |= self.native.near.saved()
        return arrays | (self.contacts.saved() if self.contacts is not None else {})

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for name in _CARRIED:
            getattr(self, name).assign(arrays[f"bonds_{name}"])
        self.bed.restore(arrays)
        self.energies.restore(arrays)
        self.started = True
        if self.contacts is not None:
            self.contacts.restore(arrays, self.step_count)
            if self.native is not None:
                self.native.take_shapes()
                self.native.near.restore(arrays)
            self._stop_executor()

    def torn_fiber(self) -> dict[str, Any]:
        """First torn fiber, its worst node, and the pull (N) of its longest bond."""
        found = super().torn_fiber()
        return found | {
            "terms": {"stretching": found["terms"]["stretching"]},
            "largest_term": "stretching",
        }
