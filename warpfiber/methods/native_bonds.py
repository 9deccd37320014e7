"""A step of bonded spheres in vectors on the CPU: arrays and launches of its sweeps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from warpfiber.methods.bonded_launches import REACH_MARGIN, clock_launch
from warpfiber.methods.near_pairs import NearPairs
from warpfiber.passes.executor import Launch
from warpfiber.passes.joined_steps import JoinedSteps
from warpfiber.passes.native_bonds import make_native_bond_sweep
from warpfiber.passes.native_bonds_source import (
    BEGIN,
    END,
    FROM_NODES,
    LANES,
    LOADS,
    TO_NODES,
)
from warpfiber.passes.native_capsules import make_native_capsule_pairs
from warpfiber.passes.native_capsules_source import KEEPS_LOADS, KEEPS_RECORD, LINE, PARTS
from warpfiber.passes.native_nodes import fiber_blocks
from warpfiber.passes.node_blocks import NodeBlocks, aligned_zeros

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
        self.blocks = blocks = NodeBlocks.of(fibers, own, model.host["fiber_node_start"])
        self.block_start = wp.array(blocks.start, dtype=wp.int32, device=device)
        self.block_axis = blocks.zeros(3, p.real, device)
        self.block_length = blocks.zeros(1, p.real, device)
        self.block_turn = blocks.zeros(4, p.real, device)
        self.take_shapes()
        nodes = model.node_count if any(features.walls) else 0
        self.touches = wp.zeros(nodes, dtype=wp.uint8, device=device)  # in the step before
        walled = model.fiber_count if any(features.walls) else 0
        self.fiber_touches = wp.zeros(walled, dtype=wp.uint8, device=device)
        self.fiber_extent = wp.zeros(6 * walled, dtype=wp.float64, device=device)
        self.push = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.couple = wp.zeros(nodes, dtype=p.vec3, device=device)
        self.contact_load = aligned_zeros(LINE * (1 + PARTS * model.node_count), p.real, device)
        self.contact_touch = wp.zeros(PARTS * model.node_count, dtype=wp.uint8, device=device)
        assert spheres.contacts is not None
        self.near = NearPairs(spheres, spheres.contacts, blocks)

    def take_shapes(self) -> None:
        """Bring the stress-free shapes into the blocks."""
        for name, array in (("bond_axis", self.block_axis), ("bond_length", self.block_length)):
            self.blocks.fill(array, getattr(self.spheres, name).numpy())

    def launch(self, phase: int) -> Launch:
        """What `phase` says: sums of LOADS, END, BEGIN, FROM_NODES and TO_NODES."""
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
            spheres.stage,
            spheres.groups,
            model.fiber_node_start,
            model.fiber_group,
            spheres.holds.hold,
            spheres.holds.load,
            spheres.grips.node_grip,
            self.contact_load,
            self.contact_touch,
            self.fiber_extent,
            self.fiber_touches,
            self.touches,
            self.push,
            self.couple,
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
            self.block_start,
            self.block_axis,
            self.block_length,
            self.near.block_pos,
            self.near.block_skin,
            self.block_turn,
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
            wp.int32(keeps * KEEPS_LOADS + spheres.energies.told * KEEPS_RECORD),
            p.real(dt),
            p.real(spheres.scene.contact.damping),
            p.real(spheres.scene.contact.friction),
            p.real(REACH_MARGIN * pairs.reach),
            spheres.groups,
            model.fiber_group,
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
            contacts.arms,
            contacts.record,
            contacts.memory,
            contacts.written,
            self.contact_load,
            self.contact_touch,
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
        drift = self.launch(BEGIN | FROM_NODES)
        drift.name = "drift"
        for touches in (self.touches, self.fiber_touches):
            touches.fill_(1)  # walls may have memories of a saved run
        begin = [clock, *motion, drift]
        middle = [self.pair_launch(dt), clock, self.launch(LOADS | END | BEGIN), *meter, *motion]
        end = [self.pair_launch(dt, keeps=True), self.launch(LOADS | END | TO_NODES), *meter]
        if spheres.energies.told:
            middle = [self.pair_launch(dt), *end[1:], *begin]
        device, status = spheres.model.device, spheres.state.status
        choice = spheres.worker_choice
        return JoinedSteps(begin, middle, end, device, spheres.workers, status, choice)
