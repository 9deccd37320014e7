"""USD: units, samples, wrapping, colors, and what the validators of USD say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdValidation

from warpfiber.output.cell import Cell
from warpfiber.output.record_error import RecordError
from warpfiber.output.trajectory import TrajectoryWriter
from warpfiber.output.usd import export_usd

EDGE, RADIUS, COUNT, NODES, FRAMES = 500e-6, (5e-6, 8e-6), 40, 5, 6
START = np.arange(COUNT + 1) * NODES
GROUP = (np.arange(COUNT) >= 30).astype(np.int32)


def _positions(frame: int, edge: float = EDGE) -> np.ndarray:
    """Random chains of about 0.6 edges, drifting; some lie many boxes away."""
    rng = np.random.default_rng(4)
    start = rng.uniform(-2, 3, size=(COUNT, 1, 3))
    step = rng.normal(size=(COUNT, NODES, 3)) * 0.05 + rng.normal(size=(COUNT, 1, 3)) * 0.1
    return ((start + np.cumsum(step, axis=1) + 0.03 * frame * start[..., ::-1]) * edge).reshape(
        -1, 3
    )


def _lattice(frame: int, edge: float = EDGE, sheared: bool = True) -> np.ndarray:
    lattice = np.diag([edge] * 3)
    lattice[0, 2] = (0.3 * frame % 1.0) * edge * sheared
    return lattice


def _record(
    folder: Path,
    boxed: bool = True,
    sheared: bool = True,
    edge: float = EDGE,
    closed_groups: tuple[bool, ...] = (),
    **box: Any,
) -> Path:
    scene: dict[str, Any] = {"fibers": [{"diameter": 2 * r * edge / EDGE} for r in RADIUS]}
    if boxed:
        scene["box"] = {"size": [edge] * 3, "boundary": ["periodic"] * 3} | box
    folder.mkdir(exist_ok=True)
    writer = TrajectoryWriter(
        folder / "run.vtkhdf",
        fiber_node_start=START,
        fiber_group=GROUP,
        scene_json=json.dumps(scene),
        attrs={"version": "0.1.0", "hash": "ab12"},
        closed_groups=closed_groups,
    )
    for k in range(FRAMES):
        lattice = _lattice(k, edge, sheared) if boxed else None
        writer.append(k, 0.5 * k, 2.0 * k, _positions(k, edge), lattice)
    writer.close()
    return folder


def _curves(stage: Usd.Stage, group: int) -> UsdGeom.BasisCurves:
    return UsdGeom.BasisCurves(stage.GetPrimAtPath(f"/World/Fibers/group_{group}"))


def _findings(stage: Usd.Stage) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetMessage()}" for error in errors]


def _check_samples(stage: Usd.Stage, frames: int) -> None:
    """What the validators do not see: lengths, extents and numbers of every sample."""
    for group in range(2):
        curves = _curves(stage, group)
        assert curves.GetPointsAttr().GetTimeSamples() == list(range(frames))
        for code in range(frames):
            points = np.array(curves.GetPointsAttr().Get(code))
            counts = np.array(curves.GetCurveVertexCountsAttr().Get(code))
            color = np.array(curves.GetDisplayColorPrimvar().Get(code))
            widths = np.array(curves.GetWidthsAttr().Get(code))
            extent = np.array(curves.GetExtentAttr().Get(code))
            assert counts.sum() == len(points) and counts.min() >= 2
            assert len(color) == len(counts) and widths.shape == (1,)
            assert np.isfinite(points).all() and np.isfinite(color).all()
            assert (extent[0] <= points.min(0) - widths[0] / 2).all()
            assert (extent[1] >= points.max(0) + widths[0] / 2).all()
            assert (extent[1] - extent[0] <= 1.001 * (np.ptp(points, axis=0) + widths[0])).all()


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("wrap", ["none", "fiber", "split"])
def test_every_sample_is_consistent_and_valid(tmp_path: Path, wrap: Any, smooth: bool) -> None:
    folder = _record(tmp_path / "run")
    path = export_usd(folder, wrap=wrap, smooth=smooth)
    assert path == folder / "usd" / "run.usdc"
    assert [entry.name for entry in path.parent.iterdir()] == ["run.usdc"]
    stage = Usd.Stage.Open(str(path))
    _check_samples(stage, FRAMES)
    assert _findings(stage) == []
    curves = _curves(stage, 0)
    assert curves.GetTypeAttr().Get() == ("cubic" if smooth else "linear")
    if smooth:
        assert curves.GetBasisAttr().Get() == "catmullRom"
        assert curves.GetWrapAttr().Get() == "pinned"


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("wrap", ["none", "fiber", "split"])
def test_rings_are_closed(tmp_path: Path, wrap: Any, smooth: bool) -> None:
    """Periodic curves with every node once; cut ones have the length of the closed fibers."""
    folder = _record(tmp_path / "run", closed_groups=(False, True))
    stage = Usd.Stage.Open(str(export_usd(folder, wrap=wrap, smooth=smooth)))
    _check_samples(stage, FRAMES)
    assert _findings(stage) == []
    open_ends = "pinned" if smooth else "nonperiodic"
    wraps = [_curves(stage, k).GetWrapAttr().Get() for k in range(2)]
    assert wraps == [open_ends, open_ends if wrap == "split" else "periodic"]
    points = np.array(_curves(stage, 1).GetPointsAttr().Get(0)).astype(float) * 1e-6
    counts = np.array(_curves(stage, 1).GetCurveVertexCountsAttr().Get(0))
    if wrap != "split":
        assert counts.tolist() == [NODES] * 10
        return
    nodes = _positions(0).reshape(COUNT, NODES, 3)[30:]
    edges = np.roll(nodes, -1, axis=1) - nodes
    joined = np.ones(len(points) - 1, bool)
    joined[np.cumsum(counts)[:-1] - 1] = False
    total = np.linalg.norm(np.diff(points, axis=0), axis=1)[joined].sum()
    assert total == pytest.approx(np.linalg.norm(edges, axis=2).sum(), rel=1e-6)


def test_stage_says_what_it_is(tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(export_usd(_record(tmp_path / "run"))))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1e-6
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 24
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, FRAMES - 1)
    data = stage.GetRootLayer().customLayerData
    assert list(data["warpfiber:time"]) == [0.5 * k for k in range(FRAMES)]
    assert data["warpfiber:version"] == "0.1.0" and data["warpfiber:hash"] == "ab12"
    for group in range(2):
        curves = _curves(stage, group)
        assert np.allclose(curves.GetWidthsAttr().Get(), 2e6 * RADIUS[group])
        assert curves.GetWidthsInterpolation() == "constant"
        assert curves.GetDisplayColorPrimvar().GetInterpolation() == "uniform"
        material, _ = UsdShade.MaterialBindingAPI(curves).ComputeBoundMaterial()
        assert material.GetPath() == "/World/Materials/Fiber"
        assert curves.GetCurveVertexCountsAttr().GetNumTimeSamples() == 0
        assert curves.GetWidthsAttr().GetNumTimeSamples() == 0


@pytest.mark.parametrize("edge, unit", [(0.9e-3, 1e-6), (1e-3, 1e-3), (0.3, 1e-3)])
def test_unit_follows_the_box(tmp_path: Path, edge: float, unit: float) -> None:
    stage = Usd.Stage.Open(str(export_usd(_record(tmp_path / "run", edge=edge), wrap="none")))
    assert UsdGeom.GetStageMetersPerUnit(stage) == unit
    points = np.array(_curves(stage, 0).GetPointsAttr().Get(0)) * unit
    assert np.allclose(points, _positions(0, edge)[: 30 * NODES], rtol=1e-6, atol=1e-6 * edge)


def test_colors_are_squares_of_the_axis(tmp_path: Path) -> None:
    folder = _record(tmp_path / "run")
    stage = Usd.Stage.Open(str(export_usd(folder)))
    for code in range(FRAMES):
        nodes = _positions(code).reshape(COUNT, NODES, 3)
        axis = nodes[:, -1] - nodes[:, 0]
        expected = axis**2 / np.sum(axis**2, axis=1, keepdims=True)
        color = np.array(_curves(stage, 1).GetDisplayColorPrimvar().Get(code))
        assert np.allclose(color, expected[30:], atol=1e-5)
    plain = Usd.Stage.Open(str(export_usd(folder, tmp_path / "plain.usda", color="group")))
    primvar = _curves(plain, 1).GetDisplayColorPrimvar()
    assert primvar.GetAttr().GetNumTimeSamples() == 0 and len(primvar.Get()) == 10


def test_fiber_wrap_moves_whole_fibers_by_lattice_vectors(tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(export_usd(_record(tmp_path / "run"))))
    for code in range(FRAMES):
        groups = [np.array(_curves(stage, k).GetPointsAttr().Get(code)) for k in range(2)]
        moved = np.concatenate(groups).reshape(COUNT, NODES, 3) * 1e-6
        center = moved.mean(axis=1)
        assert center.min() > -1e-9 and center.max() < EDGE + 1e-9
        shift = moved - _positions(code).reshape(COUNT, NODES, 3)
        assert np.ptp(shift, axis=1).max() < 1e-9
        image = np.linalg.solve(_lattice(code), shift[:, 0].T)
        assert np.abs(image - np.round(image)).max() < 1e-5


@pytest.mark.parametrize("sheared", [False, True])
def test_split_conserves_length_and_stays_inside(tmp_path: Path, sheared: bool) -> None:
    stage = Usd.Stage.Open(
        str(export_usd(_record(tmp_path / "run", sheared=sheared), wrap="split"))
    )
    for code in range(FRAMES):
        total, lattice = 0.0, _lattice(code, 1.0, sheared)
        for k in range(2):
            points = np.array(_curves(stage, k).GetPointsAttr().Get(code)).astype(float)
            counts = np.array(_curves(stage, k).GetCurveVertexCountsAttr().Get(code))
            inside = np.linalg.solve(lattice, points.T / 500)
            assert inside.min() > -1e-6 and inside.max() < 1 + 1e-6
            joined = np.ones(len(points) - 1, bool)
            joined[np.cumsum(counts)[:-1] - 1] = False
            total += np.linalg.norm(np.diff(points, axis=0), axis=1)[joined].sum()
        nodes = _positions(code).reshape(COUNT, NODES, 3)
        expected = np.linalg.norm(np.diff(nodes, axis=1), axis=2).sum()
        assert total * 1e-6 == pytest.approx(expected, rel=1e-6)


def test_split_of_named_cases() -> None:
    cell = Cell(np.eye(3), (True, True, False))

    def split(*nodes: tuple[float, float, float]) -> tuple[np.ndarray, list[int]]:
        points, counts, owner = cell.split_fibers(np.array(nodes), [0, len(nodes)])
        assert (owner == 0).all()
        return points, counts.tolist()

    points, counts = split((0.2, 0.5, 0.5), (0.8, 0.5, 0.5))
    assert counts == [2] and np.allclose(points[:, 0], [0.2, 0.8])
    points, counts = split((0.5, 0.5, 0.5), (3.25, 0.5, 0.5))
    assert counts == [2, 2, 2, 2] and np.allclose(points[:, 0], [0.5, 1, 0, 1, 0, 1, 0, 0.25])
    # Through an edge: both planes at once, no piece of length zero.
    points, counts = split((0.5, 0.5, 0.5), (1.5, 1.5, 0.5))
    assert counts == [2, 2] and np.allclose(points[2], [0, 0, 0.5])
    # A node exactly on a face, a fiber that turns there, and one that lies in the face.
    assert split((0.5, 0.5, 0), (1.0, 0.5, 0), (1.5, 0.5, 0))[1] == [2, 2]
    assert split((0.5, 0.5, 0), (1.0, 0.5, 0), (0.5, 0.6, 0))[1] == [3]
    assert split((1.0, 0.1, 0), (1.0, 0.9, 0))[1] == [2]
    # z does not repeat.
    points, counts = split((0.5, 0.5, -3.5), (0.5, 0.5, 2.5))
    assert counts == [2] and np.allclose(points[:, 2], [-3.5, 2.5])
    # A segment without length.
    assert split((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))[1] == [2]


def test_cell_falls_back_to_the_parallelepiped() -> None:
    lattice = np.array([[1.0, 0.2, 0.0], [0.3, 1.0, 0.0], [0.0, 0.1, 1.0]])
    cell = Cell(lattice, (True, True, True))
    center = np.random.default_rng(2).uniform(-3, 3, size=(50, 3))
    inside = np.linalg.solve(lattice, (center + cell.image_shift(center)).T)
    assert inside.min() >= -1e-12 and inside.max() <= 1 + 1e-12
    assert np.allclose(cell.corner_pos()[-1], lattice.sum(axis=1))


def test_box_edges(tmp_path: Path) -> None:
    for wrap, sheared, samples in (
        ("fiber", True, 0),
        ("split", True, FRAMES),
        ("split", False, 0),
    ):
        folder = _record(tmp_path / "run", sheared=sheared)
        stage = Usd.Stage.Open(str(export_usd(folder, wrap=wrap)))  # type: ignore[arg-type]
        box = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/Box"))
        assert box.GetPointsAttr().GetNumTimeSamples() == samples
        points = np.array(box.GetPointsAttr().Get(1)).reshape(12, 2, 3)
        length = np.sort(np.linalg.norm(points[:, 0] - points[:, 1], axis=1))
        assert np.allclose(length[:8], 500)
        assert np.allclose(length[8:], 500 * np.hypot(1, 0.3) if samples else 500)


def test_unbounded_scene(tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(export_usd(_record(tmp_path / "run", boxed=False), wrap="split")))
    assert not stage.GetPrimAtPath("/World/Box")
    _check_samples(stage, FRAMES)
    assert _findings(stage) == []


def test_choice_of_frames_and_names(tmp_path: Path) -> None:
    folder = _record(tmp_path / "run")
    out = tmp_path / "new" / "part.usda"
    stage = Usd.Stage.Open(str(export_usd(folder / "run.vtkhdf", out, slice(1, None, 2), "none")))
    _check_samples(stage, 3)
    assert list(stage.GetRootLayer().customLayerData["warpfiber:time"]) == [0.5, 1.5, 2.5]
    points = np.array(_curves(stage, 0).GetPointsAttr().Get(2)) * 1e-6
    assert np.allclose(points, _positions(5)[: 30 * NODES], atol=1e-9)
    with pytest.raises(RecordError, match="none of the 6 frames"):
        export_usd(folder, frames=slice(6, None))
    for wrong in ({"wrap": "box"}, {"color": "red"}, {"out": tmp_path / "x.obj"}):
        with pytest.raises(ValueError):
            export_usd(folder, **wrong)  # type: ignore[arg-type]
