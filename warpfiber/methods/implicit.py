"""Steps without inertia that may be taken back: what `overdamped` and `rigid_rod` share.

A step: begin (flow and lattice at its ends), motion without contact, contact where there is any,
end (time, flow; acceptance and the size of the next step where it may be rejected), take back.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpfiber.methods.contact import (
    ImplicitContact,
    MovingResponse,
    StepArrays,
    StepLoad,
    has_contact,
)
from warpfiber.methods.method import Method
from warpfiber.methods.strain_steps import step_start
from warpfiber.model import EXPIRED, TORN, Model, State
from warpfiber.passes.contact_rows import ContactRows
from warpfiber.passes.executor import Call, Launch, Repeat, flat, load_kernels
from warpfiber.passes.fiber_stress import FiberStress
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.pairs import PairFeatures
from warpfiber.passes.relaxation_launches import PARTED
from warpfiber.passes.step_control import (
    ERROR_CHUNKS,
    make_largest_error,
    make_step_begin,
    make_step_end,
    make_take_back,
)
from warpfiber.scene import Scene

Launches = list[Launch | Call | Repeat]


class Implicit(Method):
    """Advances a State without inertia; with a tolerance `dt` is the largest step."""

    inertia = False

    def __init__(
        self, scene: Scene, model: Model, state: State, dt: float, workers: int | None = None
    ) -> None:
        super().__init__(scene, model, state, dt, workers)
        p, device = model.precision, model.device
        self.adaptive = scene.numerics.tolerance is not None
        self.meets = has_contact(scene)
        self.keeps = self.adaptive or self.meets  # steps may be taken back
        kept = model.node_count if self.keeps else 0
        self.node_back = wp.zeros(kept, dtype=p.vec3, device=device)
        self.velocity_back = wp.zeros(kept, dtype=p.vec3, device=device)
        self.stage_gradient = wp.zeros(2, dtype=p.mat33, device=device)
        self.strain_next = wp.zeros(1, dtype=wp.float64, device=device)
        self.ends_lattice = wp.zeros(2, dtype=p.mat33, device=device)
        self.deformation_next = wp.zeros(1, dtype=wp.mat33d, device=device)
        self.verdict = wp.zeros(2, dtype=wp.int32, device=device)
        self.pace = wp.zeros(1, dtype=wp.float64, device=device)
        self.rejected = wp.zeros(2, dtype=wp.int32, device=device)  # the last step, and in all
        self.fiber_error = wp.zeros(model.fiber_count, dtype=p.real, device=device)
        chunks = min(ERROR_CHUNKS, model.fiber_count) if self.adaptive else 0
        self.error = wp.zeros(chunks, dtype=wp.float64, device=device)
        self.error_fiber = wp.zeros(chunks, dtype=wp.int32, device=device)
        first = step_start(scene) / model.units.time if self.adaptive else self.dt
        self.step_size = wp.array([min(first, self.dt)], dtype=wp.float64, device=device)
        self.contact: ImplicitContact | None = None
        self._warned = False
        self.stress: FiberStress | None = None
        if "stress" in scene.record.quantities and scene.flow is not None:
            self.stress = FiberStress(
                model,
                state,
                flow_origin=self.flow_origin,
                viscosity=scene.flow.viscosity,
                shears=scene.flow.kind == "simple_shear",
                fiber_frozen=self._frozen(),
                has_friction=scene.contact.friction + scene.contact.wall_friction > 0.0,
            )
        # what the step consists of: one module for all kernels that are not of the fibers alone
        sheared, method = model.domain.sheared, scene.numerics.method
        self.module = kernel_module("step", p.name, method, sheared, self.adaptive, self.meets)

    def _worker_break_even(self) -> float:
        """With contact as many as are relaxed in parts: else one worker finds all forces."""
        return PARTED if has_contact(self.scene) else super()._worker_break_even()

    def _make_contact(self, response: MovingResponse, load: StepLoad | None = None) -> None:
        """Contact, once the arrays of the method exist."""
        if not self.meets:
            return
        scene, model = self.scene, self.model
        frozen = self._frozen()
        self.contact = ImplicitContact(
            scene,
            model,
            self.state,
            StepArrays(
                self.node_back,
                self.ends_lattice,
                self.deformation_next,
                self.step_size,
                self.rejected,
                self.verdict,
                self.stage_gradient,
                self.pace,
            ),
            flow_origin=self.flow_origin,
            stretch=float(self._segment_stretch().max()),
            workers=self.workers,
            response=response,
            load=load,
            fiber_frozen=wp.array(frozen, dtype=wp.uint8, device=model.device)
            if frozen.any()
            else None,
        )
        self.list, self.skin = self.contact.search.list, self.contact.search.skin
        self.strain_end = self.contact.search.strain_end
        self.pair_features = PairFeatures(
            repulsion=scene.contact.law != "none",
            lubrication=scene.contact.lubrication,
            periodic=any(model.domain.periodic),
            sheared=model.domain.sheared,
        )

    def _frozen(self) -> np.ndarray:
        """(F,) whether a fiber only has prescribed motion."""
        frozen = np.asarray([group.frozen for group in self.scene.fibers])
        each: np.ndarray = frozen[self.model.host["fiber_group"]]
        return each

    # -- the step ---------------------------------------------------------------------------------

    @abstractmethod
    def motion(self) -> Launches:
        """Launches that move every fiber without contact and keep the start where asked to."""

    def after(self) -> Launches:
        """Launches once it is decided whether the step is kept."""
        return []

    def launches(self) -> Launches:
        """Begin, motion, contact and end of a step, and what a rejected one needs."""
        return self._around(self.motion())

    def _around(self, motion: Launches) -> Launches:
        name = self.model.precision.name
        steps: Launches = [self._begin(), *motion]
        if self.contact is not None:
            steps += self.contact.launches()
        if self.adaptive:
            chunks = self.error.shape[0]
            errors = [chunks, self.fiber_error, self.error, self.error_fiber]
            steps.append(Launch("errors", make_largest_error(name, self.module), chunks, errors))
        steps.append(self._end())
        steps += self.after()
        if self.keeps:
            steps.append(self._take_back())
        if self.contact is not None:
            steps.append(self.contact.check.foresee(self.rejected))
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
        name = self.model.precision.name
        begin = make_step_begin(name, self.model.domain.sheared, self.module)
        return Launch("begin", begin, 1, inputs)

    def _end(self) -> Launch:
        model, state = self.model, self.state
        tolerance = self.scene.numerics.tolerance or 0.0
        judged = self.contact is not None
        name, sheared = model.precision.name, model.domain.sheared
        kernel = make_step_end(name, sheared, self.adaptive, judged, self.module)
        inputs = [
            wp.mat33d(*self.full_gradient.ravel()),
            self._schedule(),
            wp.float64(tolerance),
            wp.float64(self.dt),
            self.error,
            self.error_fiber,
            self.verdict,
            self.pace,
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

    def _take_back(self) -> Launch:
        model, state = self.model, self.state
        tensions = self.tensions()
        inputs = [
            self.rejected,
            model.fiber_node_start,
            self.node_back,
            self.velocity_back,
            tensions[1],
            state.node_pos,
            state.node_velocity,
            tensions[0],
        ]
        kernel = make_take_back(model.precision.name, tensions[0].shape[0] > 0, self.module)
        return Launch("take_back", kernel, model.fiber_count, inputs, split=True)

    def tensions(self) -> tuple[Any, Any]:
        """Tensions now and at the start of the step; empty without."""
        none = wp.zeros(0, dtype=self.model.precision.real, device=self.model.device)
        return none, none

    def _schedule(self) -> Any:
        return wp.array(self.schedule, dtype=wp.vec2d, device=self.model.device)

    def prepare(self, measuring: Iterable[Any] = ()) -> None:
        """Compile, build the first list and capture, so that the next `advance` only steps."""
        contact = self.contact
        if self.stress is not None:
            measuring = [*measuring, *self.stress.kernels]
        if contact is not None and contact.search.list.build_count == 0:
            stepping = [x.kernel for x in flat(self.launches()) if isinstance(x, Launch)]
            load_kernels([*stepping, *contact.kernels(), *measuring], self.model.device)
            contact.search.refresh(self.step_count)
            self.list_seconds = contact.search.seconds
        super().prepare(measuring)

    def _settle(self) -> bool:
        """Do what halted the steps asks for, so that nothing is pending; False if a fiber tore."""
        status = self._status()
        if status[TORN]:
            return False
        if self.contact is not None and not self._warned and self.contact.unsolved:
            self._warned = True
            warnings.warn(
                "contact forces of a step are not within numerics.contact_tolerance: take smaller "
                "steps or a larger tolerance (unsolved_contacts in summary.json counts them)",
                RuntimeWarning,
                stacklevel=2,
            )
        if status[EXPIRED] and self.contact is not None:
            if self.contact.settle(self.step_count):
                self._stop_executor()
            self.list_seconds = self.contact.search.seconds
            self.strain_end = self.contact.search.strain_end
        return True

    @property
    def box_width(self) -> float:
        """Smallest height that a periodic box may have, run units."""
        return self.contact.search.box_width if self.contact is not None else 0.0

    def close(self) -> None:
        """Stop worker threads."""
        super().close()
        if self.contact is not None:
            self.contact.close()

    # -- what is saved and told -------------------------------------------------------------------

    def measure(self) -> dict[str, float]:
        """Stress of the fibers, Pa, where it is asked for."""
        return self.stress.measure(self._solved_rows()) if self.stress is not None else {}

    def _solved_rows(self) -> list[ContactRows]:
        return [rows for rows, _ in self.contact.solves] if self.contact is not None else []

    def saved(self) -> dict[str, np.ndarray]:
        """Sizes of steps, and what contact depends on."""
        arrays = {
            f"implicit_{name}": getattr(self, name).numpy().copy()
            for name in ("step_size", "rejected")
        }
        if self.stress is not None:
            arrays["implicit_stress"] = self.stress.saved(self._solved_rows())
        return arrays | (self.contact.saved() if self.contact is not None else {})

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for name in ("step_size", "rejected"):
            getattr(self, name).assign(arrays[f"implicit_{name}"])
        if self.stress is not None:
            self.stress.restore(arrays["implicit_stress"])
        if self.contact is not None:
            self.contact.restore(arrays, self.step_count)
            self._stop_executor()

    def list_report(self) -> dict[str, float]:
        """Skins, builds and what they looked at; nothing without contact."""
        return self.contact.search.report(self.step_count) if self.contact is not None else {}

    def refused_contact(self) -> dict[str, Any] | None:
        """Of the last step, if it was its contacts that made it fail."""
        return self.contact.refused() if self.contact is not None else None

    def step_report(self) -> dict[str, float]:
        """Rejected steps and the next dt in s, where they may change; rows of contact."""
        report: dict[str, float] = {}
        if self.keeps:
            report["rejected_steps"] = int(self.rejected.numpy()[1])
            report["next_dt"] = float(self.step_size.numpy()[0]) * self.model.units.time
        return report | (self.contact.report() if self.contact is not None else {})
