"""Defaults and sizes that depend on other tables: fiber counts, lengths, segments, forces, names.

Fills the draft in place. What needs a value that is absent or at fault is passed over: the missing
value is reported by its own check.
"""

from __future__ import annotations

import math

from warpfiber.scene.derived import SHORTEST_BOND, fiber_volume
from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import number_text
from warpfiber.scene.gripping import GRIPPING, strain_time
from warpfiber.scene.keys import Values
from warpfiber.scene.pressing import PRESSING, loading_time, passing_time
from warpfiber.scene.statistics import check_law, resolve_layers, resolve_lengths
from warpfiber.scene.tables import Flow

LENGTH_KEYS = ("aspect_ratio", "length", "centerline_length", "length_distribution")
COUNT_KEYS = ("count", "volume_fraction", "layers")
SEGMENT_KEYS = ("segments", "segment_length", "reduced_beads")

STRENGTH_FACTOR = 1000.0
"""Default D_0 = 1000 eta rate a^2, chosen here: the paper gives no value."""
LARGEST_RATIO = 1e6
"""Aspect ratio from which a power of ten must be wrong."""
LARGEST_COUNT = 2**31 - 1
"""Most fibers that a 32-bit index can number."""
ROUNDING = 1e-9
"""Relative error of a length ratio that is taken for a whole number."""


def resolve(draft: Draft) -> None:
    """Complete all tables of the draft; faults go to its list."""
    _resolve_flow(draft)
    for index, group in enumerate(draft.fibers if draft.saved is None else ()):
        resolve_lengths(draft, group, f"fibers.{index}")
        resolve_layers(draft, group, f"fibers.{index}")
        check_law(draft, group, f"fibers.{index}")
        _resolve_length(draft, group, f"fibers.{index}")
        _resolve_group(draft, group, f"fibers.{index}")
        _resolve_count(draft, group, f"fibers.{index}")
    if draft.saved is None:
        _resolve_segments(draft)
    _resolve_contact(draft)
    _resolve_stages(draft)
    record = draft.record
    if not any(draft.is_given(f"record.{key}") for key in ("frames", "every_strain", "every_time")):
        record["frames"] = 100
    _resolve_dt(draft)


def _resolve_flow(draft: Draft) -> None:
    """Place the origin; keep a `Flow` if the table has no fault."""
    flow = draft.flow
    if flow is None:
        return
    if not draft.is_given("flow.origin"):
        size = draft.box["size"] if draft.box is not None else None
        flow["origin"] = tuple(0.5 * edge for edge in size) if size else (0.0, 0.0, 0.0)
    if not draft.faulty("flow"):
        draft.flow_object = Flow(**flow)


def _resolve_length(draft: Draft, group: Values, path: str) -> None:
    """Complete aspect ratio, length and centerline length from the one that is given."""
    diameter = group["diameter"]
    if group["node_file"] is not None or group["length_distribution"] is not None:
        group.update(aspect_ratio=0.0, length=0.0, centerline_length=0.0)
        return
    if diameter is None:
        return
    if group["aspect_ratio"] is not None:
        ratio = group["aspect_ratio"]
    elif group["length"] is not None:
        ratio = group["length"] / diameter
    elif group["centerline_length"] is not None:
        ratio = group["centerline_length"] / diameter + 1.0
    else:
        return
    if ratio < LARGEST_RATIO and abs(ratio - round(ratio)) < ROUNDING * ratio:
        ratio = float(round(ratio))
    if not 1.0 < ratio < LARGEST_RATIO:
        long = "a million times" if ratio > 1.0 else "not"
        remedy = f"{long} longer than diameter = {number_text(diameter)}; check powers of ten"
        draft.blame(draft.given(path, LENGTH_KEYS), remedy)
        group.update(aspect_ratio=None, length=None, centerline_length=None)
        return
    length = ratio * diameter if group["length"] is None else group["length"]
    center = (ratio - 1.0) * diameter
    if group["centerline_length"] is not None:
        center = group["centerline_length"]
    group.update(aspect_ratio=ratio, length=length, centerline_length=center)


def _resolve_group(draft: Draft, group: Values, path: str) -> None:
    """Fill moduli, direction, position, initial velocity and the path of a node file."""
    for key in ("axial_modulus", "bending_modulus"):
        if not draft.is_given(f"{path}.{key}"):
            group[key] = group["youngs_modulus"]
    if group["orientation"] == "aligned":
        if not draft.is_given(f"{path}.direction"):
            group["direction"] = (1.0, 0.0, 0.0)
    elif group["direction"] is not None:
        draft.note(f"{path}.direction has no effect; it belongs to orientation = aligned")
        group["direction"] = None
    position = group["position"]
    if not draft.is_given(f"{path}.position"):
        group["position"] = "random" if draft.box is not None else ((0.0, 0.0, 0.0),)
    elif isinstance(position, tuple) and not isinstance(position[0], tuple):
        group["position"] = (position,)
    if not draft.is_given(f"{path}.initial_velocity"):
        group["initial_velocity"] = "flow" if draft.flow is not None else "rest"
    if group["shape"] is not None and group["shape"].get("file") is not None:
        file = draft.folder / group["shape"]["file"]
        if not file.is_file():
            remedy = f"no such file: {file}; it is sought beside the scene"
            draft.blame(f"{path}.shape.file", remedy)
        group["shape"]["file"] = str(file.absolute())
    if group["node_file"] is not None:
        file = draft.folder / group["node_file"]
        if not file.is_file():
            draft.blame(f"{path}.node_file", f"no such file: {file}; it is sought beside the scene")
        group["node_file"] = str(file.absolute())
        for key in ("orientation", "direction", "orientation_law", "position", "shape"):
            if draft.is_given(f"{path}.{key}"):
                draft.note(f"{path}.{key} has no effect; node_file has the nodes")


def _resolve_count(draft: Draft, group: Values, path: str) -> None:
    """Find the number of fibers of a volume fraction, to the nearest whole one, at least 1."""
    group["volume_fraction_achieved"] = None
    if group["node_file"] is not None:
        group["count"] = 0
        return
    if group["length_distribution"] is not None:
        group["count"] = group["count"] or 0
        if draft.box is None:
            draft.blame(f"{path}.length_distribution", "needs a [box]; add one")
        return
    box = draft.box
    if box is None:
        if group["volume_fraction"] is not None:
            draft.blame(f"{path}.volume_fraction", "needs a [box]; add one, or give count")
        return
    if not box["size"] or not box["volume_rule"] or not group["length"]:
        return
    volume = fiber_volume(box["volume_rule"], group["diameter"], group["length"])
    if group["shape"] is not None and group["shape"]["kind"] == "ring":  # has no ends
        volume = fiber_volume("centerline", group["diameter"], group["length"])
    space = math.prod(box["size"])
    share = volume / space if space > 0.0 else 0.0
    asked = group["volume_fraction"]
    if share == 0.0 or (asked or 0.0) / share > LARGEST_COUNT:
        remedy = "too many fibers for the box; check powers of ten"
        draft.blame(draft.given(path, ("volume_fraction", "count")), remedy)
        return
    if group["count"] is None and asked is not None:
        group["count"] = max(1, math.floor(asked / share + 0.5))
    if group["count"] is None:
        return
    achieved = group["count"] * share
    group["volume_fraction_achieved"] = achieved
    if asked is not None and abs(achieved / asked - 1.0) > 0.01:
        count = group["count"]
        draft.note(f"{path}.volume_fraction: {count} fibers give {achieved:.4g}, not {asked}")


def _resolve_segments(draft: Draft) -> None:
    """Find the segments per fiber of each group from the number, length or beads asked for."""
    for group in draft.fibers:
        varied = group["node_file"] is not None or group["length_distribution"] is not None
        group["segments"] = 0 if varied else None
    place = draft.given("numerics", SEGMENT_KEYS)
    key = place.rpartition(".")[2]
    if draft.method == "rigid_rod" and draft.numerics[key] is None and not draft.is_given(place):
        draft.numerics[key] = 1
    asked = draft.numerics[key]
    if asked is None:
        if draft.fibers and all(group["node_file"] is not None for group in draft.fibers):
            return
        if not any(draft.is_given(f"numerics.{name}") for name in SEGMENT_KEYS):
            names = ", ".join(SEGMENT_KEYS)
            draft.faults.add("numerics", None, f"missing; give exactly one of {names}")
        return
    per_group = asked if isinstance(asked, tuple) else (asked,) * len(draft.fibers)
    if len(per_group) != len(draft.fibers):
        remedy = f"{len(per_group)} entries for {len(draft.fibers)} [[fibers]]; give one per group"
        draft.blame(place, remedy)
        return
    for index, (group, value) in enumerate(zip(draft.fibers, per_group, strict=True)):
        if group["node_file"] is not None:
            group["segments"] = value if draft.is_given("numerics.segments") else 0
        elif group["aspect_ratio"]:
            group["segments"] = _segments(draft, group, index, place, value)


def _segments(draft: Draft, group: Values, index: int, place: str, asked: float) -> int | None:
    """Return the whole number of segments of one group; None with a fault if M < 1 would follow."""
    beads = float(group["aspect_ratio"]) - 1.0
    shortest = SHORTEST_BOND if draft.method == "bonded_spheres" else 1.0
    most = math.floor(beads / shortest * (1.0 + ROUNDING))
    name = f"fibers.{index}"
    if most < 1:
        key = draft.given(name, LENGTH_KEYS)
        draft.blame(key, "too short for one segment; give an aspect ratio of 2 or more")
        return None
    ratio = number_text(group["aspect_ratio"])
    if place.endswith(".segments"):
        if asked > most:
            least = "one per bead" if shortest == 1.0 else "half a diameter each"
            remedy = f"too many for {name} with aspect ratio {ratio}; at most {most} = {least}"
            draft.blame(place, remedy)
            return None
        return int(asked)
    if place.endswith(".segment_length"):
        least_length = shortest * group["diameter"]
        if asked < least_length * (1.0 - ROUNDING):
            than = "the diameter" if shortest == 1.0 else "half the diameter"
            remedy = f"shorter than {than} of {name}; give at least {number_text(least_length)}"
            draft.blame(place, remedy)
            return None
        return min(most, max(1, round(float(group["centerline_length"]) / asked)))
    if asked + 1.0 > beads * (1.0 + ROUNDING):
        remedy = f"too many for {name} with aspect ratio {ratio}"
        draft.blame(place, f"{remedy}; at most {number_text(beads - 1.0)} = one segment")
        return None
    return min(most, max(1, round(beads / (asked + 1.0))))


def _resolve_contact(draft: Draft) -> None:
    """Default strength D_0 = 1000 eta rate a^2 of the thickest fibers."""
    contact = draft.contact
    pushing = contact["law"] == "exponential" or bool(draft.axes("wall"))
    if draft.method == "bonded_spheres" or not pushing:
        contact["strength"], contact["decay"] = 0.0, 50.0
        return
    if contact["law"] == "none":  # no pairs, but walls still hold
        contact["decay"] = 50.0
    if contact["strength"] is not None or draft.is_given("contact.strength"):
        return
    flow = draft.flow_object
    if flow is None:
        return
    if draft.numerics["contact"] == "unilateral" or contact["law"] == "linear":
        contact["strength"] = 0.0  # has no meaning there
        return
    if flow.rate == 0.0:
        remedy = "missing: no flow rate to set it; give N"
        if contact["law"] == "none":
            remedy = 'missing: walls push by it; give N and law = "exponential"'
        elif not draft.axes("wall"):
            remedy += ', or law = "none"'
        draft.faults.add("contact.strength", None, remedy)
        return
    diameters = [group["diameter"] for group in draft.fibers]
    if diameters and None not in diameters:
        radius = 0.5 * max(diameters)
        contact["strength"] = STRENGTH_FACTOR * flow.viscosity * flow.rate * radius * radius


def _resolve_stages(draft: Draft) -> None:
    """Name the stages, and limit the time of those that no strain or time ends.

    A wall on its way limits it by itself; the strain of grips is a time.
    """
    for index, stage in enumerate(draft.stages):
        if stage["name"] is None:
            stage["name"] = stage["kind"]
        ended = any(draft.is_given(f"stage.{index}.{key}") for key in ("end_strain", "end_time"))
        if stage["time_limit"] is None and not ended:
            longest = loading_time if stage["control"] == "load" else passing_time
            stage["time_limit"] = longest(draft, stage) or 100.0
        if stage["kind"] in PRESSING and stage["control"] is None:
            stage["control"] = "displacement"
        seconds = strain_time(stage)
        if seconds is not None:
            stage["end_time"] = min(seconds, stage["end_time"] or seconds)
        if stage["kind"] in GRIPPING and stage["freeze"] is None:
            stage["freeze"] = "fibers"
        for key, default in (("batch", 1), ("interval", 0.0), ("damping", 0.0)):
            stage[key] = default if stage[key] is None else stage[key]
        if stage["repeat"] is None:
            stage["repeat"] = 1


def _resolve_dt(draft: Draft) -> None:
    """Turn auto into None and a strain step into a time step."""
    numerics = draft.numerics
    for key in ("dt", "workers", "skin"):
        if numerics[key] == "auto":
            numerics[key] = None
    if draft.method == "rigid_rod":  # nothing is solved, so neither has a meaning
        numerics.update(integrator=None, tolerance=None)
    step, flow = numerics["strain_step"], draft.flow_object
    if step is None or flow is None:
        return
    if flow.rate == 0.0:
        draft.blame("numerics.strain_step", "the flow has no rate; give dt in s instead")
        return
    numerics["dt"] = step / flow.rate
