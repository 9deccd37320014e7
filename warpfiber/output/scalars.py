"""Scalars: one row of measured numbers per recorded step, in `scalars.csv`.

SI units, a header row of bare names, floats with all their digits (they read back bitwise). Every
row is flushed; a row that a killed run left unfinished is ignored by the reader and cut on resume.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.record_error import RecordError, record_errors


class ScalarsWriter:
    """Appends rows to a table whose columns are fixed by its header."""

    def __init__(self, path: str | Path, columns: Sequence[str]) -> None:
        """Start a new table; `columns` must begin with what identifies a row, usually step."""
        self.path, self.columns = Path(path), tuple(columns)
        if len(set(self.columns)) != len(self.columns):
            raise ValueError(f"a column is named twice: {', '.join(self.columns)}")
        with record_errors(self.path, "write"):
            self._file: TextIO = self.path.open("w", encoding="utf-8", newline="\n")
            self._write(",".join(self.columns))

    @classmethod
    def reopen(cls, path: str | Path, last_step: int) -> ScalarsWriter:
        """Continue a table after cutting unfinished rows and rows past `last_step`.

        Raises RecordError if the table cannot be read.
        """
        path = Path(path)
        lines, _ = _whole_lines(path)
        columns = lines[0].split(",")
        if "step" not in columns:
            raise RecordError(f"{path}: cannot resume: the table has no column 'step'")
        column = columns.index("step")
        kept = [row for row in lines[1:] if int(float(row.split(",")[column])) <= last_step]
        part = path.with_suffix(".csv.part")
        writer = cls.__new__(cls)
        writer.path, writer.columns = path, tuple(columns)
        with record_errors(path, "cut"):
            part.write_text("\n".join([lines[0], *kept]) + "\n", encoding="utf-8", newline="\n")
            os.replace(part, path)
            writer._file = path.open("a", encoding="utf-8", newline="\n")
        return writer

    def append(self, row: Mapping[str, float | int]) -> None:
        """Write one row; a column that `row` lacks is nan. Raises ValueError on an unknown name."""
        unknown = sorted(set(row) - set(self.columns))
        if unknown:
            raise ValueError(f"not a column of {self.path.name}: {', '.join(unknown)}")
        with record_errors(self.path, "write"):
            self._write(",".join(_text(row.get(name, math.nan)) for name in self.columns))

    def close(self) -> None:
        """Close the file; closing twice is allowed."""
        self._file.close()

    def _write(self, line: str) -> None:
        self._file.write(line + "\n")
        self._file.flush()


def read_scalars(path: str | Path) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
    """All finished rows, one array (rows,) per column; `step` is int64, the others float64."""
    lines, _ = _whole_lines(Path(path))
    columns = lines[0].split(",")
    rows = [line.split(",") for line in lines[1:]]
    try:
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
    except ValueError as fault:
        raise RecordError(f"{path}: cannot read: {fault}") from fault
    return {
        name: table[:, k].astype(np.int64) if name == "step" else table[:, k].copy()
        for k, name in enumerate(columns)
    }


def scalars_whole(path: str | Path) -> bool:
    """Whether the table ends with a finished row."""
    return not _whole_lines(Path(path))[1]


def _text(value: float | int) -> str:
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    return repr(float(value))


def _whole_lines(path: Path) -> tuple[list[str], bool]:
    """The header and all finished rows, and whether an unfinished one follows."""
    with record_errors(path, "read"):
        text = path.read_bytes().decode("utf-8", errors="replace")
    *lines, rest = text.split("\n")
    if not lines:
        raise RecordError(f"{path}: cannot read: no header row")
    width = len(lines[0].split(","))
    # A row may be torn in the middle too, where a resumed run of older days appended after it.
    whole = [lines[0], *(line for line in lines[1:] if len(line.split(",")) == width)]
    return whole, bool(rest) or len(whole) != len(lines)
