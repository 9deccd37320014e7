"""Checkpoints: the whole state of a run in solver precision, `checkpoint_<step>.h5`.

Every array is one dataset with its own dtype and a CRC-32; the attributes are one JSON text (exact
for floats and for the large integers of a random generator's state). A file appears under its name
only when it is complete: temporary name, flush, close, fsync, rename. The last two are kept, so a
damaged one still leaves an older one to resume from.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.record_error import RecordError, record_errors

KEPT_COUNT = 2
_NAME = re.compile(r"checkpoint_(\d+)\.h5")


def write_checkpoint(
    folder: str | Path, step: int, arrays: Mapping[str, NDArray[Any]], attrs: Mapping[str, Any]
) -> Path:
    """Write `checkpoint_<step>.h5` and drop all but it and the one before; returns its path.

    Raises RecordError if the disk refuses it; the earlier checkpoints are then untouched.
    """
    path = Path(folder) / f"checkpoint_{int(step)}.h5"
    write_arrays(path, arrays, attrs)
    with record_errors(path, "write"):
        # Later steps are left from a run that went on from here before: they no longer match the
        # record, and the latest checkpoint must be the one just written.
        stale = [other for other in checkpoint_paths(folder) if _step(other) > step]
        older = [other for other in checkpoint_paths(folder) if _step(other) < step]
        for other in stale + older[KEPT_COUNT - 1 :]:
            other.unlink(missing_ok=True)
    return path


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], attrs: Mapping[str, Any]) -> Path:
    """Write one such file, whole or not at all; returns its path. Raises RecordError."""
    import h5py

    part = path.with_name(f".{path.name}.part")
    text = json.dumps(dict(attrs), default=_plain)
    with record_errors(path, "write"):
        try:
            with h5py.File(part, "w") as file:
                file.attrs["attrs"] = text
                for name, values in arrays.items():
                    data = np.asarray(values)
                    dataset = file.create_dataset(f"arrays/{name}", data=data)
                    dataset.attrs["crc32"] = _checksum(data)
                file.flush()
            _sync(part)
            os.replace(part, path)
            _sync(path.parent)
        finally:
            part.unlink(missing_ok=True)
    return path


def read_checkpoint(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays and attributes of a checkpoint; raises RecordError if missing or damaged."""
    import h5py

    arrays: dict[str, NDArray[Any]] = {}
    with record_errors(path, "read"), h5py.File(path, "r", locking=False) as file:
        try:
            attrs: dict[str, Any] = json.loads(file.attrs["attrs"])
        except ValueError as fault:
            raise RecordError(f"{path}: damaged: its attributes are no JSON") from fault

        def read(name: str, entry: Any) -> None:
            if isinstance(entry, h5py.Dataset):
                arrays[name] = entry[()]
                if _checksum(arrays[name]) != int(entry.attrs["crc32"]):
                    raise RecordError(f"{path}: damaged: array '{name}' fails its checksum")

        if "arrays" in file:
            file["arrays"].visititems(read)
    return arrays, attrs


def checkpoint_paths(folder: str | Path) -> list[Path]:
    """All checkpoints of a folder, newest step first."""
    found = [path for path in Path(folder).glob("checkpoint_*.h5") if _NAME.fullmatch(path.name)]
    return sorted(found, key=_step, reverse=True)


def latest_checkpoint(folder: str | Path) -> Path | None:
    """The checkpoint of the largest step, or None."""
    return next(iter(checkpoint_paths(folder)), None)


def _step(path: Path) -> int:
    return int(path.stem.removeprefix("checkpoint_"))


def _checksum(data: NDArray[Any]) -> int:
    return zlib.crc32(np.ascontiguousarray(data).tobytes())


def _sync(path: Path) -> None:
    """Wait until the disk holds the file, or the folder's list of names."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a checkpoint attribute cannot be a {type(value).__name__}")
