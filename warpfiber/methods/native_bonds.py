"""A step of bonded spheres in vectors on the CPU: arrays and launches of its sweeps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpfiber.methods.bonded_launches import REACH_MARGIN, clock_launch
from warpfiber.methods.near_pairs import NearPairs
from warpfiber.passes.executor import Launch
from warpfiber.passes.joined_steps import JoinedSteps
from warpfiber.passes.native_bonds import make_native_bond_sweep
from warpfiber.passes.native_bonds_source import BEGIN, END, LANES, LOADS
from warpfiber.passes.native_capsules import make_native_capsule_pairs
from warpfiber.passes.native_capsules_source import LINE, PARTS
from warpfiber.passes.native_nodes import fiber_blocks

if TYPE_CHECKING:
    from warpfiber.methods.bonded_spheres import BondedSpheres


class NativeBonds:
    """The SIMD sweep over bonds with its blocks of fibers, and what it knows of walls."""

    def __init__(self, spheres: BondedSpheres) -> None:
        self.spheres = spheres
        model, features = spheres.model, spheres.features
        p, device = model.precision, model.device
        fibers, own = fiber_blocks(model.host["fiber_group"], LANES)
        self.block_fiber = wp.array(fibers.ravel(), dtype=wp.int32, device=device)
        self.block_own = wp.array(own, dtype=wp.int32, device=device)
        nodes = model.node_count if any(features.walls) else 0
        self.touches = wp.zeros(nodes, dtype=wp.uint8, device=device)  # in the step before
        self.push = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.couple = wp.zeros(nodes, dtype=p.vec3, device=device)
        first, last = self._tips()
        tips = (first + 2 * last).astype(np.uint8)
        self.segment_tips = wp.array(tips, dtype=wp.uint8, device=device)
        size = PARTS * model.node_count * LINE
        self.contact_load = wp.zeros(size, dtype=p.real, device=device)
        assert spheres.contacts is not None
        self.near = NearPairs(spheres, spheres.contacts)

    def _tips(self) -> tuple[np.ndarray, np.ndarray]:
        """(S,) whether a segment is the first one of its fiber, and the last one."""
        fiber = self.spheres.model.host["segment_fiber"]
        other = np.diff(fiber) != 0
        return np.concatenate([[True], other]), np.concatenate([other, [True]])

    def launch(self, phase: int) -> Launch:
        """What `phase` says: sums of LOADS, END and BEGIN."""
        spheres = self.spheres
        model, state, p = spheres.model, spheres.state, spheres.model.precision
        inputs = [
            wp.int32(phase),
            p.real(spheres.dt),
            spheres.press.place,
            spheres.press.velocity,
            spheres.press.fiber_push,
            p.real(spheres.scene.contact.damping),
            spheres.wall_face,
            spheres.wall_memory,
            spheres.wall_depth,
            self.near.skin,
            spheres.stage,
            spheres.groups,
            model.fiber_node_start,
            model.fiber_group,
            spheres.bond_axis,
            spheres.bond_length,
            spheres.holds.hold,
            spheres.holds.load,
            spheres.grips.node_grip,
            self.contact_load,
            self.touches,
            self.push,
            self.couple,
            self.near.pos,
            spheres.place,
            state.node_pos,
            state.node_velocity,
            spheres.node_turn,
            spheres.node_spin,
            spheres.node_rate,
            spheres.node_spin_rate,
            spheres.still_steps,
            state.status,
            self.block_fiber,
            self.block_own,
        ]
        kernel = make_native_bond_sweep(p.name, spheres.features)
        return Launch("bonds", kernel, self.block_own.shape[0], inputs, split=True)

    def pair_launch(self, dt: float, *, keeps: bool = False) -> Launch:
        """What all listed pairs do; `keeps`: also by pair, for those who read it."""
        spheres, contacts = self.spheres, self.spheres.contacts
        model, state, p = spheres.model, spheres.state, spheres.model.precision
        assert contacts is not None
        pairs = contacts.search.list
        inputs = [
            wp.int32(keeps),
            p.real(dt),
            p.real(spheres.scene.contact.damping),
            p.real(spheres.scene.contact.friction),
            p.real(REACH_MARGIN * pairs.reach),
            spheres.groups,
            self.segment_tips,
            model.fiber_group,
            model.segment_node,
            model.segment_fiber,
            state.lattice_now,
            pairs.out_start,
            *self.near.arrays(),
            pairs.pair_i,
            pairs.pair_j,
            pairs.pair_image,
            spheres.place,
            state.node_velocity,
            spheres.node_spin,
            state.step,
            contacts.acts,
            contacts.force,
            contacts.moment,
            contacts.arms,
            contacts.memory,
            contacts.written,
            self.contact_load,
            state.status,
        ]
        kernel = make_native_capsule_pairs(p.name, contacts.features)
        return Launch("pairs", kernel, PARTS, inputs, split=True)

    def kernels(self) -> list[Any]:
        """What a step launches."""
        launches = [clock_launch(self.spheres), self.pair_launch(0.0)]
        launches += [self.launch(0), *self.spheres.press.motion(), *self.spheres.press.meter()]
        launches += [*self.spheres.grips.meter(), *self.spheres.energies.losses()]
        launches += self.near.launches()
        return [launch.kernel for launch in launches]

    def steps(self) -> JoinedSteps:
        """Clock, drift; pairs and bonds with the drift of the next step; pairs, bonds, kick.

        What a step dissipates is found at its end, which is then a launch of its own.
        """
        spheres = self.spheres
        clock, dt = clock_launch(spheres), spheres.dt
        motion = spheres.press.motion()
        meter = [*spheres.press.meter(), *spheres.grips.meter(), *spheres.energies.losses()]
        drift = self.launch(BEGIN)
        drift.name = "drift"
        self.touches.fill_(1)  # walls may have memories of a saved run
        begin = [clock, *motion, drift]
        middle = [self.pair_launch(dt), clock, self.launch(LOADS | END | BEGIN), *meter, *motion]
        end = [self.pair_launch(dt, keeps=True), self.launch(LOADS | END), *meter]
        if spheres.energies.told:
            middle = [*end, *begin]
        device, status = spheres.model.device, spheres.state.status
        return JoinedSteps(begin, middle, end, device, spheres.workers, status)
