"""Trajectory: the VTKHDF layout, crash safety, cutting on resume, reading by VTK."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from warpfiber.output.record_error import RecordError
from warpfiber.output.trajectory import TrajectoryReader, TrajectoryWriter, fiber_axes

START = np.array([0, 3, 8, 10])
GROUP = np.array([0, 1, 1])
SCENE = {"title": "three fibers", "box": {"size": [1.0, 1.0, 1.0]}}


def _frame(k: int) -> dict[str, object]:
    rng = np.random.default_rng(100 + k)
    lattice = np.diag([1.0, 2.0, 3.0])
    lattice[0, 2] = 0.1 * k
    return {
        "step": 10 * k,
        "time": 0.25 * k,
        "strain": 0.5 * k,
        "node_pos": rng.normal(size=(10, 3)),
        "lattice": lattice,
        "node_fields": {"node_velocity": rng.normal(size=(10, 3))},
        "values": {"orientation_tensor": rng.normal(size=(3, 3)), "contact_count": k},
    }


def _writer(path: Path) -> TrajectoryWriter:
    return TrajectoryWriter(
        path,
        fiber_node_start=START,
        fiber_group=GROUP,
        scene_json=json.dumps(SCENE),
        attrs={"version": "0.1.0", "hash": "ab12", "seed": 7, "device": None},
        node_fields=["node_velocity"],
    )


def _write(path: Path, frames: int) -> None:
    writer = _writer(path)
    for k in range(frames):
        writer.append(**_frame(k))  # type: ignore[arg-type]
    writer.close()


def _content(path: Path) -> dict[str, object]:
    found: dict[str, object] = {}

    def visit(name: str, entry: object) -> None:
        if isinstance(entry, h5py.Dataset):
            found[name] = (entry.dtype.str, entry.shape, entry[()].tobytes())

    with h5py.File(path, "r") as file:
        file.visititems(visit)
        found["NSteps"] = int(file["VTKHDF/Steps"].attrs["NSteps"])
    return found


def test_layout_is_vtkhdf_temporal_polydata(tmp_path: Path) -> None:
    path = tmp_path / "run.vtkhdf"
    _write(path, 4)
    with h5py.File(path, "r") as file:
        root, steps = file["VTKHDF"], file["VTKHDF/Steps"]
        assert root.attrs["Version"].tolist() == [2, 3]
        kind = root.attrs.get_id("Type").get_type()
        assert root.attrs["Type"] == b"PolyData" and kind.get_size() == 8
        assert not kind.is_variable_str() and kind.get_cset() == h5py.h5t.CSET_ASCII
        assert root["Points"].shape == (40, 3) and root["Points"].dtype == np.float32
        assert root["Points"].chunks == (10, 3) and root["Points"].maxshape == (None, 3)
        assert root["NumberOfPoints"][()].tolist() == [10]
        assert root["Lines/NumberOfCells"][()].tolist() == [3]
        assert root["Lines/NumberOfConnectivityIds"][()].tolist() == [10]
        assert root["Lines/Offsets"][()].tolist() == START.tolist()
        assert root["Lines/Connectivity"][()].tolist() == list(range(10))
        for name in ("Vertices", "Polygons", "Strips"):
            assert root[f"{name}/Offsets"][()].tolist() == [0]
            assert root[f"{name}/NumberOfCells"][()].tolist() == [0]
            assert root[f"{name}/NumberOfConnectivityIds"][()].tolist() == [0]
            assert root[f"{name}/Connectivity"].shape == (0,)
        assert list(root["FieldData"]) == []
        assert root["CellData/fiber_group"][()].tolist() == [0, 1, 1]
        assert root["CellData/fiber_group"].dtype == np.int32
        assert root["CellData/fiber_axis"].shape == (12, 3)
        assert int(steps.attrs["NSteps"]) == 4 and steps.attrs["NSteps"].dtype == np.int64
        assert steps["Values"][()].tolist() == [0.0, 0.25, 0.5, 0.75]
        assert steps["PartOffsets"][()].tolist() == [0] * 4
        assert steps["NumberOfParts"][()].tolist() == [1] * 4
        assert steps["CellOffsets"].shape == steps["ConnectivityIdOffsets"].shape == (4, 4)
        assert not steps["CellOffsets"][()].any()
        assert steps["PointOffsets"][()].tolist() == [0, 10, 20, 30]
        assert steps["PointDataOffsets/node_velocity"][()].tolist() == [0, 10, 20, 30]
        assert steps["CellDataOffsets/fiber_axis"][()].tolist() == [0, 3, 6, 9]
        assert steps["CellDataOffsets/fiber_group"][()].tolist() == [0] * 4
        assert "device" not in file["warpfiber"].attrs
        assert set(file["warpfiber"]) == {
            "step", "strain", "box", "shear_offset", "orientation_tensor", "contact_count",
        }  # fmt: skip
    # The oldest layout (superblock 0): the only one that opens after a kill.
    assert path.read_bytes()[8] == 0


def test_frames_read_back(tmp_path: Path) -> None:
    path = tmp_path / "run.vtkhdf"
    _write(path, 3)
    with TrajectoryReader(path) as reader:
        assert reader.frame_count == 3 and reader.whole
        assert reader.step.tolist() == [0, 10, 20] and reader.strain.tolist() == [0, 0.5, 1]
        assert reader.fiber_node_start.tolist() == START.tolist()
        assert reader.fiber_group.tolist() == GROUP.tolist()
        assert reader.scene == SCENE
        assert reader.attrs == {"version": "0.1.0", "hash": "ab12", "seed": 7}
        for k in (0, 1, 2, -1):
            frame = _frame(k % 3)
            points = np.asarray(frame["node_pos"])
            assert np.array_equal(reader.node_pos(k), points.astype(np.float32))
            velocity = frame["node_fields"]["node_velocity"]  # type: ignore[index]
            assert np.array_equal(
                reader.node_field("node_velocity", k), velocity.astype(np.float32)
            )
            assert np.array_equal(reader.lattice(k), frame["lattice"])  # type: ignore[arg-type]
            ends = points[[2, 7, 9]] - points[[0, 3, 8]]
            axis = ends / np.linalg.norm(ends, axis=1, keepdims=True)
            assert np.allclose(reader.fiber_axis(k), axis, atol=1e-7)
        assert reader.values("contact_count").tolist() == [0, 1, 2]
        assert np.allclose(reader.values("shear_offset"), [0.0, 0.1, 0.2])
        with pytest.raises(IndexError):
            reader.node_pos(3)


def test_no_box_no_frames_and_long_scene(tmp_path: Path) -> None:
    path = tmp_path / "run.vtkhdf"
    long = {"notes": "x" * 200_000}  # more than HDF5 allows inside an attribute's own header
    writer = TrajectoryWriter(
        path, fiber_node_start=[0, 2], fiber_group=[0], scene_json=json.dumps(long), attrs={}
    )
    writer.close()
    with TrajectoryReader(path) as reader:
        assert reader.frame_count == 0 and len(reader.step) == 0 and reader.scene == long
    writer = TrajectoryWriter.reopen(path, 0)
    writer.append(0, 0.0, 0.0, np.zeros((2, 3)))
    writer.close()
    writer.close()
    with TrajectoryReader(path) as reader:
        assert reader.lattice(0) is None
        assert reader.fiber_axis(0).tolist() == [[0, 0, 0]]


def test_wrong_input_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "run.vtkhdf"
    writer = _writer(path)
    writer.append(**_frame(0))  # type: ignore[arg-type]
    for change in (
        {"node_pos": np.zeros((9, 3))},
        {"node_fields": {}},
        {"values": {"contact_count": 1}},
        {"lattice": None},
    ):
        with pytest.raises(ValueError):
            writer.append(**(_frame(1) | change))  # type: ignore[arg-type]
    writer.append(**_frame(1))  # type: ignore[arg-type]
    writer.close()
    _write(tmp_path / "other.vtkhdf", 2)
    assert _content(path) == _content(tmp_path / "other.vtkhdf")
    with pytest.raises(ValueError, match="fiber_node_start"):
        TrajectoryWriter(
            path, fiber_node_start=[0, 2], fiber_group=[0, 0], scene_json="{}", attrs={}
        )


def test_rings_name_their_first_node_again(tmp_path: Path) -> None:
    """As cells only: nodes, frames and a record that is reopened count every node once."""
    path = tmp_path / "run.vtkhdf"
    writer = TrajectoryWriter(
        path,
        fiber_node_start=START,
        fiber_group=GROUP,
        scene_json="{}",
        attrs={},
        closed_groups=[True, False],
    )
    points = np.random.default_rng(1).normal(size=(10, 3)).astype(np.float32)
    writer.append(0, 0.0, 0.0, points)
    writer.close()
    with h5py.File(path, "r") as file:
        lines = file["VTKHDF/Lines"]
        assert lines["Offsets"][()].tolist() == [0, 4, 9, 11]
        assert lines["Connectivity"][()].tolist() == [0, 1, 2, 0, 3, 4, 5, 6, 7, 8, 9]
        assert lines["NumberOfConnectivityIds"][()].tolist() == [11]
        assert file["VTKHDF/Points"].shape == (10, 3)
    writer = TrajectoryWriter.reopen(path, 0)
    assert writer.fiber_node_start.tolist() == START.tolist()
    writer.append(1, 1.0, 1.0, points + 1.0)
    writer.close()
    with TrajectoryReader(path) as reader:
        assert reader.frame_count == 2 and reader.whole
        assert reader.fiber_node_start.tolist() == START.tolist()
        assert reader.fiber_closed.tolist() == [True, False, False]
        assert np.array_equal(reader.node_pos(1), points + 1.0)


@pytest.mark.parametrize("last_step, left", [(25, 3), (20, 3), (0, 1), (-1, 0), (999, 6)])
def test_resume_equals_uninterrupted(tmp_path: Path, last_step: int, left: int) -> None:
    _write(tmp_path / "a.vtkhdf", 6)
    _write(tmp_path / "b.vtkhdf", 6)
    writer = TrajectoryWriter.reopen(tmp_path / "b.vtkhdf", last_step)
    assert writer.frame_count == left
    for k in range(left, 6):
        writer.append(**_frame(k))  # type: ignore[arg-type]
    writer.close()
    assert _content(tmp_path / "a.vtkhdf") == _content(tmp_path / "b.vtkhdf")


@pytest.mark.parametrize("torn", ["VTKHDF/Steps/Values", "warpfiber/box", "VTKHDF/Points"])
def test_torn_frame_is_left_out_and_cut(tmp_path: Path, torn: str) -> None:
    path = tmp_path / "run.vtkhdf"
    _write(path, 4)
    with h5py.File(path, "r+") as file:
        file[torn].resize(file[torn].shape[0] - 1, axis=0)
    with TrajectoryReader(path) as reader:
        assert reader.frame_count == 3 and not reader.whole
    TrajectoryWriter.reopen(path, 10_000).close()
    with TrajectoryReader(path) as reader:
        assert reader.frame_count == 3 and reader.whole


def test_damaged_files_are_record_errors(tmp_path: Path) -> None:
    path = tmp_path / "run.vtkhdf"
    for content in (None, b"", b"not HDF5 at all"):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(RecordError, match="run.vtkhdf"):
            TrajectoryReader(path)
        with pytest.raises(RecordError, match="run.vtkhdf"):
            TrajectoryWriter.reopen(path, 1)
    with h5py.File(path, "w") as file:
        file["x"] = 1
    with pytest.raises(RecordError):
        TrajectoryReader(path)


def test_fiber_axes_of_float32_scale() -> None:
    points = np.array([[0, 0, 0], [3e-6, 0, 4e-6]]) + 1e-2
    assert np.allclose(fiber_axes(points, [0, 2]), [[0.6, 0, 0.8]], atol=1e-9)


_KILLED = """
import sys
import numpy as np
from warpfiber.output.trajectory import TrajectoryWriter
count = 3000
writer = TrajectoryWriter(sys.argv[1], fiber_node_start=np.arange(0, count + 1, 10),
    fiber_group=np.zeros(count // 10), scene_json="{}", attrs={}, node_fields=["node_velocity"])
k = 0
while True:
    points = np.full((count, 3), float(k))
    writer.append(k, k, k, points, np.eye(3), {"node_velocity": points}, {"contact_count": k})
    print(k, flush=True)
    k += 1
"""


def test_killed_writer_leaves_a_whole_record(tmp_path: Path) -> None:
    rng = np.random.default_rng(int.from_bytes(os.urandom(4), "little"))
    for attempt in range(4):
        path = tmp_path / f"run{attempt}.vtkhdf"
        command = [sys.executable, "-c", _KILLED, str(path)]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        for _ in range(5):
            assert child.stdout.readline()
        time.sleep(rng.uniform(0.0, 0.08))
        child.send_signal(signal.SIGKILL)
        told = [int(line) for line in child.stdout.read().split()]
        child.wait()
        child.stdout.close()
        last = max(told, default=4)
        with TrajectoryReader(path) as reader:
            # Every frame whose append returned is there; one more may be.
            assert reader.frame_count in (last + 1, last + 2)
            for k in range(reader.frame_count):
                assert np.all(reader.node_pos(k) == k)
                assert np.all(reader.node_field("node_velocity", k) == k)
            assert reader.values("contact_count").tolist() == list(range(reader.frame_count))
        writer = TrajectoryWriter.reopen(path, 3)
        points = np.full((3000, 3), 4.0)
        writer.append(4, 4, 4, points, np.eye(3), {"node_velocity": points}, {"contact_count": 4})
        writer.close()
        with TrajectoryReader(path) as reader:
            assert reader.whole and reader.step.tolist() == [0, 1, 2, 3, 4]
            assert np.all(reader.node_pos(4) == 4)


_FULL = """
import resource, signal, sys
import numpy as np
from warpfiber.output.record_error import RecordError
from warpfiber.output.trajectory import TrajectoryWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
writer = TrajectoryWriter(sys.argv[1], fiber_node_start=[0, 3000], fiber_group=[0],
    scene_json="{}", attrs={})
try:
    for k in range(100):
        writer.append(k, k, k, np.zeros((3000, 3)))
except RecordError as fault:
    print("RecordError", k, fault, flush=True)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on the size of a file")
def test_full_disk_is_a_record_error(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _FULL, str(tmp_path / "run.vtkhdf")]
    told = subprocess.run(command, capture_output=True, text=True, timeout=60).stdout
    assert told.startswith("RecordError") and "run.vtkhdf: cannot write" in told


def test_vtk_reads_every_step(tmp_path: Path) -> None:
    pytest.importorskip("vtk")
    from vtk import vtkHDFReader  # type: ignore[import-not-found]
    from vtk.util.numpy_support import vtk_to_numpy  # type: ignore[import-not-found]

    path = tmp_path / "run.vtkhdf"
    _write(path, 5)
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 5
    for k in range(5):
        reader.SetStep(k)
        reader.Update()
        data = reader.GetOutputDataObject(0)
        assert data.GetNumberOfLines() == data.GetNumberOfCells() == 3
        points = vtk_to_numpy(data.GetPoints().GetData())
        assert np.array_equal(points, np.asarray(_frame(k)["node_pos"], np.float32))
        group = vtk_to_numpy(data.GetCellData().GetArray("fiber_group"))
        assert group.tolist() == GROUP.tolist()
        assert data.GetCellData().GetArray("fiber_axis").GetNumberOfTuples() == 3
        assert data.GetPointData().GetArray("node_velocity").GetNumberOfTuples() == 10
