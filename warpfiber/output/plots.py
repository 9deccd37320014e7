"""Figures of a run, drawn from its folder alone; each PNG lies beside a CSV with what it shows.

Curves against strain (time, where nothing is strained): orientation by length and by number,
interactions, overlap, bending, stress, energy, pressure on walls (also against volume fraction),
stress on grips against their way, axial strain, angle, and the tip of a few fibers; `cell.png` is
a picture of the cell at the end. Where layers were recorded (in the first run) `layers*.png` go
through the thickness and `cut.png` is a section there.
Points of `reference/*.csv` beside the scene are drawn over them: a header row with `strain` (or
`time`) and columns named as in `scalars.csv` (`tip` for the tip); lines with # are comments.
So is the exact orientation of the fibers without contact, where it applies or is asked for.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.axes_style import GRAY, INK, plain_axes
from warpfiber.output.cell_picture import draw_cell
from warpfiber.output.curves import BLUE, FIGURES, GREEN, ORANGE, PURPLE, Curves
from warpfiber.output.cut_picture import draw_cut
from warpfiber.output.folder import ResultFolder
from warpfiber.output.layer_figures import draw_layers
from warpfiber.output.orientation_curve import exact_table, exact_without_contact
from warpfiber.output.record_error import record_errors
from warpfiber.output.scalars import read_scalars
from warpfiber.output.trajectory import TrajectoryReader

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Table = dict[str, NDArray[Any]]
TIP_FIBERS = 10  # more curves than this say nothing
COVERS = 0.02  # curves as near as this part of their largest value in the mean look like one
_DPI = 160
_DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))

_DECADES = 1e10
"""Largest ratio of the ends of a logarithmic axis."""


@dataclass(frozen=True)
class _Run:
    """What the figures of one folder need."""

    label: str
    table: Table
    folder: ResultFolder
    scene: Mapping[str, Any]


def plot_run(folders: Any, out: str | Path | None = None, exact: bool = False) -> list[Path]:
    """Draw all figures of one folder, or of several in the same axes; returns the PNG files.

    `folders`: path or ResultFolder, or a list of them. `out`: folder for the pictures, by default
    `figures/` of the first run. A figure without data is left out. `exact`: draw the orientation
    without contact also where fibers touch or bend. Raises SceneError if a folder is missing, or
    has no exact orientation, RecordError if a file is damaged or cannot be written.
    """
    several = folders if isinstance(folders, (list, tuple)) else [folders]
    runs = [_read_run(folder) for folder in several]
    target = runs[0].folder.path / "figures" if out is None else Path(out)
    with record_errors(target, "make the folder"):
        target.mkdir(parents=True, exist_ok=True)
    references = _references(runs[0]) | _exact(runs[0], exact)
    written = []
    for curves in (*FIGURES, _tip_curves(runs)):
        path = target / f"{curves.name}.png"
        if _draw_curves(curves, runs, references, path):
            written.append(path)
    written += draw_layers(runs[0].folder.layers_path, target, runs[0].scene, references)
    if runs[0].folder.trajectory_path.exists():
        with TrajectoryReader(runs[0].folder.trajectory_path) as reader:
            if reader.frame_count:
                draw_cell(reader, target / "cell.png")
                written.append(target / "cell.png")
                layered = runs[0].folder.layers_path.exists()
                if layered and draw_cut(reader, target / "cut.png"):
                    written.append(target / "cut.png")
    return written


def _read_run(given: Any) -> _Run:
    folder = ResultFolder.open(getattr(given, "path", given))
    table: Table = {}
    if folder.scalars_path.exists():
        table |= read_scalars(folder.scalars_path)
    scene = folder.read_scene()
    label = folder.path.resolve().name
    return _Run(label, _with_tips(table, folder), folder, scene)


def _with_tips(table: Table, folder: ResultFolder) -> Table:
    """The table and, from the record of at most TIP_FIBERS fibers, columns `tip` or `tip_<fiber>`.

    z of the last node from the center of its fiber, over the centerline length L of the first
    frame; these columns belong to `tip_strain`, the strain of the frames.
    """
    path = folder.trajectory_path
    if not path.exists():
        return table
    with TrajectoryReader(path) as reader:
        fibers, start = reader.fiber_count, reader.fiber_node_start
        if not 0 < fibers <= TIP_FIBERS or not reader.frame_count:
            return table
        frames = np.array([reader.node_pos(k) for k in range(reader.frame_count)], np.float64)
        tips: Table = {"tip_strain": reader.strain, "tip_time": reader.time}
    for k in range(fibers):
        nodes = frames[:, start[k] : start[k + 1]]
        length = np.linalg.norm(np.diff(nodes[0], axis=0), axis=1).sum()
        name = "tip" if fibers == 1 else f"tip_{k}"
        tips[name] = (nodes[:, -1, 2] - nodes[:, :, 2].mean(axis=1)) / (length or 1.0)
    return table | tips


def _tip_curves(runs: Iterable[_Run]) -> Curves:
    names = {name for run in runs for name in run.table if name.startswith("tip")}
    names -= {"tip_strain", "tip_time"}
    shades = [BLUE, ORANGE, GREEN, PURPLE, "#c0487a", "#5b8a72", "#b59a2c", "#4a5ba8"]
    columns = {
        name: (name.replace("tip_", "fiber ").replace("tip", ""), shades[k % len(shades)])
        for k, name in enumerate(sorted(names))
    }
    return Curves("tip", "Height of the fiber tip", "$z_{\\mathrm{tip}}\\,/\\,L$", columns)


def _abscissa(
    table: Mapping[str, NDArray[Any]], column: str, along: str = ""
) -> tuple[str, NDArray[Any]]:
    """What a column is drawn against: strain, or time where the strain stays zero or is absent."""
    if along:
        return along, table[along]
    prefix = "tip_" if column.startswith("tip") and "tip_strain" in table else ""
    for name in ("strain", "time", "step"):
        values = table.get(prefix + name)
        if values is not None and (name == "step" or len(values) < 2 or np.ptp(values) > 0):
            return name, values
    return "row", np.arange(len(table[column]))


def _references(run: _Run) -> dict[str, Table]:
    """Tables `reference/<scene name>*.csv` beside the scene file, by file name; may be empty."""
    # the summary has the absolute path: a plot may be drawn from another folder
    named = run.folder.read_summary().get("scene_path") or run.scene.get("path")
    found: dict[str, Table] = {}
    if not named:
        return found
    scene = Path(str(named))
    for path in sorted((scene.parent / "reference").glob(f"{scene.stem}*.csv")):
        with record_errors(path, "read"):
            lines = path.read_text(encoding="utf-8").splitlines()
        rows = list(csv.reader(line for line in lines if line.strip() and line[0] != "#"))
        if not rows:
            continue
        names = [name.strip() for name in rows[0]]
        try:
            body = np.array([[float(entry or "nan") for entry in row] for row in rows[1:]])
        except ValueError:
            continue  # a table of words is no curve
        if body.ndim == 2 and body.shape[1] == len(names):
            found[path.stem] = {name: body[:, k] for k, name in enumerate(names)}
    return found


def _exact(run: _Run, asked: bool) -> dict[str, Table]:
    """The exact orientation without contact as one more table of points; may be empty."""
    if not asked and not ("a11" in run.table and exact_without_contact(run.scene)):
        return {}
    return {"exact_without_contact": exact_table(run.folder)}


def _known(curves: Curves, run: _Run) -> list[str]:
    """Columns of the figure that a run has."""
    if curves.along and not _finite(run.table, curves.along):
        return []
    return [name for name in curves.columns if _finite(run.table, name)]


def _is_covered(curves: Curves, run: _Run, name: str) -> bool:
    """Whether a curve that is drawn later lies on this one and would hide it."""
    names, y = _known(curves, run), run.table[name].astype(float)
    least = COVERS * float(np.nanmax(np.abs(y)))
    apart = [np.abs(run.table[other] - y) for other in names[names.index(name) + 1 :]]
    return any(float(np.nanmean(way)) <= least for way in apart)


def _draw_curves(
    curves: Curves, runs: Sequence[_Run], references: Mapping[str, Table], path: Path
) -> bool:
    """Draw one figure and its CSV; false if no run has a column of it."""
    drawn = [run for run in runs if _known(curves, run)]
    if not any(np.nanmax(r.table[n]) > curves.least for r in drawn for n in _known(curves, r)):
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.9), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    rows: list[list[Any]] = []
    ends: list[tuple[float, str, str]] = []
    against = "strain"
    for name, (label, color) in curves.columns.items():
        lasts = []
        for run in drawn:
            if not _finite(run.table, name):
                continue
            against, x = _abscissa(run.table, name, curves.along)
            y = run.table[name].astype(float)
            shown = np.where(y > 0, y, np.nan) if curves.logarithmic else y
            if not np.isfinite(shown).any():
                continue
            dash = _DASHES[drawn.index(run) % len(_DASHES)]
            width = 4.8 if _is_covered(curves, run, name) else 1.6
            axes.plot(x, shown, color=color, linestyle=dash, linewidth=width, zorder=3)
            known = shown[np.isfinite(shown)]
            lasts.append(np.median(known[-max(1, len(known) // 30) :]))
            rows += [[run.label, name, a, b] for a, b in zip(x, y, strict=True)]
        if lasts and label:
            # Flow, vorticity and gradient are directions of simple shear only.
            words = label if _sheared(drawn[0]) else label.split("  ")[0]
            ends.append((float(np.mean(lasts)), words, color))
        rows += _draw_reference(axes, references, name, against, color)
    if not rows:
        return False
    _dress(axes, curves, drawn, against)
    _label_ends(axes, ends)
    _draw_legend(axes, drawn, references)
    with record_errors(path, "write"):
        figure.savefig(path)
        with path.with_suffix(".csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["run", "column", against, "value"])
            writer.writerows(rows)
    return True


def _sheared(run: _Run) -> bool:
    return (run.scene.get("flow") or {}).get("kind") == "simple_shear"


def _finite(table: Mapping[str, NDArray[Any]], name: str) -> bool:
    return name in table and bool(np.isfinite(table[name]).any())


def _draw_reference(
    axes: Axes, references: Mapping[str, Table], name: str, against: str, color: str
) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for k, (stem, table) in enumerate(references.items()):
        if name in table and against in table and "z" not in table:
            marker = "osD^v"[k % 5]
            style: dict[str, Any] = {
                "marker": marker,
                "markersize": 4.5,
                "markerfacecolor": "white",
                "clip_on": False,
            }
            axes.plot(table[against], table[name], color=color, linestyle="", zorder=2.5, **style)
            points = zip(table[against], table[name], strict=True)
            rows += [[f"reference {stem}", name, a, b] for a, b in points]
    return rows


def _dress(axes: Axes, curves: Curves, runs: Sequence[_Run], against: str) -> None:
    """Title, axes, limits and the light grid."""
    scene = runs[0].scene
    strain = "shear strain" if _sheared(runs[0]) else "strain"
    words = {"strain": strain, "time": "time (s)", "volume_fraction": "volume fraction"}
    words["grip_strain"] = "way of the grip / free height"
    axes.set_xlabel(words.get(against, against), color=INK)
    axes.set_ylabel(curves.ylabel, color=INK)
    words_of_scene = str(scene.get("title") or "")[:60] if len(runs) == 1 else ""
    # beside the title where both fit into the width, else below it
    beside = 1.5 * len(curves.title) + len(words_of_scene) < 62
    pad = 10 if beside or not words_of_scene else 24
    axes.set_title(curves.title, loc="left", fontsize=12, fontweight="bold", color=INK, pad=pad)
    if words_of_scene:
        axes.annotate(
            words_of_scene,
            (1.0 if beside else 0.0, 1.0),
            (0, 10 if beside else 8),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="right" if beside else "left",
            va="bottom",
            fontsize=9,
            color=GRAY,
        )
    plain_axes(axes)
    axes.margins(x=0)
    if curves.logarithmic:
        axes.set_yscale("log")
        # rounding at the start must not squeeze everything else into a corner
        top = axes.get_ylim()[1]
        axes.set_ylim(max(axes.get_ylim()[0], top / _DECADES), top)
    elif curves.ylim:
        low, high = curves.ylim
        axes.set_ylim(low, high if np.isfinite(high) else max(1.08 * axes.get_ylim()[1], 1e-12))


def _label_ends(axes: Axes, ends: Sequence[tuple[float, str, str]]) -> None:
    """Write each label where its curve ends, pushed apart where they would overlap."""
    if not ends:
        return
    transform, spacing = axes.transData + axes.transAxes.inverted(), 0.062
    x = axes.get_xlim()[1]
    order = sorted(ends)
    heights = [float(transform.transform((x, value))[1]) for value, _, _ in order]
    placed = list(heights)
    for _ in range(50):
        for k in range(len(placed) - 1):
            short = spacing - (placed[k + 1] - placed[k])
            if short > 1e-6:
                placed[k] -= short / 2
                placed[k + 1] += short / 2
    lift = max(0.0, 0.02 - placed[0])
    for (_, label, color), height in zip(order, placed, strict=True):
        axes.annotate(
            label,
            (1.0, height + lift),
            xytext=(6, 0),
            xycoords="axes fraction",
            textcoords="offset points",
            va="center",
            color=color,
            fontsize=10,
        )


def _draw_legend(axes: Axes, runs: Sequence[_Run], references: Mapping[str, Table]) -> None:
    """Name the runs, if several, and the references that are drawn."""
    from matplotlib.lines import Line2D

    entries: list[Any] = []
    if len(runs) > 1:
        for k, run in enumerate(runs):
            dash = _DASHES[k % len(_DASHES)]
            entries.append(Line2D([], [], color=GRAY, linestyle=dash, label=run.label))
    shown = {line.get_marker() for line in axes.get_lines()}
    for k, stem in enumerate(references):
        marker = "osD^v"[k % 5]
        if marker in shown:
            style: dict[str, Any] = {"marker": marker, "linestyle": "", "markerfacecolor": "white"}
            entries.append(Line2D([], [], color=GRAY, label=stem.replace("_", " "), **style))
    if entries:
        legend = axes.legend(handles=entries, framealpha=0.88, fontsize=9, labelcolor=GRAY)
        legend.get_frame().set_linewidth(0)
