"""Cell picture: the fibers of one frame as shaded tubes in their box, seen in perspective.

The color of a fiber is its direction: a mix of red (x), green (y) and blue (z) with the weights
p_x^2, p_y^2, p_z^2 of the unit end-to-end vector p, which add up to one.

Tubes are drawn from back to front as filled outlines in the picture plane (one collection, exact
widths), because 3D axes neither sort lines of one collection by depth nor scale them with distance.
Limits: tubes that touch each other are sorted by the middle of pieces about four diameters long.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.cell import Cell, closed_lines, group_radius
from warpfiber.output.record_error import record_errors
from warpfiber.output.trajectory import TrajectoryReader

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

AXIS_COLORS = ("#d1495b", "#2a9d6f", "#2f6db5")
_INK, _GRAY, _EDGE = "#22262b", "#6b7280", "#8a919c"
_AZIMUTH, _ELEVATION, _DISTANCE = -64.0, 19.0, 4.2  # degrees, degrees, diagonals of the box
_PIECE_DIAMETERS = 4.0
_DETAILED_PIECES = 60_000  # more are drawn flat, which takes a third of the time


@dataclass(frozen=True)
class _Camera:
    """A perspective view of what lies around `center`, `size` across."""

    center: Floats
    size: float

    @property
    def frame(self) -> Floats:
        """Rows: right, up and toward the eye, unit vectors."""
        az, el = np.radians(_AZIMUTH), np.radians(_ELEVATION)
        toward = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
        right = np.array([-np.sin(az), np.cos(az), 0.0])
        return np.array([right, np.cross(toward, right), toward])

    def project(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Picture positions (..., 2), magnification (...) and depth (...), larger = nearer."""
        seen = (points - self.center) @ self.frame.T / self.size
        scale = _DISTANCE / (_DISTANCE - seen[..., 2])
        return seen[..., :2] * scale[..., None], scale / self.size, seen[..., 2]


def draw_cell(reader: TrajectoryReader, path: Path, frame: int = -1) -> None:
    """Draw a frame of a record to `path` (PNG), and the fibers that it shows to a CSV beside it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    start, group = reader.fiber_node_start, reader.fiber_group
    axis = reader.fiber_axis(frame).astype(np.float64)
    cell = Cell.of_scene(reader.scene, reader.lattice(frame))
    points = reader.node_pos(frame).astype(np.float64)
    if cell is not None:
        points = cell.wrap_fibers(points, start)
    radius = group_radius(reader.scene, int(group.max(initial=-1)) + 1)[group]

    outline = points if cell is None else np.vstack([points, cell.corner_pos()])
    low, high = outline.min(axis=0), outline.max(axis=0)
    if cell is not None:
        low, high = cell.corner_pos().min(axis=0), cell.corner_pos().max(axis=0)
    size = float(np.linalg.norm(high - low)) or float(radius.max(initial=1.0))
    camera = _Camera(0.5 * (low + high), size)

    figure = Figure(figsize=(6.4, 6.4), dpi=160, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_aspect("equal")
    if cell is not None:
        _draw_edges(axes, cell, camera)
    lines = closed_lines(points, start, reader.fiber_closed)
    _draw_tubes(axes, camera, *lines, radius, axis)
    flat = camera.project(outline)[0]
    _frame_view(axes, flat)
    if cell is not None:
        _draw_size(axes, cell, camera)
    _draw_key(figure, camera, reader.scene)
    _draw_words(figure, reader, frame)
    with record_errors(path, "write"):
        figure.savefig(path)
        _write_table(path.with_suffix(".csv"), points, start, group, axis)


def _draw_edges(axes: Axes, cell: Cell, camera: _Camera) -> None:
    """Box edges: those at the far corner behind the fibers, the others thinly in front."""
    from matplotlib.collections import LineCollection

    edges = cell.edges()
    flat, _, _ = camera.project(edges)
    _, _, corner_depth = camera.project(cell.corner_pos())
    far = cell.corner_pos()[int(np.argmin(corner_depth))]
    behind = np.any(np.all(np.isclose(edges, far), axis=2), axis=1)
    axes.add_collection(LineCollection(list(flat[behind]), colors="#c3c8cf", linewidths=0.9))
    front = LineCollection(list(flat[~behind]), colors=_EDGE, linewidths=1.0, zorder=5, alpha=0.9)
    axes.add_collection(front)


def _draw_tubes(
    axes: Axes,
    camera: _Camera,
    points: Floats,
    start: NDArray[np.int32],
    radius: Floats,
    axis: Floats,
) -> None:
    """Every segment in short pieces, far ones first; each a dark rim, a body and a highlight."""
    from matplotlib.collections import PolyCollection

    begin, end, fiber, tips = _pieces(points, start, radius)
    p0, scale0, depth0 = camera.project(begin)
    p1, scale1, depth1 = camera.project(end)
    w0, w1 = radius[fiber] * scale0, radius[fiber] * scale1
    depth = 0.5 * (depth0 + depth1)
    order = np.argsort(depth, kind="stable")

    body = direction_colors(axis)[fiber]
    # Distant fibers fade toward the paper, which tells depth where nothing crosses.
    fog = 0.45 * np.clip((0.40 - depth) / 0.80, 0, 1)[:, None]
    detailed = len(begin) <= _DETAILED_PIECES
    layers = [(1.0, 0.0, 0.50 * body), (0.74, 0.0, body)]
    if detailed:
        layers.append((0.24, 0.34, 0.55 * body + 0.45))
    arc = 1 if not detailed else 4 if len(begin) > 1000 else 12
    shapes, colors = [], []
    for width, offset, color in layers:
        shapes.append(_capsules(p0, p1, w0, w1, width, offset, tips, arc)[order])
        colors.append((color * (1 - fog) + fog)[order])
    stacked = np.stack(shapes, axis=1)
    tubes = PolyCollection(
        list(stacked.reshape(-1, *stacked.shape[2:])),
        facecolors=np.stack(colors, axis=1).reshape(-1, 3),
        edgecolors="none",
        zorder=3,
    )
    axes.add_collection(tubes)


def _pieces(
    points: Floats, start: NDArray[np.int32], radius: Floats
) -> tuple[Floats, Floats, NDArray[np.int64], NDArray[np.bool_]]:
    """Segments in pieces: begin, end (P, 3), fiber (P,), whether begin, end is a tip (P, 2)."""
    fiber = np.repeat(np.arange(len(start) - 1), np.diff(start))
    first = np.flatnonzero(fiber[1:] == fiber[:-1])
    a, b, owner = points[first], points[first + 1], fiber[first]
    length = np.linalg.norm(b - a, axis=1)
    count = np.ceil(length / (2 * _PIECE_DIAMETERS * radius[owner])).astype(int).clip(1, 200)
    segment = np.repeat(np.arange(len(a)), count)
    rank = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    t0 = (rank / count[segment])[:, None]
    t1 = ((rank + 1) / count[segment])[:, None]
    step = (b - a)[segment]
    tip_begin = (rank == 0) & np.isin(first, start[:-1])[segment]
    tip_end = (rank + 1 == count[segment]) & np.isin(first + 2, start[1:])[segment]
    tips = np.stack([tip_begin, tip_end], axis=1)
    return a[segment] + t0 * step, a[segment] + t1 * step, owner[segment], tips


def _capsules(
    p0: Floats,
    p1: Floats,
    w0: Floats,
    w1: Floats,
    width: float,
    offset: float,
    tips: NDArray[np.bool_],
    arc: int,
) -> Floats:
    """Outlines (P, 2 (arc+1), 2) of strips, shifted to the light, round at fiber tips."""
    along = p1 - p0
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 1e-12, along / np.maximum(length, 1e-12), [1.0, 0.0])
    across = _turned(along)
    joint = ~tips[:-1, 1] & ~tips[1:, 0]
    corner = _miters(along, joint)
    light = across * np.where(across @ np.array([-0.5, 1.0]) < 0, -1.0, 1.0)[:, None]
    # Pieces of one fiber reach into each other; the body further than the rim, which it must cover.
    overlap = (0.02 if width == 1 else 0.08) * length
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, arc + 1)
    sides = []
    for k, point, w, sign in ((0, p0, w0, -1.0), (1, p1, w1, 1.0)):
        tip = tips[:, k]
        middle = point + light * (offset * w)[:, None]
        middle = middle + along * sign * np.where(tip[:, None], 0.0, overlap)
        half = (width * w)[:, None, None]
        bulge = np.where(tip, 1.0, 0.0)[:, None, None] * np.cos(angle)[None, :, None]
        reach = sign * (bulge * along[:, None] + np.sin(angle)[None, :, None] * corner[k][:, None])
        sides.append(middle[:, None] + half * reach)
    return np.concatenate(sides, axis=1)


def _turned(vectors: Floats) -> Floats:
    """Vectors (P, 2) turned left by a right angle."""
    return np.stack([-vectors[:, 1], vectors[:, 0]], axis=1)


def _miters(along: Floats, joint: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Half widths (P, 2) at begin and end of unit strips; joined neighbors share a corner."""
    begin, end = _turned(along), _turned(along)
    middle = along[:-1] + along[1:]
    # |middle| = 2 cos(half the bend): a corner is at most twice as wide as the strip.
    corner = 2 * _turned(middle) / np.maximum(np.sum(middle**2, axis=1), 1.0)[:, None]
    begin[1:][joint], end[:-1][joint] = corner[joint], corner[joint]
    return begin, end


def direction_colors(axis: Floats) -> Floats:
    """Color (F, 3) of unit vectors (F, 3): the three axis colors mixed by p_x^2, p_y^2, p_z^2."""
    from matplotlib.colors import to_rgb

    mixed: Floats = axis**2 @ np.array([to_rgb(color) for color in AXIS_COLORS])
    return mixed


def _frame_view(axes: Axes, flat: Floats) -> None:
    """Fit the picture around the points, with room for the words at the top and bottom."""
    low, high = flat.min(axis=0), flat.max(axis=0)
    half = 0.5 * float((high - low).max()) * 1.13
    x, y = 0.5 * (low + high)
    axes.set_xlim(x - half, x + half)
    axes.set_ylim(y - half * 1.04, y + half * 0.96)


def _draw_size(axes: Axes, cell: Cell, camera: _Camera) -> None:
    """Write the length of the box edge that lies in front, below it."""
    from matplotlib.patheffects import withStroke

    corner = cell.corner_pos()
    length = float(np.ptp(corner[:, 0]))
    front = np.array([corner[:, 0].min(), corner[:, 1].min(), corner[:, 2].min()])
    ends = camera.project(np.array([front, front + [length, 0.0, 0.0]]))[0]
    halo = [withStroke(linewidth=3, foreground="white")]
    slope = np.degrees(np.arctan2(*(ends[1] - ends[0])[::-1]))
    axes.annotate(
        _metric(length),
        ends.mean(axis=0),
        xytext=(0, -12),
        textcoords="offset points",
        ha="center",
        va="center",
        rotation=slope,
        fontsize=10,
        color=_GRAY,
        path_effects=halo,
        zorder=6,
    )


def _metric(length: float) -> str:
    """A length in the unit that suits it."""
    for unit, name in ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm")):
        if length >= 0.9999 * unit:
            return f"{length / unit:.4g} {name}"
    return f"{length / 1e-9:.4g} nm"


def _draw_key(figure: Any, camera: _Camera, scene: Any) -> None:
    """The three axes as seen in the picture, in the color of a fiber along them."""
    axes = figure.add_axes((0.015, 0.015, 0.24, 0.17))
    axes.set_axis_off()
    axes.set_xlim(-0.55, 1.85)
    axes.set_ylim(-0.45, 1.25)
    axes.set_aspect("equal", anchor="SW")
    shear = ((scene.get("flow") or {}).get("kind")) == "simple_shear"
    names = ("x flow", "y vorticity", "z gradient") if shear else ("x", "y", "z")
    for k in range(3):
        tip = camera.frame[:2, k]
        arrow = {"arrowstyle": "-|>", "color": AXIS_COLORS[k], "linewidth": 3, "shrinkA": 0}
        axes.annotate("", tip, (0, 0), arrowprops=arrow | {"shrinkB": 0, "mutation_scale": 13})
        place = {"ha": "left", "va": "center", "fontsize": 9.5, "color": AXIS_COLORS[k]}
        axes.annotate(names[k], tip, xytext=(4, 1), textcoords="offset points", **place)


def _draw_words(figure: Any, reader: TrajectoryReader, frame: int) -> None:
    title = str(reader.scene.get("title") or "")[:70]
    words = f"{reader.fiber_count:,} fiber{'s' * (reader.fiber_count != 1)}"
    if reader.strain[-1] > 0:
        words += f", strain {reader.strain[frame]:.4g}"
    figure.text(0.03, 0.967, title or words, fontsize=13, fontweight="bold", color=_INK, va="top")
    if title:
        figure.text(0.03, 0.93, words, fontsize=10.5, color=_GRAY, va="top")
    note = "color = direction of the fiber"
    figure.text(0.975, 0.03, note, fontsize=9.5, color=_GRAY, ha="right", va="bottom")


def _write_table(
    path: Path,
    points: Floats,
    start: NDArray[np.int32],
    group: NDArray[np.int32],
    axis: Floats,
) -> None:
    center = np.add.reduceat(points, start[:-1], axis=0) / np.diff(start)[:, None]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["fiber", "group", "x", "y", "z", "p_x", "p_y", "p_z"])
        for k in range(len(group)):
            numbers = [*center[k], *axis[k]]
            writer.writerow([k, int(group[k]), *(f"{value:.7g}" for value in numbers)])
