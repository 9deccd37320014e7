"""The stage in which fibers are poured into the box: where it stands and what it needs."""

from __future__ import annotations

import math

from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import number_text
from warpfiber.scene.scene import Scene

UP = 2  # the axis along which fibers fall
FOREIGN_ENDS = ("end_strain", "end_volume_fraction", "end_pressure")


def pours(scene: Scene) -> bool:
    """Whether fibers are poured."""
    return any(stage.kind == "pour" for stage in scene.stages)


def check_pouring(draft: Draft) -> None:
    """Run all rules; faults go to the draft's list."""
    if draft.method != "bonded_spheres":
        return
    fibers = sum(group["count"] or 0 for group in draft.fibers)
    for index, stage in enumerate(draft.stages):
        if stage["kind"] != "pour":
            continue
        path = f"stage.{index}"
        if index > 0 or draft.start is not None:
            remedy = "the fibers are in the box already; pour in the first stage, without [start]"
            draft.blame(f"{path}.kind", remedy)
            continue
        for key in FOREIGN_ENDS:
            if stage[key] is not None:
                remedy = 'does not end kind = "pour"; use end_speed or end_time'
                draft.blame(f"{path}.{key}", remedy)
        if stage["repeat_from"] is not None:
            draft.blame(f"{path}.repeat_from", "fibers are poured once; remove it")
        if draft.box is None:
            draft.blame(f"{path}.kind", "fibers are poured into a [box]; add one")
        elif any(axis == UP for axis, _ in draft.axes("periodic")):
            remedy = 'fibers fall through a periodic box; make z "wall" in box.boundary'
            draft.blame(f"{path}.kind", remedy)
        gravity = draft.gravity["acceleration"] if draft.gravity is not None else None
        if draft.gravity is None or (gravity is not None and gravity[UP] >= 0.0):
            remedy = "nothing makes the fibers fall; add [gravity] that points down along z"
            draft.blame(f"{path}.kind", remedy)
        batches = math.ceil(fibers / (stage["batch"] or 1))
        least = (batches - 1) * (stage["interval"] or 0.0)
        if stage["end_time"] is not None and stage["end_time"] <= least:
            remedy = (
                f"the last fibers are poured at {number_text(float(f'{least:.4g}'))} s; give more"
            )
            draft.blame(f"{path}.end_time", remedy)
