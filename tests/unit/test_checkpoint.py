"""Checkpoints: bitwise round trip, atomic writing, keeping two, and damage that is noticed."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from warpfiber.output.checkpoint import (
    checkpoint_paths,
    latest_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from warpfiber.output.record_error import RecordError


def _arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {
        "node_pos": rng.normal(size=(40, 3)),
        "node_velocity": rng.normal(size=(40, 3)).astype(np.float32),
        "pairs": rng.integers(0, 40, size=(9, 2), dtype=np.int32),
        "active": rng.random(7) > 0.5,
        "history/tangential": np.zeros((0, 3)),
        "special": np.array([np.nan, np.inf, -0.0, 5e-324]),
        "count": np.array(3, dtype=np.uint64),
    }


def test_round_trip_is_bitwise(tmp_path: Path) -> None:
    arrays, rng = _arrays(), np.random.default_rng(1)
    attrs = {
        "time": 0.1 + 0.2,
        "random": rng.bit_generator.state,
        "scene": '{"title": "µ"}',
        "none": None,
        "offset": np.float64(1e-17),
        "list": [1, 2.5, "x"],
    }
    path = write_checkpoint(tmp_path, 12, arrays, attrs)
    assert path.name == "checkpoint_12.h5"
    read, read_attrs = read_checkpoint(path)
    assert set(read) == set(arrays)
    for name, values in arrays.items():
        assert read[name].dtype == values.dtype and read[name].shape == values.shape
        assert read[name].tobytes() == values.tobytes()
    assert read_attrs == attrs
    fresh = np.random.default_rng(0)
    fresh.bit_generator.state = read_attrs["random"]
    assert np.array_equal(fresh.random(5), rng.random(5))


def test_last_two_are_kept_in_order_of_steps(tmp_path: Path) -> None:
    assert latest_checkpoint(tmp_path) is None
    for step in (0, 5, 90, 100, 1000):
        write_checkpoint(tmp_path, step, {"x": np.arange(3)}, {})
    assert [path.name for path in checkpoint_paths(tmp_path)] == [
        "checkpoint_1000.h5",
        "checkpoint_100.h5",
    ]
    # A run resumed from 100 goes on differently: what was written later no longer belongs to it.
    write_checkpoint(tmp_path, 150, {"x": np.arange(3)}, {})
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["checkpoint_100.h5", "checkpoint_150.h5"]
    assert latest_checkpoint(tmp_path) == tmp_path / "checkpoint_150.h5"


def test_interrupted_write_leaves_the_old_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = write_checkpoint(tmp_path, 1, {"x": np.arange(3)}, {})

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", refuse)
    with pytest.raises(RecordError, match="No space left"):
        write_checkpoint(tmp_path, 2, {"x": np.arange(3)}, {})
    assert list(tmp_path.iterdir()) == [first]
    assert read_checkpoint(first)[0]["x"].tolist() == [0, 1, 2]


def test_writing_does_not_change_the_arrays(tmp_path: Path) -> None:
    arrays = _arrays()
    copies = {name: values.tobytes() for name, values in arrays.items()}
    write_checkpoint(tmp_path, 1, arrays, {})
    assert {name: values.tobytes() for name, values in arrays.items()} == copies


def test_damage_is_noticed(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="cannot read"):
        read_checkpoint(tmp_path / "checkpoint_1.h5")
    path = write_checkpoint(tmp_path, 1, {"x": np.linspace(0, 1, 5000)}, {"a": 1})
    whole = path.read_bytes()
    for size in (0, 100, len(whole) // 2):
        path.write_bytes(whole[:size])
        with pytest.raises(RecordError):
            read_checkpoint(path)
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        file["arrays/x"][4000] += 1e-9
    with pytest.raises(RecordError, match="'x' fails its checksum"):
        read_checkpoint(path)
    with h5py.File(path, "w") as file:
        file["other"] = 1
    with pytest.raises(RecordError):
        read_checkpoint(path)
