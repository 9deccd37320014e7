"""Stages that grip a bed below and above and move the upper grip: what they need, how they end.

Symbols: free height L_s = freeze_above - freeze_below; strain of the stage = speed time / L_s.
Limits: which fibers reach into a grip is found by the run alone.
"""

from __future__ import annotations

from warpfiber.scene.draft import Draft
from warpfiber.scene.keys import Values
from warpfiber.scene.scene import Scene, Stage

GRIPPING = ("pull", "shear")
HEIGHT = 2  # the axis along which a bed is gripped below and above
FOREIGN_ENDS = ("end_speed", "end_volume_fraction", "end_pressure")


def drawn_axis(stage: Stage) -> int:
    """Axis along which the upper grip moves."""
    return HEIGHT if stage.kind == "pull" else 0


def free_height(stage: Stage) -> float:
    """L_s, m."""
    return (stage.freeze_above or 0.0) - (stage.freeze_below or 0.0)


def grips(scene: Scene) -> bool:
    """Whether some stage grips the bed."""
    return any(stage.kind in GRIPPING for stage in scene.stages)


def strain_time(stage: Values) -> float | None:
    """Seconds to the stage's `end_strain`; None where it has none."""
    names = ("end_strain", "speed", "freeze_below", "freeze_above")
    strain, speed, below, above = (stage[name] for name in names)
    if stage["kind"] not in GRIPPING or not strain or not speed or below is None or above is None:
        return None
    return float(strain * (above - below) / speed) if above > below else None


def check_gripping(draft: Draft) -> None:
    """Run all rules; faults go to the draft's list."""
    for index, stage in enumerate(draft.stages):
        if stage["kind"] not in GRIPPING or draft.method != "bonded_spheres":
            continue
        path = f"stage.{index}"
        for key in FOREIGN_ENDS:
            if stage[key] is not None:
                remedy = f'does not end kind = "{stage["kind"]}"; use end_strain or end_time'
                draft.blame(f"{path}.{key}", remedy)
        below, above = stage["freeze_below"], stage["freeze_above"]
        if below is not None and above is not None and above <= below:
            remedy = "leaves no free height; give more than freeze_below"
            draft.blame(f"{path}.freeze_above", remedy)
        if draft.box is None and draft.start is None:
            remedy = "a stress needs the area of a [box]; add one"
            draft.blame(f"{path}.kind", remedy)
        elif any(axis == HEIGHT for axis, _ in draft.axes("periodic")):
            remedy = 'the bed has a bottom and a top; make z "wall" or "open" in box.boundary'
            draft.blame(f"{path}.kind", remedy)
