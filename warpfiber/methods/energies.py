"""Energies of a run of bonded spheres: what is stored, what has been dissipated since the start.

Columns in J. Stored: kinetic, of the bonds, gravity, of contacts with walls and between fibers, and
of their friction. Dissipated: by the dashpots of bonds, contacts and walls, by friction, and by the
damping of stages. Their sum less the work of the walls stays what it was at the start, to the order
of dt.
Limits: what held nodes and forces on single nodes put in is not told.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpfiber.passes.bond_energy import make_measure_bonds, measure_bond_energies
from warpfiber.passes.bond_losses import LOST, make_bond_losses
from warpfiber.passes.contact_energy import (
    NORMAL,
    TANGENTIAL,
    make_contact_energy,
    measure_contact_energy,
)
from warpfiber.passes.contact_losses import make_contact_losses
from warpfiber.passes.executor import Launch
from warpfiber.scene.planes import slides

if TYPE_CHECKING:
    from warpfiber.methods.bonded_spheres import BondedSpheres


class Energies:
    """Sums over steps of one run, where `record.quantities` asks for energy."""

    def __init__(self, spheres: BondedSpheres) -> None:
        self.spheres = spheres
        model = spheres.model
        self.told = "energy" in spheres.scene.record.quantities
        fibers = int(self.told) * model.fiber_count
        segments = int(self.told and spheres.contacts is not None) * model.segment_count
        self.lost = wp.zeros((fibers, len(LOST)), dtype=wp.float64, device=model.device)
        self.rubbed = wp.zeros((segments, 2), dtype=wp.float64, device=model.device)

    # -- the step ---------------------------------------------------------------------------------

    def losses(self) -> list[Launch]:
        """After the loads of a step."""
        if not self.told:
            return []
        spheres, model = self.spheres, self.spheres.model
        p, contact = model.precision, spheres.scene.contact
        inputs = [
            wp.float64(spheres.dt),
            spheres.press.axis,
            spheres.press.place,
            spheres.press.velocity,
            p.real(contact.damping),
            spheres.wall_face,
            spheres.stage,
            spheres.groups,
            model.fiber_node_start,
            model.fiber_group,
            spheres.wall_memory,
            spheres.place,
            spheres.state.node_velocity,
            spheres.node_spin,
            spheres.node_rate,
            spheres.node_spin_rate,
            spheres.state.status,
            self.lost,
        ]
        kernel = make_bond_losses(p.name, spheres.features)
        launches = [Launch("bond losses", kernel, model.fiber_count, inputs, split=True)]
        contacts = spheres.contacts
        if contacts is not None and (contacts.features.dashpot or contacts.features.friction):
            inputs = [
                wp.float64(spheres.dt),
                model.segment_node,
                model.segment_end,
                contacts.search.list.out_start,
                contacts.search.list.pair_j,
                contacts.acts,
                contacts.record,
                spheres.state.node_velocity,
                spheres.node_spin,
                spheres.state.status,
                self.rubbed,
            ]
            kernel = make_contact_losses(p.name, contacts.features.closed)
            launches.append(
                Launch("contact losses", kernel, model.segment_count, inputs, split=True)
            )
        return launches

    def _contact_kernel(self) -> Any:
        contacts = self.spheres.contacts
        assert contacts is not None
        return make_contact_energy(self.spheres.model.precision.name, contacts.features)

    def _contact_inputs(self) -> list[Any]:
        spheres, model, state = self.spheres, self.spheres.model, self.spheres.state
        contacts = spheres.contacts
        assert contacts is not None
        pairs = contacts.search.list
        return [
            spheres.groups,
            spheres.pair_groups,
            model.fiber_node_start,
            model.fiber_group,
            model.segment_node,
            model.segment_fiber,
            state.lattice_now,
            pairs.out_start,
            pairs.pair_j,
            pairs.pair_image,
            spheres.place,
            state.step,
            contacts.memory,
            contacts.written,
        ]

    # -- what is told -----------------------------------------------------------------------------

    def _bond_kernel(self) -> Any:
        features, name = self.spheres.features, self.spheres.model.precision.name
        return make_measure_bonds(
            name, features.walls, features.wall_friction, features.container, features.planes
        )

    def kernels(self) -> list[Any]:
        """What a measurement launches."""
        if not self.told:
            return []
        contacts = self.spheres.contacts is not None
        return [self._bond_kernel()] + ([self._contact_kernel()] if contacts else [])

    def measure(self) -> dict[str, float]:
        """Energies in J; those of absent terms are left out."""
        if not self.told:
            return {}
        spheres, model = self.spheres, self.spheres.model
        inputs = [
            wp.vec3d(*spheres.press.corners.mean(axis=0)),
            spheres.press.place,
            spheres.wall_memory,
            spheres.groups,
            model.fiber_node_start,
            model.fiber_group,
            spheres.bond_axis,
            spheres.bond_length,
            spheres.place,
            spheres.state.node_velocity,
            spheres.node_turn,
            spheres.node_spin,
        ]
        kernel = self._bond_kernel()
        found = measure_bond_energies(kernel, spheres.counted_fibers, inputs, model.device)
        lost = dict(zip(LOST, np.sum(self.lost.numpy(), axis=0).tolist(), strict=True))
        stored, rubbed = np.zeros(2), np.zeros(2)
        if spheres.contacts is not None:
            stored = measure_contact_energy(
                self._contact_kernel(),
                self._contact_inputs(),
                model.segment_count,
                model.device,
            )
            rubbed = np.sum(self.rubbed.numpy(), axis=0)
        kept = found.pop("wall friction") + float(stored[TANGENTIAL])
        features, contacts = spheres.features, spheres.contacts
        rubs = features.wall_friction or (contacts is not None and contacts.features.friction)
        row = {f"energy_{name}": value for name, value in found.items()}
        row |= {
            "energy_contact": float(stored[NORMAL]),
            "energy_friction": kept,
            "dissipated_bonds": lost["bonds"],
            "dissipated_contacts": lost["walls"] + float(rubbed[NORMAL]),
            "dissipated_friction": lost["wall friction"] + float(rubbed[TANGENTIAL]) - kept,
            "dissipated_settling": lost["settling"],
        }
        present = {
            "energy_gravity": spheres.scene.gravity is not None,
            "energy_wall": features.walled,
            "energy_contact": contacts is not None,
            "energy_friction": rubs,
            "dissipated_bonds": features.dashpots,
            "dissipated_contacts": spheres.scene.contact.damping > 0.0,
            "dissipated_friction": rubs,
        }
        unit = model.units.energy
        row = {name: value * unit for name, value in row.items() if present.get(name, True)}
        if slides(spheres.scene):
            row["wall_work"] = spheres.press.measure().get("wall_work", 0.0) + lost["drive"] * unit
        return row

    def saved(self) -> dict[str, np.ndarray]:
        """Sums since the start."""
        if not self.told:
            return {}
        return {
            "energy_lost": self.lost.numpy().copy(),
            "energy_rubbed": self.rubbed.numpy().copy(),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        if self.told:
            self.lost.assign(arrays["energy_lost"])
            self.rubbed.assign(arrays["energy_rubbed"])
