"""Stages that move a plane wall of the box: which wall, and what can end them.

Limits: the walls of one axis only; what a bed bears is found by the run alone.
"""

from __future__ import annotations

import math

from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import number_text
from warpfiber.scene.gripping import GRIPPING
from warpfiber.scene.keys import Values
from warpfiber.scene.scene import Scene, Stage

PRESSING = ("compress", "unload")
PRESS_ENDS = ("end_volume_fraction", "end_pressure")
WALL_NAMES = tuple(axis + sign for axis in "xyz" for sign in "-+")


def wall_side(stage: Stage) -> int:
    """0 for the lower wall of the axis, 1 for the upper one."""
    return int((stage.wall or "")[1:] == "+")


def pressed_axis(scene: Scene) -> int:
    """Axis whose walls move, else the last one whose walls are metered; -1 without."""
    for stage in scene.stages:
        if stage.kind in PRESSING and stage.wall is not None:
            return WALL_NAMES.index(stage.wall) // 2
    walls = [] if scene.box is None else [k for k in range(3) if scene.box.boundary[k] == "wall"]
    metered = "stress" in scene.record.quantities or any(stage.save for stage in scene.stages)
    return walls[-1] if walls and metered else -1


def passing_time(draft: Draft, stage: Values) -> float | None:
    """Seconds in which the wall passes through the whole box; None where it is not known."""
    if stage["kind"] not in PRESSING or stage["wall"] not in WALL_NAMES or not stage["speed"]:
        return None
    axis = WALL_NAMES.index(stage["wall"]) // 2
    edges = dict(draft.axes("wall"))
    return edges[axis] / stage["speed"] if axis in edges else None


def loading_time(draft: Draft, stage: Values) -> float | None:
    """Seconds in which a plate passes through the box and is loaded to `end_pressure`."""
    longest, rate, end = passing_time(draft, stage), stage["pressure_rate"], stage["end_pressure"]
    if longest is None or not rate or not end or stage["kind"] != "compress":
        return None
    return longest + float(end / rate)


def check_pressing(draft: Draft) -> None:
    """Run all rules; faults go to the draft's list."""
    gripped = any(stage["kind"] in GRIPPING for stage in draft.stages)
    if "stress" in (draft.record["quantities"] or ()) and not draft.axes("wall") and not gripped:
        if draft.method == "bonded_spheres" and not draft.faulty("box"):
            remedy = 'it is the pressure on walls; make an axis "wall" in box.boundary'
            draft.blame("record.quantities", remedy)
    axes: set[int] = set()
    filled = math.fsum(group["volume_fraction_achieved"] or 0.0 for group in draft.fibers)
    for index, stage in enumerate(draft.stages):
        path = f"stage.{index}"
        if stage["kind"] not in PRESSING:
            _check_still(draft, stage, path)
            continue
        if stage["end_speed"] is not None:
            draft.blame(f"{path}.end_speed", f"a moving wall keeps nodes moving; {_advice()}")
        if stage["wall"] is not None:
            _check_wall(draft, stage, path, axes)
        _check_reached(draft, stage, path, filled)


def _advice() -> str:
    return f"end the stage by {PRESS_ENDS[0]}, {PRESS_ENDS[1]} or end_time"


def _check_still(draft: Draft, stage: Values, path: str) -> None:
    """No wall moves in other stages: neither fraction nor pressure goes to a mark."""
    for key in PRESS_ENDS:
        if stage[key] is not None and stage["kind"] == "settle":
            remedy = 'no wall moves in kind = "settle", so it would never end the stage; '
            draft.blame(f"{path}.{key}", remedy + "use end_speed or end_time")


def _check_wall(draft: Draft, stage: Values, path: str, axes: set[int]) -> None:
    """The wall is one of the box, and all that move are of one axis."""
    key, walls = f"{path}.wall", [axis for axis, _ in draft.axes("wall")]
    known = [name for k, name in enumerate(WALL_NAMES) if k // 2 in walls]
    if stage["wall"] not in known:
        names = ", ".join(f'"{name}"' for name in known)
        remedy = f"no such wall; the box has {names or 'none'}"
        draft.blame(key, remedy if known else f'{remedy}: make an axis "wall" in box.boundary')
        return
    axes.add(WALL_NAMES.index(stage["wall"]) // 2)
    if len(axes) > 1:
        draft.blame(key, "only the walls of one axis can move in a scene; press along one axis")


def _check_reached(draft: Draft, stage: Values, path: str, filled: float) -> None:
    """The end lies on the way of the wall, which stays inside the box."""
    end, inwards = stage["end_volume_fraction"], stage["kind"] == "compress"
    if end is not None and end <= filled:
        now = number_text(float(f"{filled:.4g}"))
        key = f"{path}.end_volume_fraction"
        if inwards:
            draft.blame(key, f"the whole box has {now} already; give more")
        else:
            draft.blame(key, f"never reached: the whole box has {now}; give more")
    if draft.is_given(f"{path}.pressure_rate") and stage["control"] == "displacement":
        remedy = 'without effect on a wall that moves at speed; add control = "load", or remove it'
        draft.blame(f"{path}.pressure_rate", remedy)
    if stage["end_pressure"] == 0.0 and inwards:
        draft.blame(f"{path}.end_pressure", "met from the start; give a pressure above 0")
    longest = passing_time(draft, stage)
    if stage["control"] == "load":
        return
    if stage["end_time"] is None or longest is None or any(stage[key] for key in PRESS_ENDS):
        return
    if stage["end_time"] > longest:
        least = number_text(float(f"{longest:.4g}"))
        draft.blame(f"{path}.end_time", f"the wall would leave the box; end within {least} s")
