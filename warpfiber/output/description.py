"""Description of a result folder in words, for `warpfiber info`: content, extent, whether whole."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from warpfiber.output.checkpoint import checkpoint_paths, read_checkpoint
from warpfiber.output.record_error import RecordError
from warpfiber.output.scalars import read_scalars, scalars_whole
from warpfiber.output.trajectory import TrajectoryReader


def describe(folder: Any) -> str:
    """What a result folder (path, its `run.vtkhdf`, or a ResultFolder) holds, one line per part."""
    path = Path(getattr(folder, "path", folder))
    path = path.parent if path.is_file() else path
    lines = [f"{path}"]
    faults: list[str] = []
    for title, part in (
        ("scene", _scene_lines),
        ("trajectory", _trajectory_lines),
        ("scalars", _scalars_lines),
        ("checkpoints", _checkpoint_lines),
        ("summary", _summary_lines),
        ("files", _file_lines),
    ):
        try:
            words, fault = part(path)
        except RecordError as error:
            words, fault = "damaged", str(error)
        lines.append(f"  {title:<12}{words}")
        faults += [fault] if fault else []
    lines.append(f"  {'whole':<12}{'no' if faults else 'yes'}")
    return "\n".join(lines + [f"    {fault}" for fault in faults])


def _json(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as fault:
        raise RecordError(f"{path}: cannot read: {fault}") from fault
    return content


def _scene_lines(folder: Path) -> tuple[str, str]:
    path = folder / "scene.json"
    if not path.exists():
        return "none", ""
    scene = _json(path)
    numerics, flow = scene.get("numerics") or {}, scene.get("flow") or {}
    words = [str(scene.get("title") or scene.get("path") or "untitled")]
    words += [str(word) for word in (flow.get("kind"), numerics.get("method")) if word]
    return ", ".join(words), ""


def _trajectory_lines(folder: Path) -> tuple[str, str]:
    path = folder / "run.vtkhdf"
    if not path.exists():
        return "none", ""
    with TrajectoryReader(path) as reader:
        words = f"{reader.fiber_count} fibers, {reader.node_count} nodes, "
        words += f"{reader.frame_count} frames"
        if reader.frame_count:
            words += f", last: step {reader.step[-1]}, time {reader.time[-1]:.6g} s"
            words += f", strain {reader.strain[-1]:.6g}"
        words += f" ({path.stat().st_size / 1e6:.1f} MB)"
        return words, "" if reader.whole else f"{path}: the last frame is unfinished, left out"


def _scalars_lines(folder: Path) -> tuple[str, str]:
    path = folder / "scalars.csv"
    if not path.exists():
        return "none", ""
    table = read_scalars(path)
    count = len(next(iter(table.values())))
    words = f"{count} rows of {len(table)} columns"
    for name in ("step", "strain"):
        if count and name in table:
            words += f", last {name} {table[name][-1]:.6g}"
    return words, "" if scalars_whole(path) else f"{path}: an unfinished row, left out"


def _checkpoint_lines(folder: Path) -> tuple[str, str]:
    paths = checkpoint_paths(folder)
    faults = []
    for path in paths:
        try:
            read_checkpoint(path)
        except RecordError as error:
            faults.append(str(error))
    return ", ".join(path.name for path in paths) or "none", "; ".join(faults)


def _summary_lines(folder: Path) -> tuple[str, str]:
    path = folder / "summary.json"
    if not path.exists():
        return "none (the run did not finish)", ""
    shown = [
        f"{key} {value:.6g}" if isinstance(value, float) else f"{key} {value}"
        for key, value in _json(path).items()
        if isinstance(value, (str, int, float)) and len(str(value)) < 60
    ]
    return ", ".join(shown) or "empty", ""


def _file_lines(folder: Path) -> tuple[str, str]:
    found = sorted(
        str(path.relative_to(folder))
        for name in ("figures", "usd")
        for path in (folder / name).glob("*")
        if path.suffix in (".png", ".usdc", ".usda", ".usd")
    )
    return ", ".join(found) or "no figures, no usd", ""
