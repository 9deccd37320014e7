"""ResultFolder: the folder of one run and its small text files.

It holds `scene.json`, `log.txt`, `scalars.csv`, `layers.csv`, `columns.csv` (what the columns of
both are), `placement.csv`, `summary.json`, `run.vtkhdf`, `checkpoint_<step>.h5`, `figures/` and
`usd/`. A run never overwrites a folder unless it is told to, and even then it removes only what a
run writes.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from warpfiber.output.description import describe
from warpfiber.output.record_error import RecordError
from warpfiber.scene import Fault, SceneError
from warpfiber.scene.starting import saved_stage_name, saved_stages

__all__ = ["RecordError", "ResultFolder", "describe"]

_FILES = (
    "scene.json",
    "log.txt",
    "scalars.csv",
    "layers.csv",
    "columns.csv",
    "placement.csv",
    "summary.json",
    "run.vtkhdf",
    "diverged.npz",
)
_FOLDERS = ("figures", "usd")


class ResultFolder:
    """One result folder on disk; make it with `create` or `open`."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._started = time.monotonic()

    @classmethod
    def create(
        cls, path: str | Path | None, scene_name: str, overwrite: bool = False
    ) -> ResultFolder:
        """Make a new folder: `path`, or `results/<scene name>` with _2, _3 ... where that exists.

        Raises SceneError (key --out) if `path` exists and `overwrite` is false, or if refused.
        """
        cls.check(path, overwrite)
        name = Path(scene_name).name.removesuffix(".toml") or "run"
        chosen = Path("results") / name if path is None else Path(path)
        try:
            if path is None:
                return cls(_make_numbered(chosen))
            if chosen.is_dir() and overwrite:
                _remove_results(chosen)
            chosen.mkdir(parents=True, exist_ok=overwrite)
            if not os.access(chosen, os.W_OK | os.X_OK):
                raise PermissionError(f"no permission to write in {chosen}")
        except FileExistsError:
            remedy = "this is a file; name another folder"
            if chosen.is_dir():
                remedy = "the folder exists; name another one or add --overwrite"
            raise SceneError([Fault("command line", "--out", str(chosen), remedy)]) from None
        except OSError as fault:
            remedy = f"the folder cannot be made ({fault.strerror or fault}); name another one"
            raise SceneError([Fault("command line", "--out", str(chosen), remedy)]) from fault
        return cls(chosen)

    @classmethod
    def check(cls, path: str | Path | None, overwrite: bool = False) -> None:
        """Raise what `create` would raise of an existing or unwritable folder; writes nothing."""
        chosen = Path("results") if path is None else Path(path)
        remedy = ""
        if path is not None and chosen.exists() and not (overwrite and chosen.is_dir()):
            remedy = "this is a file; name another folder"
            if chosen.is_dir():
                remedy = "the folder exists; name another one or add --overwrite"
        near = chosen
        while not near.exists() and near != near.parent:
            near = near.parent
        if not remedy and not (near.is_dir() and os.access(near, os.W_OK | os.X_OK)):
            remedy = f"no permission to write in {near}; name another folder"
        if remedy:
            raise SceneError([Fault("command line", "--out", str(chosen), remedy)])

    @classmethod
    def open(cls, path: str | Path) -> ResultFolder:
        """Open a folder, given itself or its `run.vtkhdf`; raises SceneError if it is missing."""
        given = Path(path)
        folder = given.parent if given.is_file() else given
        if not folder.is_dir() or not any((folder / name).exists() for name in _FILES):
            remedy = "no result folder there; name the folder of a run or its run.vtkhdf"
            raise SceneError([Fault("command line", "RESULT", str(path), remedy)])
        return cls(folder)

    @property
    def trajectory_path(self) -> Path:
        """The record of positions, `run.vtkhdf`."""
        return self.path / "run.vtkhdf"

    @property
    def scalars_path(self) -> Path:
        """The table of measured numbers, `scalars.csv`."""
        return self.path / "scalars.csv"

    @property
    def layers_path(self) -> Path:
        """What the layers of the box held at every frame, `layers.csv`."""
        return self.path / "layers.csv"

    def write_scene(self, scene: Mapping[str, Any]) -> None:
        """Write the resolved scene as `scene.json`."""
        _write_json(self.path / "scene.json", scene)

    def read_scene(self) -> dict[str, Any]:
        """The resolved scene; empty if there is none. Raises RecordError if damaged."""
        return _read_json(self.path / "scene.json")

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write `summary.json`; NaN and infinity become null, which JSON has no other word for."""
        _write_json(self.path / "summary.json", summary)

    def read_summary(self) -> dict[str, Any]:
        """The summary; empty if there is none. Raises RecordError if damaged."""
        return _read_json(self.path / "summary.json")

    def write_fit(self, name: str, content: Mapping[str, Any]) -> Path:
        """Write the constants of a fit as `<name>.json`; returns its path."""
        _write_json(self.path / f"{name}.json", content)
        return self.path / f"{name}.json"

    def log(self, line: str) -> None:
        """Append one line to `log.txt`, after the wall time since this folder was opened."""
        elapsed = time.monotonic() - self._started
        with (self.path / "log.txt").open("a", encoding="utf-8") as file:
            file.write(f"[{elapsed:10.2f} s] {line}\n")


def _make_numbered(wanted: Path) -> Path:
    """Make `wanted`, or the first of wanted_2, wanted_3 ... that does not exist yet."""
    wanted.parent.mkdir(parents=True, exist_ok=True)
    number, path = 1, wanted
    while True:
        try:
            # mkdir is the test: two runs started together cannot both get the same name.
            path.mkdir()
            return path
        except FileExistsError:
            number += 1
            path = wanted.with_name(f"{wanted.name}_{number}")


def _written(folder: Path) -> list[Path]:
    """Files that a run, or a fit of it, may have written."""
    found = [folder / name for name in _FILES]
    return [*found, *folder.glob("checkpoint_*.h5"), *folder.glob("fit_*.json")]


def _remove_results(folder: Path) -> None:
    """Delete what a run writes, and nothing else that lies in the folder."""
    for path in _written(folder):
        path.unlink(missing_ok=True)
    for name in saved_stages(folder):
        (folder / saved_stage_name(name)).unlink()
    for name in _FOLDERS:
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)


def _plain(value: Any) -> Any:
    """`value` as JSON knows it: NumPy scalars and arrays become numbers and lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    part = path.with_suffix(".json.part")
    text = json.dumps(_plain(content), indent=2, ensure_ascii=False, allow_nan=False)
    part.write_text(text + "\n", encoding="utf-8")
    os.replace(part, path)


def _read_json(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as fault:
        raise RecordError(f"{path}: cannot read: {fault}") from fault
    return content
