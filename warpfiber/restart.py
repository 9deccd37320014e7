"""What a stopped run continues from: its latest whole checkpoint, and the scene kept in it."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpfiber.output.checkpoint import checkpoint_paths, read_checkpoint
from warpfiber.output.folder import RecordError, ResultFolder
from warpfiber.placement import Placement
from warpfiber.scene import FiberGroup, Scene, scene_from_dict


@dataclass(frozen=True)
class Restart:
    """A checkpoint that has been read: arrays in run units, attributes, and its scene."""

    path: Path
    arrays: dict[str, np.ndarray]
    attrs: dict[str, Any]
    scene: Scene  # node files are not named: the checkpoint holds what was read from them
    fibers: tuple[FiberGroup, ...]  # the groups as the run recorded them
    placement: Placement  # the layout; positions are overwritten by the restored state


def read_restart(folder: ResultFolder) -> Restart:
    """The latest checkpoint of a folder that is whole; raises RecordError, naming all damage."""
    faults: list[str] = []
    for path in checkpoint_paths(folder.path):
        try:
            arrays, attrs = read_checkpoint(path)
        except RecordError as fault:
            faults.append(str(fault))
            folder.log(f"passed over: {fault}")
            continue
        return _restart(path, arrays, attrs)
    found = "; ".join(faults) or "there is none; start again with `warpfiber run ... --overwrite`"
    raise RecordError(f"{folder.path}: no checkpoint to resume from: {found}")


def _restart(path: Path, arrays: dict[str, np.ndarray], attrs: dict[str, Any]) -> Restart:
    content = json.loads(attrs["scene"])
    files = [group.get("node_file") for group in content["fibers"]]
    for group in content["fibers"]:
        group["node_file"] = None
    scene = scene_from_dict(content)
    pairs = zip(scene.fibers, files, strict=True)
    fibers = tuple(dataclasses.replace(group, node_file=file) for group, file in pairs)
    placement = Placement(
        node_pos=arrays["node_pos"].astype(float) * float(arrays["length"]),
        fiber_node_start=arrays["fiber_node_start"],
        fiber_group=arrays["fiber_group"],
        report={},
        starts_bent=bool(arrays["starts_bent"][0]) if "starts_bent" in arrays else None,
    )
    return Restart(path, arrays, attrs, scene, fibers, placement)
