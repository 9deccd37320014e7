"""USD export: the record of a run as one animated stage, `usd/run.usdc`.

One linear `BasisCurves` per fiber group at `/World/Fibers/group_<k>`, exact through the nodes (of
rings: periodic; cut at the box: open pieces), with width = diameter and, as color, (p_x^2, p_y^2,
p_z^2) of the unit fiber axis p; the box edges at `/World/Box`. Frames map to time codes 0 ... K-1
(playback is not physical time; the physical times are in `customLayerData`). Lengths are in mm or
um with an honest `metersPerUnit`, because some renderers break on scenes of size 1e-3.

Limits: `split` needs a box; unbounded scenes are written as recorded.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.cell import Cell, closed_lines, group_radius
from warpfiber.output.record_error import RecordError, record_errors
from warpfiber.output.trajectory import TrajectoryReader

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

Wrap = Literal["none", "fiber", "split"]
Color = Literal["orientation", "group"]
Floats = NDArray[np.float64]

CODES_PER_SECOND = 24
GROUP_COLORS = ((0.85, 0.33, 0.31), (0.20, 0.47, 0.74), (0.24, 0.63, 0.43), (0.93, 0.69, 0.25))
_BOX_COLOR = (0.25, 0.25, 0.28)
_BOX_WIDTH = 0.003  # of the longest edge: thin, yet thicker than a pixel of a usual picture


def export_usd(
    folder: Any,
    out: str | Path | None = None,
    frames: slice | None = None,
    wrap: Wrap = "fiber",
    smooth: bool = False,
    color: Color = "orientation",
) -> Path:
    """Write the record of `folder` (path or ResultFolder) as USD; returns the path of the file.

    `wrap`: `none` as recorded, `fiber` moves whole fibers into the box, `split` cuts them at its
    faces. `smooth`: cubic curves through the nodes. `color`: `orientation` or `group`. `out` ends
    in .usdc, .usda or .usd; default `usd/run.usdc`. Raises ValueError on other words, RecordError
    if the record is damaged, holds no such frame, or the disk refuses the file.
    """
    if wrap not in get_args(Wrap):
        raise ValueError(f"wrap must be one of {', '.join(get_args(Wrap))}, not {wrap!r}")
    if color not in get_args(Color):
        raise ValueError(f"color must be one of {', '.join(get_args(Color))}, not {color!r}")
    source = Path(getattr(folder, "path", folder))
    source = source / "run.vtkhdf" if source.is_dir() else source
    path = source.parent / "usd" / "run.usdc" if out is None else Path(out)
    if path.suffix not in (".usd", ".usda", ".usdc"):
        raise ValueError(f"{path}: the name must end in .usdc, .usda or .usd")
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    with TrajectoryReader(source) as reader:
        chosen = list(range(reader.frame_count))[frames or slice(None)]
        if not chosen:
            raise RecordError(f"{source}: none of the {reader.frame_count} frames is chosen")
        with record_errors(path, "write"):
            path.parent.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            _write_stage(part, reader, chosen, wrap, smooth, color)
            os.replace(part, path)
            _reload(path)
    return path


def _reload(path: Path) -> None:
    """Let a stage that this process has open on an older file of that name see the new one."""
    from pxr import Sdf

    layer = Sdf.Layer.Find(str(path))
    if layer:
        layer.Reload(force=True)


def _write_stage(
    path: Path,
    reader: TrajectoryReader,
    frames: list[int],
    wrap: Wrap,
    smooth: bool,
    color: Color,
) -> None:
    """Author and save the stage: curves of every group, box edges, one material."""
    from pxr import Gf, Usd, UsdGeom

    cells = [Cell.of_scene(reader.scene, reader.lattice(k)) for k in frames]
    edge = _longest_edge(cells[0], reader.node_pos(frames[0]))
    unit = 1e-3 if edge >= 1e-3 else 1e-6
    stage = Usd.Stage.CreateNew(str(path))
    _write_metadata(stage, reader, frames, unit)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    UsdGeom.Scope.Define(stage, "/World/Fibers")
    material = _write_material(stage)

    group_count = int(reader.fiber_group.max(initial=-1)) + 1
    radius = group_radius(reader.scene, group_count) / unit
    cut = wrap == "split" and cells[0] is not None
    rings = [not cut and bool(closed.any()) for closed in _by_group(reader, group_count)]
    groups = [_Group(stage, k, radius[k], smooth, rings[k], material) for k in range(group_count)]
    for code, (frame, cell) in enumerate(zip(frames, cells, strict=True)):
        points, counts, owner = _curves(reader, frame, cell, wrap)
        if color == "orientation":
            shade = reader.fiber_axis(frame).astype(np.float64) ** 2
        else:
            shade = np.array(GROUP_COLORS)[reader.fiber_group % len(GROUP_COLORS)]
        piece_group = reader.fiber_group[owner]
        first = np.concatenate([[0], np.cumsum(counts)])
        for k, group in enumerate(groups):
            pieces = np.flatnonzero(piece_group == k)
            rows = np.repeat(piece_group == k, counts) if len(groups) > 1 else slice(0, first[-1])
            group.write(code, points[rows] / unit, counts[pieces], shade[owner[pieces]])
    _write_box(stage, cells, wrap != "split", unit, Gf.Vec3f(*_BOX_COLOR), material)
    stage.Save()


def _by_group(reader: TrajectoryReader, group_count: int) -> list[NDArray[np.bool_]]:
    """Of every group, which of its fibers are rings: all or none."""
    return [reader.fiber_closed[reader.fiber_group == k] for k in range(group_count)]


class _Group:
    """The curves of one fiber group; authors a time sample only where something changes."""

    def __init__(
        self,
        stage: Usd.Stage,
        index: int,
        radius: float,
        smooth: bool,
        closed: bool,
        material: Any,
    ) -> None:
        from pxr import UsdGeom, Vt

        curves = UsdGeom.BasisCurves.Define(stage, f"/World/Fibers/group_{index}")
        _set_curve_type(curves, smooth, closed)
        curves.CreateWidthsAttr(Vt.FloatArray([2 * radius]))
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        _bind(curves, material)
        self.radius = radius
        self.counts = curves.CreateCurveVertexCountsAttr()
        self.points = curves.CreatePointsAttr()
        self.extent = curves.CreateExtentAttr()
        self.color = curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform)
        self._last: dict[str, tuple[int, NDArray[Any]]] = {}

    def write(self, code: int, points: Floats, counts: NDArray[np.int32], color: Floats) -> None:
        """One frame: points (N, 3) and radius in stage units, points per curve, color per curve."""
        from pxr import Vt

        xyz = np.ascontiguousarray(points, dtype=np.float32)
        self.points.Set(Vt.Vec3fArray.FromNumpy(xyz), code)
        if len(xyz):
            bounds = np.array([xyz.min(0) - self.radius, xyz.max(0) + self.radius])
            # Outward by one rounding, so that the float32 box holds every tube whatever its size.
            bounds += np.array([[-1.0], [1.0]]) * np.spacing(np.abs(xyz).max() + self.radius)
            self.extent.Set(Vt.Vec3fArray.FromNumpy(bounds.astype(np.float32)), code)
        self._set("counts", self.counts, code, np.ascontiguousarray(counts), Vt.IntArray)
        shade = np.ascontiguousarray(color, dtype=np.float32)
        self._set("color", self.color, code, shade, Vt.Vec3fArray)

    def _set(self, name: str, attribute: Any, code: int, value: NDArray[Any], kind: Any) -> None:
        """Author a default first, samples only once the value differs from the one before."""
        if name not in self._last:
            attribute.Set(kind.FromNumpy(value))
        else:
            since, before = self._last[name]
            if np.array_equal(before, value):
                return
            if since == 0:
                attribute.Set(kind.FromNumpy(before), 0)
            # Colors are interpolated between samples: hold the old one up to the frame before.
            attribute.Set(kind.FromNumpy(before), code - 1)
            attribute.Set(kind.FromNumpy(value), code)
        self._last[name] = (code, value)


def _curves(
    reader: TrajectoryReader, frame: int, cell: Cell | None, wrap: Wrap
) -> tuple[Floats, NDArray[np.int32], NDArray[np.int32]]:
    """Points (m), points per curve and fiber of each curve in one frame, wrapped as asked."""
    start = reader.fiber_node_start
    points = reader.node_pos(frame).astype(np.float64)
    if cell is not None and wrap == "split":
        return cell.split_fibers(*closed_lines(points, start, reader.fiber_closed))
    if cell is not None and wrap == "fiber":
        points = cell.wrap_fibers(points, start)
    return points, np.diff(start).astype(np.int32), np.arange(len(start) - 1, dtype=np.int32)


def _longest_edge(cell: Cell | None, points: NDArray[np.float32]) -> float:
    if cell is not None:
        return float(np.ptp(cell.corner_pos(), axis=0).max())
    return float(np.ptp(points, axis=0).max(initial=0.0))


def _write_metadata(
    stage: Usd.Stage, reader: TrajectoryReader, frames: list[int], unit: float
) -> None:
    from pxr import UsdGeom, Vt

    UsdGeom.SetStageMetersPerUnit(stage, unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetTimeCodesPerSecond(CODES_PER_SECOND)
    stage.SetFramesPerSecond(CODES_PER_SECOND)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(frames) - 1)
    data: dict[str, Any] = {
        "warpfiber:time": Vt.DoubleArray([float(reader.time[k]) for k in frames]),
        "warpfiber:strain": Vt.DoubleArray([float(reader.strain[k]) for k in frames]),
    }
    for name in ("version", "hash"):
        if name in reader.attrs:
            data[f"warpfiber:{name}"] = str(reader.attrs[name])
    stage.GetRootLayer().customLayerData = data


def _write_material(stage: Usd.Stage) -> Any:
    """A preview surface that takes its color from `displayColor`."""
    from pxr import Sdf, UsdGeom, UsdShade

    UsdGeom.Scope.Define(stage, "/World/Materials")
    material = UsdShade.Material.Define(stage, "/World/Materials/Fiber")
    reader = UsdShade.Shader.Define(stage, "/World/Materials/Fiber/Color")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    color = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface = UsdShade.Shader.Define(stage, "/World/Materials/Fiber/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.5)
    shading = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(shading)
    return material


def _bind(curves: UsdGeom.BasisCurves, material: Any) -> None:
    from pxr import UsdShade

    UsdShade.MaterialBindingAPI.Apply(curves.GetPrim()).Bind(material)


def _set_curve_type(curves: UsdGeom.BasisCurves, smooth: bool, closed: bool = False) -> None:
    """Linear, or a cubic that passes through the nodes (a B-spline would not)."""
    from pxr import UsdGeom

    open_ends = UsdGeom.Tokens.pinned if smooth else UsdGeom.Tokens.nonperiodic
    curves.CreateWrapAttr(UsdGeom.Tokens.periodic if closed else open_ends)

    if smooth:
        curves.CreateTypeAttr(UsdGeom.Tokens.cubic)
        curves.CreateBasisAttr(UsdGeom.Tokens.catmullRom)
    else:
        curves.CreateTypeAttr(UsdGeom.Tokens.linear)


def _write_box(
    stage: Usd.Stage,
    cells: list[Cell | None],
    brick: bool,
    unit: float,
    color: Any,
    material: Any,
) -> None:
    """The 12 box edges, sampled only if the box changes."""
    from pxr import UsdGeom, Vt

    drawn = [cell.edges(brick).reshape(-1, 3) / unit for cell in cells if cell is not None]
    if len(drawn) < len(cells):
        return
    curves = UsdGeom.BasisCurves.Define(stage, "/World/Box")
    _set_curve_type(curves, smooth=False)
    width = _BOX_WIDTH * float(np.abs(drawn[0]).max())
    curves.CreateCurveVertexCountsAttr(Vt.IntArray([2] * 12))
    curves.CreateWidthsAttr(Vt.FloatArray([width]))
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(Vt.Vec3fArray([color]))
    _bind(curves, material)
    points, extent = curves.CreatePointsAttr(), curves.CreateExtentAttr()
    fixed = all(np.array_equal(edges, drawn[0]) for edges in drawn)
    for code, edges in enumerate(drawn[:1] if fixed else drawn):
        xyz = np.ascontiguousarray(edges, dtype=np.float32)
        bounds = np.array([xyz.min(0) - width, xyz.max(0) + width], dtype=np.float32)
        when = () if fixed else (code,)
        points.Set(Vt.Vec3fArray.FromNumpy(xyz), *when)
        extent.Set(Vt.Vec3fArray.FromNumpy(bounds), *when)
