"""What `numerics.method = "auto"` becomes: the method that runs a scene at the least cost.

`rigid_rod` if no group of fibers bends or stretches by more than the tolerance (`rigidity`), else
`overdamped`; what these cannot run goes to the next one that can, in the end `bead_chain`. A scene
that asks for inertia, by an initial velocity other than the flow's, is for `bead_chain`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from warpfiber.scene.derived import bending_stiffness, fiber_volume
from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import Fault, number_text, value_text
from warpfiber.scene.keys import Values
from warpfiber.scene.resolving import SEGMENT_KEYS
from warpfiber.scene.rigidity import (
    BUCKLING_STIFFNESS,
    contact_deflection,
    flow_deflection,
    flow_stretch,
    largest_contact_force,
)
from warpfiber.scene.tables import Flow, strain_rate

ROD_TOLERANCE = 1e-3
"""Deformation of a fiber, in its length, below which it is a rod unless a tolerance is given."""
TRIAL_SPAN = 10.0
"""The bound on bending by contact is of two lone rods; in crowded cells others pass their forces
on (2.5 times the bound at V_f r_f = 2). Rods are taken at once if it is this many times below the
tolerance, and put to a trial up to as many times above it."""
_FOR_OTHERS = (*SEGMENT_KEYS, "integrator", "tolerance")
"""Keys of [numerics] that say how the fibers bend, if they do."""


def is_auto(tables: Mapping[str, Any]) -> bool:
    """Tell whether the method is to be chosen."""
    numerics = tables.get("numerics")
    return isinstance(numerics, dict) and numerics.get("method") == "auto"


def with_method(tables: Mapping[str, Any], method: str) -> dict[str, Any]:
    """The raw tables with a chosen method, without what only those not chosen would use."""
    numerics = dict(tables["numerics"]) | {"method": method}
    if method == "rigid_rod":
        numerics = {key: value for key, value in numerics.items() if key not in _FOR_OTHERS}
    return dict(tables) | {"numerics": numerics}


class Choice(NamedTuple):
    """A method and why; the tolerance of rods where only a trial can tell whether contact bends."""

    method: str
    reason: str
    trial: float | None = None


def choose_method(read: Callable[[str], Draft]) -> Choice:
    """Return the method; `read` gives the checked draft that the scene is with a method.

    Where none runs the scene: the one with the fewest faults, to report them.
    """
    drafts = {"overdamped": read("overdamped")}
    error, reason = rod_error(drafts["overdamped"])
    asked = drafts["overdamped"].numerics["tolerance"] or ROD_TOLERANCE
    candidates, trial = ["overdamped", "bead_chain"], None
    if asks_inertia(drafts["overdamped"]):
        candidates, reason = ["bead_chain"], "initial_velocity asks for inertia"
    elif math.isfinite(error):
        by_flow, _ = rod_error(drafts["overdamped"], contact=False)
        where = "tolerance" if error <= asked else "above the tolerance"
        reason = f"{reason}, {where} {number_text(asked)}"
        if by_flow <= asked and error <= max(by_flow, asked / TRIAL_SPAN):
            candidates.insert(0, "rigid_rod")
        elif by_flow <= asked and error <= TRIAL_SPAN * asked:
            flow = drafts["overdamped"].flow_object  # a trial is a strain of it
            if flow is not None and flow.rate > 0.0 and not read("rigid_rod").faults.faults:
                trial = asked
    fewest = math.inf
    best = Choice(candidates[-1], reason)
    for method in candidates:
        if method not in drafts:
            drafts[method] = read(method)
        faults = drafts[method].faults.faults
        if not faults:
            return Choice(method, reason, trial)
        if len(faults) <= fewest:
            fewest, best = len(faults), Choice(method, reason)
        reason = f"{method} cannot run {_named(faults[0])}"
    return best


def asks_inertia(draft: Draft) -> bool:
    """Tell whether a group starts with a velocity of its own, which drag alone does not keep."""
    return any(
        draft.raw_value(f"fibers.{index}.initial_velocity") not in (None, "flow")
        for index in range(len(draft.fibers))
    )


def rod_error(draft: Draft, contact: bool = True) -> tuple[float, str]:
    """Largest deformation of a fiber as a bound, in its length, and in words; inf if unknown.

    `contact`: of contact too, not of the flow alone.
    """
    if draft.flow_object is None or not draft.fibers:
        return math.inf, "the scene has no flow"
    if draft.loads:
        return math.inf, "what a [[load]] bends is not known"
    pushes = contact and (draft.contact["law"] != "none" or bool(draft.axes("wall")))
    errors = [
        _group_error(group, f"fibers.{index}", draft.flow_object, pushes, _weight(draft, group))
        for index, group in enumerate(draft.fibers)
    ]
    return max(errors, key=lambda found: found[0])


def _weight(draft: Draft, group: Values) -> float:
    """Weight less buoyancy of a fiber in N: what presses it on a wall or another fiber."""
    gravity, density = draft.gravity, group["density"]
    if gravity is None or density is None or not group["length"]:
        return 0.0
    volume = fiber_volume("cylinder", group["diameter"], group["length"])
    lift = abs(density - (gravity["fluid_density"] or 0.0))
    return float(lift * volume * math.hypot(*(gravity["acceleration"] or (0.0,))))


def _group_error(
    group: Values, name: str, flow: Flow, pushes: bool, weight: float
) -> tuple[float, str]:
    if group["node_file"] is not None:
        return math.inf, f"the node file of {name} may hold bent fibers"
    if group["length_distribution"] is not None:
        return math.inf, f"fibers of many lengths ({name}) are packed as chains"
    sizes = ("aspect_ratio", "diameter", "length", "bending_modulus", "axial_modulus")
    ratio, diameter, length, bending, axial = (group[key] for key in sizes)
    gradient = flow.velocity_gradient
    if None in (ratio, diameter, length, bending, axial) or gradient is None:
        return math.inf, f"{name} is not known"
    if flow.rate == 0.0:
        bent = contact_deflection(weight, length, 0.5 * diameter, bending)
        if not pushes or weight == 0.0:
            return 0.0, "nothing moves the fluid"
        return bent, f"bending of {name} under its weight {_share(bent)}"
    factor = max(row[1] for row in flow.schedule or ((0.0, 1.0),))
    stiffness = bending_stiffness(bending, ratio, flow.viscosity * flow.rate * factor)
    if stiffness <= BUCKLING_STIFFNESS:
        bounds = f"S_eff {stiffness:.2g} <= {BUCKLING_STIFFNESS}"
        return math.inf, f"the flow may buckle {name} ({bounds})"
    largest = factor * strain_rate(gradient) / math.sqrt(3.0)
    errors = {f"bending of {name} by the flow": flow_deflection(stiffness)}
    if not group["inextensible"]:
        stretch = flow_stretch(ratio, axial, largest, flow.viscosity)
        errors[f"stretch of {name} by the flow"] = stretch
    if pushes:
        force = largest_contact_force(ratio, 0.5 * diameter, largest, flow.viscosity)
        bent = contact_deflection(force + weight, length, 0.5 * diameter, bending)
        errors[f"bending of {name} by contact"] = bent
    cause = max(errors, key=lambda what: errors[what])
    return errors[cause], f"{cause} {_share(errors[cause])}"


def _share(error: float) -> str:
    return f"up to {number_text(float(f'{error:.2g}'))} of its length"


def _named(fault: Fault) -> str:
    value = "" if fault.value is None else f" = {value_text(fault.value)}"
    return f"{fault.key}{value}"
