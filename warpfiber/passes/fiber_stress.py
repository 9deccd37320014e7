"""What fibers without inertia add to the stress of their box, now, in Pa.

Columns: `stress_11` ... `stress_23` in all, `stress_contact_11` ... of it what contact passes on;
`relative_viscosity` = 1 + sigma:E/(2 eta E:E), in a flow that strains; in simple shear the normal
differences N_1 = sigma_11 - sigma_33, N_2 = sigma_33 - sigma_22 (1 flow, 2 vorticity, 3 gradient).

Source: `measure_stress`, moments over the volume of the box.
Symbols: sigma stress of the fibers, tension positive, E rate of strain of the flow, eta viscosity.
Limits: velocities and contact forces are those of the last step: exact for rods without contact,
    else first order in dt (chains that keep their length: 0.4 % at a strain of 0.05 per step). nan
    before the first step.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import Model, State
from warpfiber.passes.measure_stress import STRESS, make_measure_stress

CHUNKS = 256


class FiberStress:
    """Measures the stress; `viscosity` in Pa s, `fiber_frozen` (F,) uint8."""

    def __init__(
        self,
        model: Model,
        state: State,
        *,
        flow_origin: np.ndarray,
        viscosity: float,
        shears: bool,
        fiber_frozen: np.ndarray,
        has_friction: bool = False,
    ) -> None:
        self.model, self.state = model, state
        self.flow_origin, self.viscosity, self.shears = flow_origin, viscosity, shears
        self.fiber_frozen = wp.array(fiber_frozen, dtype=wp.uint8, device=model.device)
        self.kernels = make_measure_stress(model.precision.name, has_friction)
        self.no_friction = wp.zeros(0, dtype=model.precision.vec3, device=model.device)
        self.center = wp.zeros(model.fiber_count, dtype=wp.vec3d, device=model.device)
        # step and contact moments found last; of a restored state: the next step makes its rows
        self.kept: tuple[int, np.ndarray] | None = None

    def measure(self, rows: Iterable[Any]) -> dict[str, float]:
        """Columns after a step; `rows`: each a `ContactRows` of it."""
        units = self.model.units
        box = abs(float(np.linalg.det(self.state.lattice.numpy()[0])))
        scale = units.force / units.length**2 / box
        drag, contact = self._moments(rows)
        total = scale * (drag + contact)
        found = dict(zip([f"stress_{k}" for k in STRESS], total, strict=True))
        parts = scale * contact
        found |= zip([f"stress_contact_{k}" for k in STRESS], parts, strict=True)
        gradient = self.state.gradient.numpy()[0].astype(float) / units.time
        strain = 0.5 * (gradient + gradient.T)
        if np.any(strain):
            s11, s22, s33, s12, s13, s23 = total
            sigma = np.array([[s11, s12, s13], [s12, s22, s23], [s13, s23, s33]])
            fluid = 2.0 * self.viscosity * np.sum(strain * strain)
            found["relative_viscosity"] = 1.0 + np.sum(sigma * strain) / fluid
        if self.shears:
            found["normal_difference_1"] = total[0] - total[2]
            found["normal_difference_2"] = total[2] - total[1]
        return {name: float(value) for name, value in found.items()}

    def saved(self, rows: Iterable[Any]) -> np.ndarray:
        """Contact moments (6,) now, run units: what a restored state cannot tell."""
        step = self._step
        if step == 0:
            return np.zeros(len(STRESS))
        if self.kept is None or self.kept[0] != step:
            self._moments(rows)
        assert self.kept is not None
        return self.kept[1]

    def restore(self, contact: np.ndarray) -> None:
        """Take over what `saved` returned; the State has been restored."""
        self.kept = self._step, np.asarray(contact)

    @property
    def _step(self) -> int:
        return int(self.state.step.numpy()[0])

    def _moments(self, rows: Iterable[Any]) -> tuple[np.ndarray, np.ndarray]:
        """Moments (6,) of drag and of contact, run units; nan before the first step."""
        step = self._step
        if step == 0:
            return np.full(len(STRESS), np.nan), np.full(len(STRESS), np.nan)
        drag = self._drag()
        if self.kept is None or self.kept[0] != step:
            contact = sum((self._contact(solved) for solved in rows), np.zeros(len(STRESS)))
            self.kept = step, contact
        return drag, self.kept[1]

    def _drag(self) -> np.ndarray:
        """Moments (6,) of the drag of all fibers, run units; leaves their middles."""
        model, state = self.model, self.state
        chunks = min(CHUNKS, model.fiber_count)
        sums = wp.zeros((chunks, len(STRESS)), dtype=wp.float64, device=model.device)
        inputs = [
            chunks,
            model.fiber_count,
            model.precision.vec3(*self.flow_origin),
            state.gradient,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            self.fiber_frozen,
            state.node_pos,
            state.node_velocity,
            self.center,
            sums,
        ]
        wp.launch(self.kernels[0], dim=chunks, inputs=inputs, device=model.device)
        total: np.ndarray = sums.numpy().sum(axis=0)
        return total

    def _contact(self, rows: Any) -> np.ndarray:
        """Moments (6,) of the forces of all rows of one solve, run units."""
        model, state = self.model, self.state
        sums = wp.zeros((CHUNKS, len(STRESS)), dtype=wp.float64, device=model.device)
        inputs = [
            CHUNKS,
            rows.row_count,
            rows.row_i,
            rows.row_j,
            rows.row_s,
            rows.row_t,
            rows.row_normal,
            rows.row_force,
            self.no_friction if rows.rub is None else rows.rub.force,
            state.lattice,
            wp.vec3d(*(1.0 if wraps else 0.0 for wraps in model.domain.periodic)),
            model.groups,
            model.fiber_group,
            self.fiber_frozen,
            model.segment_node,
            model.segment_fiber,
            state.node_pos,
            self.center,
            sums,
        ]
        wp.launch(self.kernels[1], dim=CHUNKS, inputs=inputs, device=model.device)
        total: np.ndarray = sums.numpy().sum(axis=0)
        return total
