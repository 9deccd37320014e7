"""[[wall]] with kind = "cylinder": a rigid container along z around the fibers.

Symbols: R radius, d diameter of a fiber; the axis goes through `center`, the middle of the height.
Limits: one container of method bonded_spheres, upright; its side has no end, `height` says where
    fibers are placed; bottom and lid are walls of the box. Friction is `contact.wall_friction`
    unless it has its own.
"""

from __future__ import annotations

import math

from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import number_text
from warpfiber.scene.keys import Values
from warpfiber.scene.scene import Scene
from warpfiber.scene.tables import Wall

CYLINDER = "cylinder"


def container(scene: Scene) -> Wall | None:
    """The cylinder of a scene, if it has one."""
    return next((wall for wall in scene.walls if wall.kind == CYLINDER), None)


def check_containers(draft: Draft) -> None:
    """Run all rules; faults go to the draft's list."""
    found: int | None = None
    for index, wall in enumerate(draft.walls):
        path = f"wall.{index}"
        if draft.faulty(path) or wall["kind"] != CYLINDER:
            continue
        if found is not None:
            remedy = f"wall.{found} is a container already; keep one of them"
            draft.faults.add(path, None, remedy)
            continue
        found = index
        if draft.method not in (None, "bonded_spheres"):
            remedy = f"not available in method {draft.method}; use bonded_spheres"
            draft.blame(f"{path}.kind", remedy)
        if abs(wall["axis"][2]) < 1.0 - 1e-9:
            draft.blame(f"{path}.axis", "containers stand upright; use [0, 0, 1]")
        if wall["velocity"] is not None:
            draft.blame(f"{path}.velocity", "remove it; containers stand still")
        _check_room(draft, wall, path)


def _check_room(draft: Draft, wall: Values, path: str) -> None:
    """The container lies in the box, and fibers lie in the container."""
    if draft.box is None:
        draft.faults.add(path, None, "a container stands in a [box]; add one around it")
        return
    size, center, radius = draft.box["size"], wall["center"], wall["radius"]
    reach = (radius, radius, 0.5 * wall["height"])
    for axis, edge in enumerate(size):
        if center[axis] - reach[axis] < -1e-9 * edge or center[axis] + reach[axis] > edge * (
            1.0 + 1e-9
        ):
            key = "height" if axis == 2 else "radius"
            room = f"0 to {number_text(edge)} m along {'xyz'[axis]}"
            draft.blame(f"{path}.{key}", f"reaches out of the box, {room}; enlarge box.size")
    for index, group in enumerate(draft.fibers):
        wide = group["diameter"] or 0.0
        key = f"fibers.{index}.diameter"
        ring = group["shape"] is not None and group["shape"]["kind"] == "ring"
        if ring and group["centerline_length"] is not None:
            wide += group["centerline_length"] / math.pi
            key = draft.given(f"fibers.{index}", ("centerline_length", "length", "aspect_ratio"))
        # a ring may stand upright, its diameter along the axis, its thickness across
        least = min(wall["height"], 2.0 * radius) if ring else 2.0 * radius
        if wide > least:
            room = number_text(float(f"{least:.4g}"))
            draft.blame(key, f"does not fit into the container, {room} m wide; enlarge its radius")
