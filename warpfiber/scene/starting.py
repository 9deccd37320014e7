"""Scenes that start from a saved stage of another run: where it is found, and what it brings.

A run keeps the end of a stage with `save = true` as `stage_<name>.h5` in its folder. A scene with
[start] takes over fibers, box and walls as well as how fibers are cut and kept: segments,
precision, the shear of bonds. All else may change: contact, gravity, loads, stages, record, step,
device. Step and time go on from the saved ones.
"""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

from warpfiber.scene.draft import Draft
from warpfiber.scene.keys import Values
from warpfiber.scene.scene import Scene, scene_from_resolved

KEPT_NUMERICS = (
    "segments",
    "segment_length",
    "reduced_beads",
    "closure",
    "torque_weights",
    "precision",
    "bond_shear",
)
BROUGHT = ("fibers", "box", "wall")
SAVING = ("bonded_spheres",)
FILE_NAME = re.compile(r"[\w.-]+")


def saved_stage_name(stage: str) -> str:
    """Name of the file of a saved stage."""
    return f"stage_{stage}.h5"


def saved_stages(folder: Path) -> list[str]:
    """Names of all stages that a run folder keeps."""
    return sorted(path.stem.removeprefix("stage_") for path in folder.glob("stage_*.h5"))


def check_saving(draft: Draft) -> None:
    """A saved stage is found again by its name, which is that of a file."""
    names: set[str] = set()
    for index, stage in enumerate(draft.stages):
        name = stage["name"]
        if not stage["save"] or name is None:
            continue
        key = f"stage.{index}.name"
        if not FILE_NAME.fullmatch(name):
            draft.blame(key, "a saved stage is a file; use letters, digits, - and _")
        elif name in names:
            draft.faults.add(key, name, "another saved stage has this name; name one of them anew")
        names.add(name)


def take_start(draft: Draft) -> None:
    """Find the saved stage and bring in what it keeps; faults go to the draft's list."""
    start = draft.start
    if start is None or start["from"] is None:
        return
    if draft.method is not None and draft.method not in SAVING:
        draft.faults.add("start", None, f"not available in method {draft.method}; give [[fibers]]")
        return
    for name in BROUGHT:
        if draft.is_given(name):
            draft.faults.add(name, None, "given together with [start]; [start] brings it")
    folder = _folder(draft, start["from"])
    saved = None if folder is None else _saved_scene(draft, folder)
    if folder is None or saved is None:
        return
    start["from"] = str(folder.absolute())
    _choose_stage(draft, start, folder)
    draft.saved = saved
    draft.box = None if saved.box is None else dict(vars(saved.box))
    draft.walls = [dict(vars(wall)) for wall in saved.walls]
    draft.fibers = [vars(group) | {"shape": dict(vars(group.shape))} for group in saved.fibers]
    _keep_numerics(draft, saved)


def _folder(draft: Draft, name: str) -> Path | None:
    """The run folder, beside the scene or below the current folder."""
    places = list(dict.fromkeys((draft.folder / name, Path(name))))
    for folder in places:
        if folder.is_dir():
            return folder
    sought = " and ".join(str(folder) for folder in places)
    draft.blame("start.from", f"no such run folder; sought: {sought}")
    return None


def _saved_scene(draft: Draft, folder: Path) -> Scene | None:
    """The scene of the run; what node files said is in the saved stage."""
    file = folder / "scene.json"
    try:
        tables = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        draft.blame("start.from", "not the folder of a run: it has no scene.json")
        return None
    except (OSError, ValueError) as fault:
        draft.blame("start.from", f"its scene.json cannot be read: {fault}")
        return None
    scene = scene_from_resolved(tables)
    if scene.numerics.method != draft.method and draft.method is not None:
        method = scene.numerics.method
        draft.blame("numerics.method", f'the saved run has method "{method}"; use the same')
        return None
    groups = tuple(dataclasses.replace(group, node_file=None) for group in scene.fibers)
    return dataclasses.replace(scene, fibers=groups)


def _choose_stage(draft: Draft, start: Values, folder: Path) -> None:
    """The stage that is named, else the only one."""
    kept = saved_stages(folder)
    names = ", ".join(f'"{name}"' for name in kept)
    if not kept:
        remedy = "the run keeps no stage; run it with save = true in the stage, to its end"
        draft.blame("start.from", remedy)
    elif start["stage"] is None and len(kept) > 1:
        draft.faults.add("start.stage", None, f"missing; the run keeps {names}: name one")
    elif start["stage"] is None:
        start["stage"] = kept[0]
    elif start["stage"] not in kept:
        draft.blame("start.stage", f"the run keeps no such stage; it keeps {names}")


def _keep_numerics(draft: Draft, saved: Scene) -> None:
    """How fibers are cut and kept is that of the saved run."""
    for name in KEPT_NUMERICS:
        kept = getattr(saved.numerics, name)
        if draft.is_given(f"numerics.{name}") and draft.numerics[name] != kept:
            remedy = "given by [start]; remove it"
            if kept is not None:
                remedy = f"the saved stage has {kept}; remove it, or give the same"
            draft.blame(f"numerics.{name}", remedy)
        draft.numerics[name] = kept
