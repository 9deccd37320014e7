"""Rules between keys and tables: each function looks at one thing that can go wrong together.

Limits: what the scene alone shows. The stable time step, the device and the packing of fibers need
more than the scene and are checked later.
"""

from __future__ import annotations

import math

from warpfiber.scene.arrays import check_arrays
from warpfiber.scene.availability import NOT_IN_METHOD, unavailable_in
from warpfiber.scene.containers import check_containers
from warpfiber.scene.derived import INERTIALESS, reach
from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import number_text
from warpfiber.scene.gripping import GRIPPING, check_gripping
from warpfiber.scene.keys import Values
from warpfiber.scene.loads import check_loads
from warpfiber.scene.planes import check_planes
from warpfiber.scene.pouring import check_pouring
from warpfiber.scene.pressing import check_pressing
from warpfiber.scene.resolving import COUNT_KEYS, LENGTH_KEYS, SEGMENT_KEYS
from warpfiber.scene.starting import check_saving
from warpfiber.scene.tables import strain_rate

AXES = "xyz"
DRAGGED = ("bead_chain", *INERTIALESS)
"""Methods without another cause of motion than a fluid."""
HOPELESS_FRACTION = 0.9
"""Volume fraction that no packing of straight fibers reaches: touching parallel cylinders fill
pi/(2 sqrt 3) = 0.907."""
LARGEST_POISSON = 0.5
WALL_GAP = 1e-3
"""Gap kept to walls by the placement, in radii."""


def cross_check(draft: Draft) -> None:
    """Run all rules; faults and notes go to the draft's list."""
    _check_tables(draft)
    _check_method(draft)
    _check_flow(draft)
    _check_flow_in_box(draft)
    _check_periodic_edges(draft)
    for index, group in enumerate(draft.fibers):
        _check_walls(draft, group, f"fibers.{index}")
        _check_self_contact(draft, group, f"fibers.{index}")
        _check_positions(draft, group, f"fibers.{index}")
    _check_filling(draft)
    _check_contact(draft)
    _check_stages(draft)
    _check_rest(draft)
    _check_record(draft)
    check_arrays(draft)
    check_containers(draft)
    check_planes(draft)
    check_loads(draft)
    check_pressing(draft)
    check_gripping(draft)
    check_pouring(draft)
    check_saving(draft)


def _check_tables(draft: Draft) -> None:
    """Ask for the tables that a scene, or its method, cannot do without."""
    if draft.start is None and not draft.fibers and not draft.faulty("fibers"):
        draft.faults.add("fibers", None, "missing; add at least one [[fibers]]")
    if not draft.stages and not draft.faulty("stage"):
        draft.faults.add("stage", None, 'missing; add a [[stage]] with kind = "flow"')
    if draft.method in DRAGGED and not draft.is_given("flow"):
        remedy = 'add [flow] with kind and viscosity (kind = "rest" for a still fluid)'
        draft.faults.add("flow", None, f"missing: {draft.method} moves fibers by drag; {remedy}")


def _check_method(draft: Draft) -> None:
    """What the method cannot run, defaults included, and what its step and weight need."""
    for row in NOT_IN_METHOD.get(draft.method or "", ()):
        tables: dict[str, Values | None]
        many = {"fibers": draft.fibers, "stage": draft.stages}
        if row.table in many:
            tables = {f"{row.table}.{i}": table for i, table in enumerate(many[row.table])}
        elif row.table == "shape":
            groups = enumerate(draft.fibers)
            tables = {f"fibers.{index}.shape": group["shape"] for index, group in groups}
        else:
            tables = {row.table: getattr(draft, row.table)}
        for path, values in tables.items():
            value = values[row.key] if values is not None else None
            remedy = unavailable_in(draft.method, row.table, row.key, value)
            key = f"{path}.{row.key}"
            if value is not None and remedy is not None and not draft.faulty(key):
                given = draft.is_given(key)
                draft.faults.add(key, value, remedy if given else f"the default is {remedy}")
    if draft.method == "bonded_spheres":
        _check_bonded_spheres(draft)
    if draft.method not in INERTIALESS:
        return
    if draft.method == "rigid_rod":
        _check_rods(draft)
    if draft.numerics["tolerance"] is not None:
        if draft.numerics["integrator"] == "bdf2":
            remedy = 'bdf2 takes steps of one size; use integrator = "sdirk2", or dt'
            draft.blame("numerics.tolerance", remedy)
        elif draft.flow_object is not None and draft.flow_object.rate == 0.0:
            draft.blame("numerics.tolerance", "the flow has no rate; give dt in s instead")
    for index, group in enumerate(draft.fibers):
        if draft.is_given(f"fibers.{index}.initial_velocity"):
            draft.note(f"fibers.{index}.initial_velocity has no effect in method {draft.method}")
        if draft.gravity is not None and group["density"] is None and not group["frozen"]:
            draft.faults.add(
                f"fibers.{index}.density", None, "missing; [gravity] needs it in kg/m3"
            )


def _check_rods(draft: Draft) -> None:
    """A rod has one segment and keeps its length."""
    place = draft.given("numerics", SEGMENT_KEYS)
    if any((group["segments"] or 1) != 1 for group in draft.fibers):
        remedy = 'a rod is one segment; remove it, or use method = "overdamped" or "auto"'
        draft.blame(place, remedy)
    for index in range(len(draft.fibers)):
        if draft.is_given(f"fibers.{index}.inextensible"):
            draft.note(f"fibers.{index}.inextensible has no effect: rods keep their length")


def _check_bonded_spheres(draft: Draft) -> None:
    """No fluid; elastic constants that hold together; rows of stages of unknown length."""
    if draft.is_given("flow"):
        draft.faults.add("flow", None, "bonded_spheres has no fluid; remove the table")
    if draft.numerics["strain_step"] is not None:
        draft.blame("numerics.strain_step", "nothing is strained at a rate; give dt in s instead")
    for index, group in enumerate(draft.fibers):
        path = f"fibers.{index}"
        if group["bending_modulus"] == 0.0:
            draft.blame(f"{path}.bending_modulus", "a bond without bending has no shape; give > 0")
        if (group["poisson_ratio"] or 0.0) > LARGEST_POISSON:
            draft.blame(f"{path}.poisson_ratio", "no isotropic solid has more than 0.5")
    for index, stage in enumerate(draft.stages):
        if stage["time_limit"] is not None and not draft.is_given(f"stage.{index}.time_limit"):
            limit = number_text(stage["time_limit"])
            draft.note(
                f"stage.{index}: rows and frames are spread over time_limit = {limit} s (default); "
                "give a nearer one for more of them"
            )


def _check_flow(draft: Draft) -> None:
    """The gradient is of an incompressible fluid and not zero; the schedule lets strain grow."""
    if draft.flow is None:
        return
    gradient = draft.flow["gradient"]
    if gradient is not None:
        largest = max(abs(entry) for row in gradient for entry in row)
        trace = gradient[0][0] + gradient[1][1] + gradient[2][2]
        if largest == 0.0:
            draft.blame("flow.gradient", 'all entries are 0; use kind = "rest"')
        elif strain_rate(gradient) <= 1e-12 * largest:
            draft.blame("flow.gradient", "a rotation without strain; give one that deforms")
        elif abs(trace) > 1e-9 * largest:
            remedy = f"the diagonal sums to {number_text(trace)}; it must be 0 (incompressible)"
            draft.blame("flow.gradient", remedy)
    schedule = draft.flow["schedule"]
    if schedule is not None:
        strains = [pair[0] for pair in schedule]
        if strains[0] < 0.0 or any(b <= a for a, b in zip(strains, strains[1:], strict=False)):
            draft.blame("flow.schedule", "strains must grow from pair to pair and be >= 0")
        if any(pair[1] <= 0.0 for pair in schedule):
            draft.blame("flow.schedule", "factors must be > 0; at 0 the strain would stop there")


def _check_flow_in_box(draft: Draft) -> None:
    """The lattice moves with the flow if all axes are periodic; else images would differ.

    Without pairs, images beside open axes do not matter.
    """
    flow = draft.flow_object
    gradient = flow.velocity_gradient if flow is not None else None
    meets = draft.axes("open") and draft.contact["law"] != "none"
    if flow is None or gradient is None or not (draft.axes("wall") or meets):
        return
    others = "walls" if draft.axes("wall") else "open axes"
    for axis, _ in draft.axes("periodic"):
        if any(row[axis] != 0.0 for row in gradient):
            remedy = f"{flow.kind} changes along the periodic axis {AXES[axis]} of a box with "
            remedy += f"{others}; make that axis a wall or open, or all axes periodic"
            key = "box.boundary" if draft.is_given("box.boundary") else "flow.kind"
            draft.blame(key, remedy)


def _check_periodic_edges(draft: Draft) -> None:
    """A periodic edge holds the longest segment and its reach, else images are missed."""
    longest, radius = 0.0, 0.0
    for index, group in enumerate(draft.fibers):
        radius = max(radius, 0.5 * (group["diameter"] or 0.0))
        if group["segments"] and group["centerline_length"]:
            longest = max(longest, group["centerline_length"] / group["segments"])
        for axis, edge in draft.axes("periodic"):
            length = group["length"] or 0.0
            if length > 0.5 * edge:
                size = "the box" if length > edge else "half the box"
                draft.note(f"fibers.{index}: longer than {size} along {AXES[axis]} (periodic)")
    law, lubrication = draft.contact["law"], draft.contact["lubrication"]
    if longest == 0.0 or law in (None, "none") or lubrication is None:
        return
    span = reach(law, lubrication, radius)
    for axis, edge in draft.axes("periodic"):
        if edge < longest + span:
            place = draft.given("numerics", SEGMENT_KEYS).rpartition(".")[2]
            least = number_text(float(f"{longest + span:.4g}"))
            draft.blame(
                "box.size",
                f"periodic edge {AXES[axis]} is shorter than a segment + its reach = {least} m;"
                f" enlarge it, or make segments shorter (numerics.{place})",
            )


def _check_walls(draft: Draft, group: Values, path: str) -> None:
    """A fiber fits between the walls: its diameter always, its length as far as it points there."""
    diameter, center = group["diameter"], group["centerline_length"]
    if diameter is None or center is None:
        return
    thickness = diameter * (1.0 + WALL_GAP)
    for axis, gap in draft.axes("wall"):
        direction = group["direction"]
        across = abs(direction[axis]) * center if direction is not None else 0.0
        if thickness > gap:
            key = f"{path}.diameter"
        elif across + thickness > gap:
            key = draft.given(path, LENGTH_KEYS)
        else:
            if direction is None and (group["length"] or 0.0) > gap:
                draft.note(f"{path}: longer than the gap between the walls along {AXES[axis]}")
            continue
        wide = f"{number_text(gap)} m between the walls along {AXES[axis]}"
        draft.blame(key, f"does not fit into the {wide}; shorten it, or enlarge box.size")


def _check_self_contact(draft: Draft, group: Values, path: str) -> None:
    """A fiber aligned with a periodic axis is shorter than the box, else it meets its image."""
    direction, length = group["direction"], group["length"]
    if direction is None or length is None:
        return
    for axis, edge in draft.axes("periodic"):
        if abs(direction[axis]) > 1.0 - 1e-9 and length > edge:
            key = draft.given(path, LENGTH_KEYS)
            remedy = f"aligned along the periodic axis {AXES[axis]} it overlaps its own image"
            draft.blame(key, f"{remedy}; enlarge box.size, or change direction")


def _check_positions(draft: Draft, group: Values, path: str) -> None:
    """Centers: one per fiber, inside the walls; several fibers share one only if nothing acts."""
    position, count, key = group["position"], group["count"], f"{path}.position"
    if position is None or group["node_file"] is not None:
        return
    if position == "random":
        if draft.box is None:
            draft.blame(key, "random needs a [box]; add one, or give the centers")
        return
    alone = draft.contact["law"] == "none"
    if count is not None and len(position) != count and not (alone and len(position) == 1):
        remedy = f"{len(position)} center(s) for {count} fibers; give one center per fiber"
        remedy += "" if draft.is_given(key) else ", or a [box]"
        draft.blame(key, remedy)
    for axis, edge in draft.axes("wall") + draft.axes("open"):
        if any(not 0.0 <= center[axis] <= edge for center in position):
            remedy = f"a center is outside the box along {AXES[axis]}"
            draft.blame(key, f"{remedy}; keep it between 0 and {number_text(edge)}")


def _check_filling(draft: Draft) -> None:
    """All groups together fill less of the box than the densest packing of cylinders."""
    shares = [
        group["volume_fraction_achieved"] or group["volume_fraction"] or 0.0
        for group in draft.fibers
    ]
    total = math.fsum(shares)
    if total >= HOPELESS_FRACTION:
        fullest = shares.index(max(shares))
        key = draft.given(f"fibers.{fullest}", COUNT_KEYS)
        remedy = f"all fibers fill {number_text(float(f'{total:.3g}'))} of the box"
        draft.blame(key, f"{remedy}; stay below {HOPELESS_FRACTION}")


def _check_contact(draft: Draft) -> None:
    """No law means no pairs, so no lubrication either."""
    if draft.contact["law"] == "none" and draft.contact["lubrication"] in ("paper", "shifted"):
        remedy = 'law = "none" switches off all pairs; remove it, or use law = "exponential"'
        draft.blame("contact.lubrication", remedy)
    if draft.method not in INERTIALESS:
        return
    if draft.contact["law"] == "none" and draft.axes("wall"):
        remedy = 'walls push by contact; use law = "exponential", or no wall in box.boundary'
        draft.blame("contact.law", remedy)
    for key in ("friction", "wall_friction"):
        if draft.contact[key] and draft.numerics["contact"] == "penalty":
            remedy = 'penalties are frictionless; use numerics.contact = "unilateral"'
            draft.blame(f"contact.{key}", remedy)
        elif draft.contact[key] and draft.contact["law"] == "none":
            draft.note(f'contact.{key} has no effect; contact.law = "none" switches off contact')
    if draft.contact["law"] != "none" and draft.numerics["integrator"] == "bdf2":
        remedy = 'contact needs a method of one step; use "sdirk2", or contact.law = "none"'
        draft.blame("numerics.integrator", remedy)


def _check_stages(draft: Draft) -> None:
    """A repeat goes back to one known stage."""
    names: list[str | None] = []
    for index, stage in enumerate(draft.stages):
        names.append(stage["name"])
        place, target = f"stage.{index}.repeat_from", stage["repeat_from"]
        if target is None:
            if stage["repeat"] != 1:
                draft.blame(f"stage.{index}.repeat", "needs repeat_from; name the first stage")
        elif target not in names:
            known = ", ".join(f'"{name}"' for name in names if name)
            draft.blame(place, f"no such stage up to here; known: {known}")
        elif names.count(target) > 1:
            draft.blame(place, f'{names.count(target)} stages are named "{target}"; rename them')


def _check_rest(draft: Draft) -> None:
    """Without a rate the strain never grows, so nothing can wait for it."""
    still = draft.flow is None and draft.method not in DRAGGED
    if draft.flow_object is not None:
        still = draft.flow_object.kind == "rest"
    if not still:
        return
    for index, stage in enumerate(draft.stages):
        if stage["kind"] in GRIPPING:  # have a strain of their own
            continue
        if stage["end_strain"] is not None and stage["end_time"] is None:
            draft.blame(f"stage.{index}.end_strain", "the fluid rests; end the stage by end_time")
    if draft.record["every_strain"] is not None:
        draft.blame("record.every_strain", "the fluid rests; use every_time or frames")


def _check_record(draft: Draft) -> None:
    """Layers are slices of a box, and stress is force over its faces."""
    if draft.box is not None or draft.start is not None:
        return
    if draft.record["layers"]:
        draft.blame("record.layers", "layers are slices of a box; add [box], or remove it")
    if "stress" in (draft.record["quantities"] or ()) and draft.method in INERTIALESS:
        draft.blame("record.quantities", "stress is that of a box; add [box], or remove stress")
