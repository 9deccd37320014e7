"""Saved stages: what a finished stage left, as the start of other scenes, `stage_<name>.h5`.

The file is that of a checkpoint. It may have been saved by a scene that kept no memories of
friction, no list or no meters; the new scene then begins those as it would without it.
Limits: run units follow from the fibers alone, so both scenes have the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.checkpoint import read_checkpoint, write_arrays
from warpfiber.output.record_error import RecordError
from warpfiber.placement import Placement
from warpfiber.scene import Fault, Scene, SceneError
from warpfiber.scene.starting import saved_stage_name

Arrays = Mapping[str, NDArray[Any]]
# of the neighbor list, along with all `contact_` arrays
LISTED = ("list_pos", "list_lattice", "wide_pos", "wide_lattice", "wide_deformation")


def write_saved_stage(folder: Path, name: str, arrays: Arrays, attrs: Mapping[str, Any]) -> Path:
    """Write, or write anew, the end of a stage; returns its path. Raises RecordError."""
    return write_arrays(folder / saved_stage_name(name), arrays, attrs)


def read_saved_stage(scene: Scene) -> tuple[dict[str, NDArray[Any]], Placement]:
    """Arrays that the scene's [start] names, and the fibers as they lie. Raises SceneError."""
    start = scene.start
    assert start is not None and start.stage is not None
    path = Path(start.from_) / saved_stage_name(start.stage)
    try:
        arrays, _ = read_checkpoint(path)
    except RecordError as fault:
        raise SceneError([Fault(scene.path, "start.stage", start.stage, str(fault))]) from fault
    group, first = arrays["fiber_group"], arrays["fiber_node_start"]
    counts = np.bincount(group, minlength=len(scene.fibers)).tolist()
    if counts != [row.count for row in scene.fibers]:
        remedy = f"{path} and scene.json are not of the same run; run that scene again"
        raise SceneError([Fault(scene.path, "start.from", start.from_, remedy)])
    nodes = arrays["node_pos"].astype(float) * float(arrays["length"])
    placed = {"start": str(path)}
    return arrays, Placement(nodes, first, group, placed)


def merged_arrays(saved: Arrays, fresh: Arrays) -> dict[str, NDArray[Any]]:
    """What a scene begins with: saved arrays, of what was not saved its own fresh ones."""
    listed = "contact_acts" in saved
    found: dict[str, NDArray[Any]] = {}
    for name, own in fresh.items():
        value = saved.get(name)
        if name.startswith("contact_") and listed:  # by listed pair: the list is the saved one
            pairs = len(saved["contact_acts"])
            value = np.zeros((pairs, *own.shape[1:]), own.dtype) if value is None else value
        elif value is None or value.shape != own.shape or (name in LISTED and not listed):
            value = own
        found[name] = value
    return found
