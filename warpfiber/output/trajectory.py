"""Trajectory: the record of a run, `run.vtkhdf`, a VTKHDF file of temporal PolyData.

One cell (polyline) per fiber, topology written once, positions appended frame by frame. VTK and
ParaView open it directly; `/warpfiber` beside `/VTKHDF` holds what VTK has no place for.

Symbols: N nodes, F fibers, K frames. Positions in m, unwrapped, float32; times in s, float64.
A ring names its first node once more at the end of its cell; positions hold every node once.
Limits: the file keeps the default (oldest) HDF5 layout: newer ones do not open after the writer was
killed, nor does VTK read all.
Per frame: data, then offsets, then `NSteps`, then flush, so a killed run loses at most one frame.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpfiber.output.columns import column_meaning
from warpfiber.output.record_error import RecordError, record_errors

if TYPE_CHECKING:
    import h5py

CHUNK_BYTES = 4 << 20
_CELL_TYPES = ("Vertices", "Lines", "Polygons", "Strips")


class TrajectoryWriter:
    """Appends frames to a record; every frame is on disk when `append` returns."""

    def __init__(
        self,
        path: str | Path,
        *,
        fiber_node_start: ArrayLike,
        fiber_group: ArrayLike,
        scene_json: str,
        attrs: Mapping[str, Any],
        closed_groups: Sequence[bool] = (),
        node_fields: Sequence[str] = (),
        layer_columns: Sequence[str] = (),
    ) -> None:
        """Start a record of F fibers: `fiber_node_start` (F+1), `fiber_group` (F).

        `attrs` (hash, version, device, precision, seed ...) become attributes of `/warpfiber`;
        `closed_groups` says of each group whether its fibers are rings (default: none is);
        `node_fields` names what every `append` brings per node, `layer_columns` the columns of its
        value `layers` (layers, columns). Raises RecordError if refused.
        """
        import h5py

        start = np.asarray(fiber_node_start, dtype=np.int64)
        group = np.asarray(fiber_group, dtype=np.int32)
        if start.shape != (len(group) + 1,) or start[0] != 0:
            raise ValueError("fiber_node_start must be (F+1,) from 0, fiber_group (F,)")
        closed = np.zeros(max(len(closed_groups), int(group.max(initial=-1)) + 1), bool)
        closed[: len(closed_groups)] = closed_groups
        self.path = Path(path)
        with record_errors(self.path, "write"):
            file = h5py.File(self.path, "w")
            _write_topology(file, start, group, closed[group])
            own = file.create_group("warpfiber")
            own.attrs["scene"] = scene_json
            own.attrs["node_fields"] = json.dumps(list(node_fields))
            if layer_columns:
                meanings = {name: column_meaning(name) for name in layer_columns}
                own.attrs["layer_columns"] = json.dumps(meanings)
            for name, value in attrs.items():
                if value is not None:
                    own.attrs[name] = value
            file.flush()
        self._attach(file)

    @classmethod
    def reopen(cls, path: str | Path, last_step: int) -> TrajectoryWriter:
        """Continue a record after cutting it to whole frames with step <= `last_step`.

        Raises RecordError if it is missing or damaged.
        """
        import h5py

        writer = cls.__new__(cls)
        writer.path = Path(path)
        with record_errors(path, "reopen"):
            file = h5py.File(path, "r+")
            writer._attach(file)
            whole = min(_frame_counts(file).values())
            steps = file["warpfiber/step"][:whole] if "step" in file["warpfiber"] else np.zeros(0)
            late = np.flatnonzero(steps > last_step)
            writer._cut(int(late[0]) if len(late) else whole)
        return writer

    def append(
        self,
        step: int,
        time: float,
        strain: float,
        node_pos: ArrayLike,
        lattice: ArrayLike | None = None,
        node_fields: Mapping[str, ArrayLike] | None = None,
        values: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Write one frame: `node_pos` (N, 3) in m; `lattice` (3, 3), columns = box vectors in m.

        `values` are numbers or small arrays per frame, the same names in every frame;
        `shear_offset` is taken from the lattice if not among them. Raises ValueError on other names
        or shapes, and RecordError on a refused write.
        """
        points = np.asarray(node_pos, dtype=np.float64)
        if points.shape != (self.node_count, 3):
            raise ValueError(f"node_pos is {points.shape}, must be ({self.node_count}, 3)")
        fields = {name: np.asarray(field) for name, field in (node_fields or {}).items()}
        if set(fields) != set(self.node_fields):
            raise ValueError(f"node fields: {sorted(self.node_fields)}, not {sorted(fields)}")
        per_frame = {"step": np.asarray(step, np.int64), "strain": np.asarray(strain, np.float64)}
        if lattice is not None:
            per_frame["box"] = np.asarray(lattice, np.float64).reshape(3, 3)
            per_frame["shear_offset"] = per_frame["box"][0, 2]
        per_frame |= {name: np.asarray(value) for name, value in (values or {}).items()}
        self._check_names(per_frame)
        axis = fiber_axes(points, self.fiber_node_start)
        with record_errors(self.path, "write"):
            self._write_frame(points, axis, fields, per_frame, time)

    def close(self) -> None:
        """Close the file; closing twice is allowed. Raises RecordError on a refused write."""
        with record_errors(self.path, "close"):
            self._file.close()

    def _attach(self, file: h5py.File) -> None:
        self._file = file
        self.fiber_node_start, _ = _read_topology(file)
        self.node_count = int(file["VTKHDF/NumberOfPoints"][0])
        self.fiber_count = len(self.fiber_node_start) - 1
        self.node_fields = tuple(json.loads(file["warpfiber"].attrs["node_fields"]))
        self.frame_count = int(file["VTKHDF/Steps"].attrs["NSteps"])

    def _check_names(self, per_frame: Mapping[str, NDArray[Any]]) -> None:
        known = set(self._file["warpfiber"])
        if known and known != set(per_frame):
            raise ValueError(f"frame values must be {sorted(known)}, not {sorted(per_frame)}")

    def _write_frame(
        self,
        points: NDArray[np.float64],
        axis: NDArray[np.float64],
        fields: Mapping[str, NDArray[Any]],
        per_frame: Mapping[str, NDArray[Any]],
        time: float,
    ) -> None:
        root, k, nodes = self._file["VTKHDF"], self.frame_count, self.node_count
        _put(root, "Points", k, points.astype(np.float32))
        for name, field in fields.items():
            _put(root, f"PointData/{name}", k, field.astype(np.float32))
            _put(root, f"Steps/PointDataOffsets/{name}", k, np.array([k * nodes]))
        _put(root, "CellData/fiber_axis", k, axis.astype(np.float32))
        for name, value in per_frame.items():
            own = self._file["warpfiber"]
            _put(own, name, k, value[None])
            if k == 0:
                _describe(own[name], name)
        steps = root["Steps"]
        _put(steps, "PointOffsets", k, np.array([k * nodes]))
        _put(steps, "PartOffsets", k, np.array([0]))
        _put(steps, "NumberOfParts", k, np.array([1]))
        _put(steps, "CellOffsets", k, np.zeros((1, len(_CELL_TYPES)), np.int64))
        _put(steps, "ConnectivityIdOffsets", k, np.zeros((1, len(_CELL_TYPES)), np.int64))
        _put(steps, "CellDataOffsets/fiber_axis", k, np.array([k * self.fiber_count]))
        _put(steps, "CellDataOffsets/fiber_group", k, np.array([0]))
        _put(steps, "Values", k, np.array([float(time)]))
        steps.attrs.modify("NSteps", np.int64(k + 1))
        self._file.flush()
        self.frame_count = k + 1

    def _cut(self, frame_count: int) -> None:
        """Shorten all datasets to `frame_count` frames."""
        self._file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(frame_count))
        for dataset, rows in _frame_datasets(self._file):
            dataset.resize(frame_count * rows, axis=0)
        if frame_count == 0:
            # The first frame may be torn, with some of its values missing: the next one decides.
            for name in list(self._file["warpfiber"]):
                del self._file["warpfiber"][name]
        self._file.flush()
        self.frame_count = frame_count


class TrajectoryReader:
    """Reads a record frame by frame, also while it is written; leaves out a torn last frame."""

    def __init__(self, path: str | Path) -> None:
        """Open a record; raises RecordError if it is missing or damaged."""
        import h5py

        self.path = Path(path)
        with record_errors(path, "read"):
            self._file = file = h5py.File(path, "r", locking=False)
            counts = _frame_counts(file)
            own = file["warpfiber"]
            count = min(counts.values())
            self.frame_count: int = count
            self.whole: bool = all(found == count for found in counts.values())
            self.node_count: int = int(file["VTKHDF/NumberOfPoints"][0])
            start, closed = _read_topology(file)
            self.fiber_node_start: NDArray[np.int32] = start.astype("i4")
            self.fiber_closed: NDArray[np.bool_] = closed
            self.fiber_group: NDArray[np.int32] = file["VTKHDF/CellData/fiber_group"][()]
            self.fiber_count: int = len(self.fiber_group)
            self.time: NDArray[np.float64] = file["VTKHDF/Steps/Values"][:count]
            self.step: NDArray[np.int64] = own["step"][:count] if count else np.zeros(0, np.int64)
            self.strain: NDArray[np.float64] = own["strain"][:count] if count else np.zeros(0)
            self.attrs: dict[str, Any] = {
                name: value.item() if isinstance(value, np.generic) else value
                for name, value in own.attrs.items()
                if name not in ("scene", "node_fields")
            }
            self.value_names: tuple[str, ...] = tuple(own)
            text = own.attrs["scene"]
        try:
            self.scene: dict[str, Any] = json.loads(text) if text else {}
        except ValueError as fault:
            raise RecordError(f"{path}: damaged: its scene is no JSON") from fault

    def node_pos(self, frame: int) -> NDArray[np.float32]:
        """Unwrapped node positions (N, 3) of a frame, m."""
        return self._rows("VTKHDF/Points", frame, self.node_count)

    def node_field(self, name: str, frame: int) -> NDArray[np.float32]:
        """A recorded field per node (N, ...) of a frame."""
        return self._rows(f"VTKHDF/PointData/{name}", frame, self.node_count)

    def fiber_axis(self, frame: int) -> NDArray[np.float32]:
        """Unit end-to-end vectors (F, 3) of a frame."""
        return self._rows("VTKHDF/CellData/fiber_axis", frame, self.fiber_count)

    def lattice(self, frame: int) -> NDArray[np.float64] | None:
        """Box vectors of a frame as columns (3, 3), m; None if the record has no box."""
        if "box" not in self.value_names:
            return None
        box: NDArray[np.float64] = self._rows("warpfiber/box", frame, 1)[0]
        return box

    def values(self, name: str) -> NDArray[Any]:
        """A value per frame (K, ...), by its name in `value_names`."""
        with record_errors(self.path, f"read {name}"):
            found: NDArray[Any] = self._file[f"warpfiber/{name}"][: self.frame_count]
        return found

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> TrajectoryReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _rows(self, name: str, frame: int, rows: int) -> NDArray[Any]:
        k = frame + self.frame_count if frame < 0 else frame
        if not 0 <= k < self.frame_count:
            raise IndexError(f"{self.path}: frame {frame} of {self.frame_count}")
        with record_errors(self.path, f"read {name}"):
            found: NDArray[Any] = self._file[name][k * rows : (k + 1) * rows]
        return found


def fiber_axes(node_pos: ArrayLike, fiber_node_start: ArrayLike) -> NDArray[np.float64]:
    """Unit end-to-end vectors (F, 3); zero where both ends coincide."""
    points, start = np.asarray(node_pos, np.float64), np.asarray(fiber_node_start)
    ends = points[start[1:] - 1] - points[start[:-1]]
    length = np.linalg.norm(ends, axis=1, keepdims=True)
    axis: NDArray[np.float64] = np.divide(ends, length, out=np.zeros_like(ends), where=length > 0)
    return axis


def _write_topology(
    file: h5py.File,
    start: NDArray[np.int64],
    group: NDArray[np.int32],
    closed: NDArray[np.bool_],
) -> None:
    """Write all that does not change: types, connectivity, empty datasets of the frames."""
    nodes, fibers = int(start[-1]), len(group)
    ids = np.insert(np.arange(nodes), start[1:][closed], start[:-1][closed])
    offsets = start + np.concatenate([[0], np.cumsum(closed)])
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = np.array([2, 3], np.int64)
    root.attrs.create("Type", np.bytes_("PolyData"))
    _empty(root, "Points", np.float32, (3,), nodes)
    _static(root, "NumberOfPoints", np.array([nodes]))
    for name in _CELL_TYPES:
        lines = name == "Lines"
        _static(root, f"{name}/NumberOfCells", np.array([fibers if lines else 0]))
        _static(root, f"{name}/NumberOfConnectivityIds", np.array([len(ids) if lines else 0]))
        _static(root, f"{name}/Offsets", offsets if lines else np.zeros(1, np.int64))
        _static(root, f"{name}/Connectivity", ids if lines else np.arange(0))
    root.create_group("FieldData")
    root.create_group("PointData")
    _static(root, "CellData/fiber_group", group)
    _empty(root, "CellData/fiber_axis", np.float32, (3,), fibers)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(0)
    steps.create_group("PointDataOffsets")
    _empty(steps, "Values", np.float64, ())
    for name in ("PartOffsets", "NumberOfParts", "PointOffsets"):
        _empty(steps, name, np.int64, ())
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        _empty(steps, name, np.int64, (len(_CELL_TYPES),))
    for name in ("fiber_group", "fiber_axis"):
        _empty(steps, f"CellDataOffsets/{name}", np.int64, ())


def _read_topology(file: h5py.File) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """First nodes of the fibers (F+1,), and which of them are rings (F,)."""
    offsets, ids = file["VTKHDF/Lines/Offsets"][()], file["VTKHDF/Lines/Connectivity"][()]
    closed = (ids[offsets[1:] - 1] == ids[offsets[:-1]]) & (np.diff(offsets) > 1)
    start: NDArray[np.int64] = offsets - np.concatenate([[0], np.cumsum(closed)])
    return start, closed


def _static(group: h5py.Group, name: str, data: NDArray[Any]) -> None:
    chunk = max(1, min(len(data), CHUNK_BYTES // data.itemsize))
    group.create_dataset(name, data=data, maxshape=(None,), chunks=(chunk,))


def _empty(
    group: h5py.Group, name: str, dtype: Any, shape: tuple[int, ...], rows: int = 256
) -> h5py.Dataset:
    """A dataset without rows; one chunk holds `rows` of them, or an even share if that is large."""
    row_bytes = np.dtype(dtype).itemsize * int(np.prod(shape, dtype=np.int64))
    parts = max(1, -(-rows * row_bytes // CHUNK_BYTES))
    chunk = max(1, -(-rows // parts))
    size = {"shape": (0, *shape), "maxshape": (None, *shape), "chunks": (chunk, *shape)}
    return group.create_dataset(name, dtype=dtype, **size)


def _put(group: h5py.Group, name: str, frame: int, data: NDArray[Any]) -> None:
    """Write the rows of one frame; the first frame decides shape and type of a new dataset."""
    if name not in group:
        rows = len(data) if len(data) > 1 else 256
        _empty(group, name, data.dtype, data.shape[1:], rows)
    dataset = group[name]
    dataset.resize((frame + 1) * len(data), axis=0)
    dataset[frame * len(data) :] = data


def _describe(dataset: h5py.Dataset, column: str) -> None:
    """Unit and meaning of a recorded value as attributes."""
    for word, text in zip(("unit", "meaning"), column_meaning(column), strict=True):
        if text:
            dataset.attrs[word] = text


def _frame_datasets(file: h5py.File) -> Iterator[tuple[h5py.Dataset, int]]:
    """All datasets that grow, with their rows per frame."""
    root = file["VTKHDF"]
    nodes, fibers = int(root["NumberOfPoints"][0]), len(root["Lines/Offsets"]) - 1
    yield root["Points"], nodes
    for field in root["PointData"].values():
        yield field, nodes
    yield root["CellData/fiber_axis"], fibers
    for entry in root["Steps"].values():
        for dataset in entry.values() if hasattr(entry, "values") else (entry,):
            yield dataset, 1
    for value in file["warpfiber"].values():
        yield value, 1


def _frame_counts(file: h5py.File) -> dict[str, int]:
    """Whole frames in each growing dataset, and what `NSteps` claims."""
    counts = {data.name: data.shape[0] // max(rows, 1) for data, rows in _frame_datasets(file)}
    return counts | {"NSteps": int(file["VTKHDF/Steps"].attrs["NSteps"])}
