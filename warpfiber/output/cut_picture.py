"""Section through the thickness: what a plane y = const shows of the fibers, first and last frame.

A point of the plane is colored where it lies inside a fiber, by the direction p of the segment
there: red, green and blue (x, y, z) mixed with the weights p_x^2, p_y^2, p_z^2, as in `cell.png`.
Where fibers overlap the one with the nearer center line shows.

Symbols: a fiber radius, y_0 place of the plane.
Limits: needs a box. Segments are cylinders with round ends, cut at the faces of a periodic box.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.axes_style import GRAY, INK
from warpfiber.output.cell import Cell, closed_lines, group_radius
from warpfiber.output.cell_picture import direction_colors
from warpfiber.output.record_error import record_errors
from warpfiber.output.trajectory import TrajectoryReader

Floats = NDArray[np.float64]
MOST_PIXELS = 1600
"""Pixels along the longer side of the section."""
PIXELS_PER_RADIUS = 6.0
"""No finer than this many pixels in a radius."""


def draw_cut(reader: TrajectoryReader, path: Path) -> bool:
    """Draw the sections at mid width of the first and last frame, and the table of what they cut.

    False, and nothing drawn, without a box.
    """
    frames = [0, reader.frame_count - 1] if reader.frame_count > 1 else [0]
    cells = [Cell.of_scene(reader.scene, reader.lattice(k)) for k in frames]
    if cells[0] is None:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = cells[0].corner_pos().max(axis=0)
    tall = 6.4 * min(2.0, size[2] / size[0])
    figure = Figure(figsize=(7.2, 0.9 + (tall + 0.5) * len(frames)), dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    rows: list[list[Any]] = []
    for k, frame in enumerate(frames):
        cell = cells[k]
        assert cell is not None
        size = cell.corner_pos().max(axis=0)
        place = 0.5 * float(size[1])
        begin, end, owner, radius = _segments(reader, frame, cell)
        picture, shown = section(begin, end, radius, place, (float(size[0]), float(size[2])))
        axes = figure.add_subplot(len(frames), 1, k + 1)
        extent = (0.0, 1e3 * size[0], 0.0, 1e3 * size[2])
        axes.imshow(picture, origin="lower", extent=extent, interpolation="antialiased")
        axes.set_title(f"strain {reader.strain[frame]:.4g}", loc="left", fontsize=10, color=INK)
        axes.tick_params(labelcolor=GRAY, labelsize=8)
        axes.set_ylabel("z (mm)", color=INK, fontsize=9)
        direction = end - begin
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        middle = 0.5 * (begin + end)
        rows += [
            [float(reader.strain[frame]), int(owner[s]), *(f"{v:.7g}" for v in middle[s])]
            + [f"{v:.7g}" for v in direction[s]]
            for s in shown
        ]
    axes.set_xlabel("x (mm)", color=INK, fontsize=9)
    words = f"Section at y = {1e3 * place:.4g} mm; direction: "
    figure.suptitle(words + "x red, y green, z blue", x=0.02, ha="left", fontsize=11, color=INK)
    with record_errors(path, "write"):
        figure.savefig(path)
        with path.with_suffix(".csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["strain", "fiber", "x", "y", "z", "p_x", "p_y", "p_z"])
            writer.writerows(rows)
    return True


def section(
    begin: Floats, end: Floats, radius: Floats, place: float, size: tuple[float, float]
) -> tuple[Floats, list[int]]:
    """Picture (rows from z = 0 up, columns along x, RGB) of the plane y = place, and who is in it.

    Segments from begin to end (S, 3) m of radius (S,) m in a section of `size` = (x, z) m from 0.
    """
    pixel = max(max(size) / MOST_PIXELS, float(radius.min(initial=np.inf)) / PIXELS_PER_RADIUS)
    pixel = min(pixel, min(size))
    columns, rows = max(1, round(size[0] / pixel)), max(1, round(size[1] / pixel))
    x = (np.arange(columns) + 0.5) * size[0] / columns
    z = (np.arange(rows) + 0.5) * size[1] / rows
    picture = np.ones((rows, columns, 3))
    nearest = np.full((rows, columns), np.inf)
    step = end - begin
    length = np.linalg.norm(step, axis=1)
    color = direction_colors(step / np.maximum(length, 1e-300)[:, None])
    low = np.minimum(begin[:, 1], end[:, 1]) - radius
    high = np.maximum(begin[:, 1], end[:, 1]) + radius
    shown = []
    for s in np.flatnonzero((low <= place) & (place <= high)):
        near = _near_part(float(begin[s, 1]), float(step[s, 1]), place, float(radius[s]))
        ends = begin[s] + np.outer(near, step[s])
        first, last = ends.min(axis=0) - radius[s], ends.max(axis=0) + radius[s]
        i0, i1 = np.searchsorted(x, (first[0], last[0]))
        k0, k1 = np.searchsorted(z, (first[2], last[2]))
        if i0 == i1 or k0 == k1:
            continue
        dx, dz = x[None, i0:i1] - begin[s, 0], z[k0:k1, None] - begin[s, 2]
        dy = place - begin[s, 1]
        along = (dx * step[s, 0] + dy * step[s, 1] + dz * step[s, 2]) / length[s] ** 2
        t = np.clip(along, 0.0, 1.0)
        apart = (dx - t * step[s, 0]) ** 2 + (dz - t * step[s, 2]) ** 2
        apart = np.sqrt(apart + (dy - t * step[s, 1]) ** 2) / radius[s]
        mine = (apart <= 1.0) & (apart < nearest[k0:k1, i0:i1])
        if mine.any():
            picture[k0:k1, i0:i1][mine] = color[s]
            nearest[k0:k1, i0:i1][mine] = apart[mine]
            shown.append(int(s))
    return picture, shown


def _near_part(y: float, rise: float, place: float, radius: float) -> tuple[float, float]:
    """Fractions of a segment from y to y + rise between which it is within a radius of y = place.

    An end may be nearest where it is farther: the fractions are kept within the segment.
    """
    if abs(rise) < 1e-12 * radius:
        return 0.0, 1.0
    ends = sorted(((place - radius - y) / rise, (place + radius - y) / rise))
    return min(max(ends[0], 0.0), 1.0), min(max(ends[1], 0.0), 1.0)


def _segments(
    reader: TrajectoryReader, frame: int, cell: Cell
) -> tuple[Floats, Floats, NDArray[np.int32], Floats]:
    """Begin and end (S, 3) of the segments inside the box, their fibers and radii."""
    points = reader.node_pos(frame).astype(np.float64)
    lines = closed_lines(points, reader.fiber_node_start, reader.fiber_closed)
    pieces, count, owner = cell.split_fibers(*lines)
    group = reader.fiber_group
    of_piece = np.repeat(owner, count)
    piece = np.repeat(np.arange(len(count)), count)
    first = np.flatnonzero(piece[1:] == piece[:-1])
    fiber = of_piece[first]
    radius = group_radius(reader.scene, int(group.max(initial=-1)) + 1)[group[fiber]]
    return pieces[first], pieces[first + 1], fiber, radius
