"""[[wall]] with kind = "fiber_array": touching fibers along x in place of a plane of the box.

Their crests lie in the plane, so that the gap between walls and what is placed there stay. A flow
along x moves them along themselves: such an array touches what a still one touches.
Symbols: d diameter, n = edge // d fibers side by side, spacing edge/n >= d.
Limits: walls of y and z; methods without inertia.
"""

from __future__ import annotations

import math

from warpfiber.scene.derived import INERTIALESS
from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import number_text
from warpfiber.scene.keys import Values
from warpfiber.scene.pressing import WALL_NAMES
from warpfiber.scene.scene import Scene

ARRAY = "fiber_array"
WHOLE = 1e-9
"""Relative error of a number of fibers that is taken for a whole one."""


def fibers_side_by_side(edge: float, diameter: float) -> int:
    """Most fibers of a diameter that fit beside each other along an edge, both in m."""
    return math.floor(edge / diameter * (1.0 + WHOLE))


def wall_arrays(scene: Scene) -> tuple[tuple[float, float], ...]:
    """(spacing, radius) in m of the walls x-, x+, y- ...; (0, 0) for a plane; () without arrays."""
    shapes = [(0.0, 0.0)] * len(WALL_NAMES)
    for wall in scene.walls:
        if wall.kind == ARRAY and scene.box is not None and wall.diameter is not None:
            side = WALL_NAMES.index(wall.name)
            edge = scene.box.size[3 - side // 2]
            spacing = edge / fibers_side_by_side(edge, wall.diameter)
            shapes[side] = spacing, 0.5 * wall.diameter
    return tuple(shapes) if any(radius for _, radius in shapes) else ()


def check_arrays(draft: Draft) -> None:
    """Run all rules; faults and notes go to the draft's list."""
    taken: dict[str, int] = {}
    for index, wall in enumerate(draft.walls):
        path = f"wall.{index}"
        if draft.faulty(path) or wall["kind"] != ARRAY:
            continue
        other = taken.setdefault(wall["name"], index)
        if other != index:
            draft.blame(f"{path}.name", f"wall.{other} has this name already; keep one of them")
            continue
        if draft.method is not None and draft.method not in INERTIALESS:
            remedy = f"not available in method {draft.method}; use overdamped or rigid_rod"
            draft.blame(f"{path}.kind", remedy)
        if wall["friction"]:
            draft.blame(f"{path}.friction", "remove it; arrays have contact.wall_friction")
        if isinstance(wall["velocity"], tuple):
            remedy = 'an array goes with the flow along its fibers; use velocity = "flow"'
            draft.blame(f"{path}.velocity", remedy)
        _check_place(draft, wall, path)


def _check_place(draft: Draft, wall: Values, path: str) -> None:
    """The array stands for a wall of the box across y or z, whose flow there is along x."""
    walled = [axis for axis, _ in draft.axes("wall")]
    known = [name for k, name in enumerate(WALL_NAMES) if k // 2 in walled and k > 1]
    if wall["name"] not in known:
        if draft.box is not None and not draft.faulty("box"):
            names = " ".join(known)
            remedy = f"an array along x stands for a wall of the box across y or z: {names}"
            remedy = remedy if names else 'needs a wall across y or z in box.boundary, e.g. "z-"'
            draft.blame(f"{path}.name", remedy)
        return
    assert draft.box is not None
    axis = WALL_NAMES.index(wall["name"]) // 2
    gradient = draft.flow_object.velocity_gradient if draft.flow_object is not None else None
    if gradient is not None and any(any(row) for row in gradient[1:]):
        remedy = "the flow would move its fibers across themselves; use flow along x, or a plane"
        draft.blame(f"{path}.kind", remedy)
    edge, diameter = draft.box["size"][3 - axis], wall["diameter"]
    count = fibers_side_by_side(edge, diameter)
    if count < 1:
        wide = number_text(edge)
        draft.blame(f"{path}.diameter", f"wider than the box along {'xyz'[3 - axis]}, {wide} m")
        return
    if abs(edge / diameter - count) > WHOLE * count:
        spacing = number_text(float(f"{edge / count:.6g}"))
        draft.note(
            f"{path}: {number_text(edge)} m hold no whole number of fibers: {count} stand "
            f"{spacing} m apart, gaps of {100.0 * (edge / count / diameter - 1.0):.2g} %"
        )
