"""Scalars: exact round trip, torn rows, resume."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warpfiber.output.record_error import RecordError
from warpfiber.output.scalars import ScalarsWriter, read_scalars, scalars_whole

COLUMNS = ["step", "time", "strain", "a11"]


def _write(path: Path, steps: int) -> np.ndarray:
    values = np.random.default_rng(3).normal(size=(steps, 3)) * 10.0 ** np.arange(-9, 9, 6)
    writer = ScalarsWriter(path, COLUMNS)
    for step, row in enumerate(values):
        writer.append({"step": step, "time": row[0], "strain": row[1], "a11": row[2]})
    writer.close()
    return values


def test_floats_read_back_bitwise(tmp_path: Path) -> None:
    values = _write(tmp_path / "s.csv", 50)
    table = read_scalars(tmp_path / "s.csv")
    assert list(table) == COLUMNS
    assert table["step"].dtype == np.int64
    read = np.stack([table[name] for name in COLUMNS[1:]], axis=1)
    assert np.array_equal(read, values)


def test_missing_values_are_nan_and_unknown_names_are_errors(tmp_path: Path) -> None:
    writer = ScalarsWriter(tmp_path / "s.csv", COLUMNS)
    writer.append({"step": np.int64(7), "a11": np.float32(0.5)})
    with pytest.raises(ValueError, match="a12"):
        writer.append({"step": 8, "a12": 1.0})
    with pytest.raises(ValueError, match="twice"):
        ScalarsWriter(tmp_path / "t.csv", ["step", "step"])
    table = read_scalars(tmp_path / "s.csv")
    assert table["step"].tolist() == [7] and np.isnan(table["time"][0])


def test_empty_table(tmp_path: Path) -> None:
    ScalarsWriter(tmp_path / "s.csv", COLUMNS).close()
    assert all(len(column) == 0 for column in read_scalars(tmp_path / "s.csv").values())


@pytest.mark.parametrize("torn", ["12,0.25", "12,0.25,0.5,0.", "1"])
def test_unfinished_row_is_ignored_and_cut_on_resume(tmp_path: Path, torn: str) -> None:
    path = tmp_path / "s.csv"
    values = _write(path, 12)
    with path.open("a") as file:
        file.write(torn)
    assert not scalars_whole(path)
    assert read_scalars(path)["step"].tolist() == list(range(12))
    writer = ScalarsWriter.reopen(path, last_step=8)
    assert writer.columns == tuple(COLUMNS)
    writer.append({"step": 9, "time": 1.5})
    writer.close()
    table = read_scalars(path)
    assert scalars_whole(path)
    assert table["step"].tolist() == list(range(10))
    assert np.array_equal(table["a11"][:9], values[:9, 2])


def test_resume_equals_uninterrupted(tmp_path: Path) -> None:
    _write(tmp_path / "a.csv", 20)
    _write(tmp_path / "b.csv", 20)
    rows = read_scalars(tmp_path / "b.csv")
    writer = ScalarsWriter.reopen(tmp_path / "b.csv", last_step=11)
    for k in range(12, 20):
        writer.append({name: rows[name][k] for name in COLUMNS})
    writer.close()
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_damaged_tables_are_record_errors(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    with pytest.raises(RecordError):
        read_scalars(path)
    path.write_text("")
    with pytest.raises(RecordError, match="no header"):
        read_scalars(path)
    path.write_text("step,a11\n1,word\n")
    with pytest.raises(RecordError):
        read_scalars(path)
    path.write_text("time,a11\n1,2\n")
    with pytest.raises(RecordError, match="step"):
        ScalarsWriter.reopen(path, 3)
