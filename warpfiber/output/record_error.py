"""RecordError: a result file that cannot be written or read back (exit code 4)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class RecordError(Exception):
    """A record or checkpoint is damaged, or the disk refused it; the message names the file."""


@contextmanager
def record_errors(path: str | Path, doing: str) -> Iterator[None]:
    """Turn what h5py and the file system raise inside the block into `RecordError`."""
    try:
        yield
    # h5py reports the same low-level fault as OSError, RuntimeError or KeyError.
    except (OSError, RuntimeError, KeyError) as fault:
        raise RecordError(f"{path}: cannot {doing}: {fault}") from fault
