"""Contact inside an implicit step: fibers that do not meet, or penalties taken at its end.

Between the motion without contact and the end of the step: does the list hold every pair that may
meet, rows at the start of the step, their forces, the motion that these cause, and a look at the
result. With two linearizations, rows of the result push once more against what is left; of packed
fibers those do that the first left overlapping (`passes/overlap_choice`).
Source: non-penetration as a complementarity of gaps and forces (`passes/unilateral`); a step whose
    result overlaps by more than OVERLAP or in which center lines passed each other is taken again,
    shorter (`passes/contact_verdict`).
Limits: first order in dt. Friction with `unilateral` alone, and in the first of two linearizations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp

from warpfiber.laws.lubrication import OUTER
from warpfiber.methods.pair_search import PairSearch
from warpfiber.methods.skin import MOST_SKIN
from warpfiber.model import EXPIRED, HALT, Model, State
from warpfiber.passes.contact_check import ContactCheck
from warpfiber.passes.contact_rows import NEVER, ContactRows
from warpfiber.passes.executor import Call, Launch, Repeat
from warpfiber.passes.host_arrays import host_view, write_array
from warpfiber.passes.list_bound import FORESEEN
from warpfiber.passes.overlap_choice import OverlapChoice
from warpfiber.passes.row_slip import Friction, RowSlip
from warpfiber.passes.step_control import HALVE
from warpfiber.passes.unilateral import ContactDual, ContactLaw, Response
from warpfiber.scene import Fault, Scene, SceneError

# Radii: a row with a larger predicted gap is not made. Less halves more steps of soft fibers, with
# 0.5 a cell of rods has a fifth more rows.
KEEP = 0.3
# The same of rods, which contact moves by less: an eighth fewer rows and a fifth fewer lists than
# with 0.3. Of three starts of a cell of 1000 (r_f = 20, steps of 0.05 to strain 60) 1, 6 and 11 of
# 1200 steps are taken again, with 0.3 it is 3, 2 and 10.
KEEP_RODS = 0.2
# Radii: the same in a cell whose fibers are bent from the start, as packed ones are. Others hold
# them, and where a contact opens or closes they move on by more.
KEEP_BENT = 1.0
# Radii: and whatever is foreseen, free ends nearer than this at the start have rows (inside a fiber
# half of it). An end that springs from one fiber is stopped by the next, which without contact
# would have moved apart: so ended most steps of the sliding plate that were halved.
NEAR_BENT = 2.0
# Radii: a step that ends with more is taken again, shorter. Rods hardly ever reach theirs: it costs
# some steps in a thousand; flexible fibers would be halved often.
OVERLAP, OVERLAP_RODS = 0.05, 0.03
SLACK = 20.0  # tolerances of contact: or with more than these
# Share of that overlap from which flexible fibers are pushed apart once more, those alone: of steps
# of 0.1 of 5 segments (r_f = 21, V_f = 0.1, 70 GPa) else one in twenty is taken again. Not where
# walls hold straight ones: what they jam would be squeezed on, step by step, instead of told.
SECOND = 0.5
SKIN_BENT = 5.0  # diameters, where a few fibers of many spring farther than the others
# Parts of the first step that no list lasts, below which a step is not worth taking: with a given
# skin, and with skins that grow as far as the box allows.
SHORTEST_GIVEN, SHORTEST = 1.0 / 64.0, 1e-6
FINITE = 1e20  # radii; penalties may overlap
SLIDES = 1e-5  # a contact slides whose friction is so near to its limit: rounding of float32
Launches = list[Launch | Call | Repeat]


@dataclass
class StepArrays:
    """What a step that may be taken back works with, on the device."""

    node_back: Any  # (N,) vec3 positions at the start
    ends_lattice: Any  # (2,) mat33 lattice at start and end
    deformation_next: Any  # (1,) mat33d deformation of the list at the end
    step_size: Any  # (1,) float64
    rejected: Any  # (2,) int32: the step under way, and in all
    verdict: Any  # (2,) int32: verdict of the contacts, fiber that it is about
    stage_gradient: Any  # (2,) mat33 of the flow
    pace: Any  # (1,) float64 next step over this one


class MovingResponse(Response, Protocol):
    """A response that also moves the fibers by the solution."""

    def apply(self, dual: ContactDual, carried: float = 0.0) -> Launch:
        """`carried`: share of the velocity of contact that the fibers take on."""


class StepLoad(Protocol):
    """Forces of contact that stay on the fibers in the motion without contact."""

    node_foreseen: Any  # (N,) vec3 where the step ends if they stay as they are

    def note(self, dual: ContactDual, again: bool) -> Launch:
        """After a solve; `again`: its forces come on top of those of the one before."""


def has_contact(scene: Scene) -> bool:
    """Whether fibers meet one another or a wall."""
    return scene.contact.law != "none" or scene.contact.lubrication != "none"


def contact_law(scene: Scene, model: Model) -> ContactLaw:
    """The law of contacts in run units."""
    contact, units = scene.contact, model.units
    if scene.numerics.contact == "unilateral":
        return ContactLaw()
    if contact.law == "linear":
        stiffness = (contact.stiffness or 0.0) * units.length / units.force
        return ContactLaw("linear", stiffness)
    return ContactLaw("exponential", (contact.strength or 0.0) / units.force, contact.decay)


class ImplicitContact:
    """Contacts of one method: list, rows, forces and what they say of the step.

    `response`: from row forces to the motion of the fibers.
    """

    def __init__(
        self,
        scene: Scene,
        model: Model,
        state: State,
        step: StepArrays,
        *,
        flow_origin: np.ndarray,
        stretch: float,
        workers: int,
        response: MovingResponse,
        load: StepLoad | None = None,
        fiber_frozen: Any = None,
    ) -> None:
        self.scene, self.model, self.state, self.step = scene, model, state, step
        self.response, self.load, self.flow_origin = response, load, flow_origin
        self.hard = scene.numerics.contact == "unilateral"
        tolerance = scene.numerics.contact_tolerance or 1e-3
        rods = scene.numerics.method == "rigid_rod"
        least = OVERLAP_RODS if rods else OVERLAP
        radii = [row["radius"] for row in model.group_rows]
        self.packed = model.starts_bent
        self.overlap = max(least, SLACK * tolerance) if self.hard else FINITE
        keep = KEEP_BENT if self.packed else KEEP_RODS if rods else KEEP
        reach = 2.0 * max(radii) + keep * min(radii)
        if scene.contact.lubrication != "none":
            reach = max(reach, OUTER * 2.0 * max(radii))
        self.search = PairSearch(
            scene,
            model,
            state,
            reach=reach,
            stretch=stretch,
            workers=workers,
            most_skin=SKIN_BENT if self.packed else MOST_SKIN,
            slides=not self.packed,  # whose second solve has rows of walls for what is listed
        )
        rub = None
        if self.hard and (scene.contact.friction > 0.0 or scene.contact.wall_friction > 0.0):
            between, walls = scene.contact.friction, scene.contact.wall_friction
            rub = Friction(between, walls, step.stage_gradient, flow_origin, fiber_frozen)
        self.solves: list[tuple[ContactRows, ContactDual]] = []
        linearizations = scene.numerics.linearizations or 1
        self.choice: OverlapChoice | None = None
        open_chains = scene.numerics.method == "overdamped" and not any(model.domain.wall)
        if (self.packed or open_chains) and self.hard and linearizations == 1:
            self.choice = OverlapChoice(model, state, SECOND * self.overlap)
            linearizations = 2
        for again in range(linearizations):
            lattice = step.ends_lattice
            rows = ContactRows(
                model,
                state,
                self.search.list,
                node_back=state.node_pos if again else step.node_back,
                lattice_back=lattice[1:2] if again else lattice[0:1],
                lattice_now=lattice[1:2],
                step_size=step.step_size,
                node_foreseen=load.node_foreseen if load is not None and not again else None,
                keep=keep,
                near_now=NEAR_BENT if self.packed and not again else NEVER,
                lubrication="none" if again else scene.contact.lubrication,
                chosen=self.choice.segment_chosen if again and self.choice else None,
                friction=None if again else rub,
            )
            dual = ContactDual(
                model,
                state,
                rows,
                self.search.list,
                response,
                step_size=step.step_size,
                node_start=step.node_back,
                tolerance=tolerance * min(radii),
                law=contact_law(scene, model),
                fiber_frozen=fiber_frozen,
                tells_push=load is not None,
            )
            self.solves.append((rows, dual))
        self.check = ContactCheck(
            model,
            state,
            self.search.list,
            node_back=step.node_back,
            lattice_back=step.ends_lattice[0:1],
            lattice_now=step.ends_lattice[1:2],
            fiber_frozen=fiber_frozen,
            solves=self.solves,
            tears=self.packed,
            renews=self.choice is not None,
            recalls=load is None,
        )
        self.shortest = 0.0
        self.no_need = wp.zeros(1, dtype=wp.int32, device=model.device)

    # -- the step ---------------------------------------------------------------------------------

    def kernels(self) -> list[Any]:
        """What the list needs beside the launches."""
        return list(self.search.list.kernels.values())

    def launches(self) -> Launches:
        """From the motion without contact to the verdict on the step."""
        state, step, verdict = self.state, self.step, self.check.kernels
        found = self._listed(state.node_pos if self.load is None else self.load.node_foreseen)
        for again, (rows, dual) in enumerate(self.solves):
            making = rows.launches()
            if again and self.choice is not None:
                found += self.check.launches()
                found += self.choice.launches(self.check, self.solves[0][0], rows)
            found += [*making, *dual.launches(), self.response.apply(dual, carried=1.0)]
            if self.load is not None:
                found.append(self.load.note(dual, again > 0))
        needs = [rows.row_need for rows, _ in self.solves]
        judge = [
            wp.float64(self.overlap),
            needs[0],
            needs[1] if len(needs) > 1 else self.no_need,
            self.check.largest,
            self.check.found,
            self.model.segment_fiber,
            state.status,
            step.verdict,
            step.pace,
        ]
        found += self.check.launches() if self.choice is None else self.check.launches_again()
        found.append(Launch("verdict", verdict["judge_contacts"], 1, judge))
        if self.load is not None:  # fibers that others bend may end elsewhere than was foreseen
            found += self._listed(state.node_pos)
        return found

    def _listed(self, node_pos: Any) -> Launches:
        """Whether the list holds for these ends of the step; without it there is no step."""
        check, step = self.check, self.step
        gate = [check.list_short, self.state.status, step.rejected]
        return [
            *check.list_launches(node_pos, step.deformation_next, self.flow_origin),
            Launch("gate", check.kernels["gate_list"], 1, gate),
        ]

    def settle(self, step: int) -> bool:
        """Enlarge what was too small for the step; True if its launches are to be made anew."""
        if any([rows.grow() for rows, _ in self.solves]):
            words = self.state.status.numpy().copy()
            words[[EXPIRED, HALT]] = 0
            self.state.status.assign(words)
            return True
        use = host_view(self.check.list_use)[0].copy()
        if host_view(self.check.share_back)[0] == FORESEEN:  # what the next step would have found
            use[:2] *= 1.0 + 1.0 / max(1, step - self.search.skin.built_step)
        if not self.search.use_up(step, use):
            self._halve()
        write_array(self.check.share_back, 0.0)
        return self.search.refresh(step)

    def _halve(self) -> None:
        """Half the step, as no list lasts the whole; raises SceneError if none is worth taking."""
        size, rejected = self.step.step_size.numpy(), self.step.rejected.numpy()
        skin, box = self.scene.numerics.skin, self.scene.box
        share = SHORTEST if skin is None else SHORTEST_GIVEN
        self.shortest = self.shortest or share * float(size[0])
        if size[0] < self.shortest:
            remedy = "too small: fibers leave the neighbor list within any step; enlarge it"
            fault = Fault(self.scene.path, "box.size", list(box.size) if box else None, remedy)
            if skin is not None:
                fault = Fault(self.scene.path, "numerics.skin", skin, remedy)
            raise SceneError([fault])
        self.step.step_size.assign(0.5 * size)
        self.step.rejected.assign(rejected + np.asarray([0, 1], dtype=rejected.dtype))

    # -- what is saved and told -------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """What the next step depends on: list, skin and the forces of the last rows."""
        arrays = self.search.saved()
        arrays["list_share"] = self.check.share_back.numpy().copy()
        arrays["starts_bent"] = np.asarray([self.packed])
        for number, (rows, _) in enumerate(self.solves):
            arrays |= {f"rows{number}_{key}": value for key, value in rows.saved().items()}
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray], step: int) -> None:
        """Take over what `saved` returned."""
        self.search.restore(arrays, step)
        write_array(self.check.pairs_known, 0)
        self.check.share_back.assign(arrays["list_share"])
        for number, (rows, _) in enumerate(self.solves):
            head = f"rows{number}_"
            rows.restore({key[len(head) :]: arrays[key] for key in arrays if key.startswith(head)})

    def report(self) -> dict[str, float]:
        """Rows, updates and largest fault (radii) of the last step; unsolved so far.

        With friction `sliding_contacts`, the share of loaded contacts that slide.
        """
        rows, dual = self.solves[0]
        radius = min(row["radius"] for row in self.model.group_rows)
        sliding = {} if rows.rub is None else {"sliding_contacts": self._sliding(rows, rows.rub)}
        return sliding | {
            "rows": int(rows.row_count.numpy()[0]),
            "updates": dual.updates,
            "fault": dual.fault / radius,
            "unsolved_contacts": self.unsolved,
        }

    @staticmethod
    def _sliding(rows: ContactRows, rub: RowSlip) -> float:
        count = int(rows.row_count.numpy()[0])
        force = rows.row_force.numpy()[:count].astype(float)
        flat = np.linalg.norm(rub.force.numpy()[:count].astype(float), axis=1)
        mu = np.where(rows.row_j.numpy()[:count] < 0, rub.friction.walls, rub.friction.fibers)
        dry = (force > 0.0) & (rows.row_compliance.numpy()[:count] == 0.0)
        slides = flat[dry] > (1.0 - SLIDES) * mu[dry] * force[dry]
        return float(slides.mean()) if len(slides) else 0.0

    @property
    def unsolved(self) -> int:
        """Solves of this process whose forces are not within the tolerance."""
        return sum(dual.unsolved for _, dual in self.solves)

    def fiber_push(self) -> np.ndarray:
        """(F,) sum of the sizes of the contact forces on each fiber in the last step, run units."""
        push: np.ndarray = np.zeros(self.model.fiber_count)
        fiber = self.model.host["segment_fiber"]
        for rows, _ in self.solves:
            count = int(rows.row_count.numpy()[0])
            force = np.abs(rows.row_force.numpy()[:count].astype(float))
            if rows.rub is not None:
                flat = rows.rub.force.numpy()[:count].astype(float)
                force = np.hypot(force, np.linalg.norm(flat, axis=1))
            for side in (rows.row_i, rows.row_j):
                segment = side.numpy()[:count]
                met = segment >= 0
                np.add.at(push, fiber[segment[met]], force[met])
        return push

    def refused(self) -> dict[str, Any] | None:
        """The pair that made the last step fail and what to do; None if none did."""
        if int(self.step.verdict.numpy()[0]) != HALVE:
            return None
        overlap = float(self.check.largest.numpy()[0])
        if overlap > FINITE:
            return None
        found = self.check.found.numpy()
        crossed = found[0] > 0
        segments = found[3:5] if crossed else found[1:3]
        fiber_of = self.model.host["segment_fiber"]
        fiber, partner = (int(fiber_of[k]) if k >= 0 else None for k in segments)
        other = f"fiber {partner}" if partner is not None else "a wall"
        if partner == fiber:
            other = "itself"
        what = (
            f"would pass through {other}" if crossed else f"overlaps {other} by {overlap:.3g} radii"
        )
        remedy = 'give the fibers more room, or let them overlap: numerics.contact = "penalty"'
        return {
            "fiber": fiber,
            "partner": partner,
            "overlap_radii": overlap,
            "crossed": bool(crossed),
            "message": f"no step keeps contacts apart: fiber {fiber} {what}; {remedy}",
        }

    def close(self) -> None:
        """Stop worker threads."""
        self.search.close()
