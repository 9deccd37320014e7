"""Figures through the thickness: orientation and volume fraction of the layers at some strains.

`layers.png` a11, a22, a33 by length, `layers_number.png` by number, `layers_smoothed.png` a11 by
length as 3-point averages over neighboring layers (two at the walls), `layers_fraction.png`. Each
lies beside a CSV with what it shows. Points of a reference table with columns strain, z (m) and
a11 ... are drawn over the frames nearest to their strains, which are then the ones shown.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.axes_style import GRAY, INK, plain_axes
from warpfiber.output.record_error import record_errors
from warpfiber.output.scalars import read_scalars

Floats = NDArray[np.float64]
SHOWN = 5
"""Strains that are drawn where no reference names others."""


@dataclass(frozen=True)
class LayerTable:
    """`layers.csv` by frames: `moment` (K,) strain, or time where nothing is strained."""

    against: str
    moment: Floats
    values: Mapping[str, Floats]
    """columns (K, n)"""

    @property
    def middle(self) -> Floats:
        """Heights of the middles of the layers (K, n), m."""
        return np.asarray(0.5 * (self.values["z_low"] + self.values["z_high"]))


def read_layers(path: Path) -> LayerTable | None:
    """The whole frames of `layers.csv`; None if there is no frame. Raises RecordError."""
    if not path.exists():
        return None
    table = read_scalars(path)
    count = int(table["layer"].max(initial=-1)) + 1
    frames = len(table["layer"]) // count if count else 0
    if frames == 0:
        return None
    values = {
        name: column[: frames * count].astype(float).reshape(frames, count)
        for name, column in table.items()
    }
    against = "strain" if frames < 2 or np.ptp(values["strain"]) > 0 else "time"
    return LayerTable(against, values[against][:, 0], values)


def draw_layers(
    path: Path, target: Path, scene: Mapping[str, Any], references: Mapping[str, Mapping[str, Any]]
) -> list[Path]:
    """Draw the figures of a `layers.csv` into the folder `target`; returns the PNG files."""
    table = read_layers(path)
    if table is None:
        return []
    points = {stem: rows for stem, rows in references.items() if "z" in rows and "strain" in rows}
    shown = _shown(table, points)
    tensor = [
        ("a11", "$a_{11}$  flow"),
        ("a22", "$a_{22}$  vorticity"),
        ("a33", "$a_{33}$  gradient"),
    ]
    by_number = [(f"{name}_fiber", label) for name, label in tensor]
    smoothed = {"a11": smooth(table.values["a11"])}
    asked = _asked_fraction(scene)
    fraction = [("volume_fraction", "volume fraction")]
    figures: tuple[tuple[Any, ...], ...] = (
        ("layers", "weighted by length", tensor, table.values, points, {}),
        ("layers_number", "one vote per fiber", by_number, table.values, {}, {}),
        ("layers_smoothed", "by length, 3-point average", tensor[:1], smoothed, {}, {}),
        ("layers_fraction", "pieces in each layer", fraction, table.values, {}, asked),
    )
    written = []
    for name, title, columns, values, marks, wanted in figures:
        file = target / f"{name}.png"
        _draw(file, title, columns, table, values, shown, marks, wanted)
        written.append(file)
    return written


def smooth(values: Floats) -> Floats:
    """Means of each layer and its neighbors, over layers (last axis); nan counts as absent."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0), known.astype(float)
    for array in (total, count):
        shifted = array.copy()
        array[..., 1:] += shifted[..., :-1]
        array[..., :-1] += shifted[..., 1:]
    return np.asarray(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))


def _shown(table: LayerTable, points: Mapping[str, Mapping[str, Any]]) -> list[int]:
    """Frames nearest to the strains of the references, else SHOWN ones from start to end."""
    strains = sorted({float(s) for rows in points.values() for s in rows["strain"]})
    if not strains or table.against != "strain":
        strains = list(np.linspace(table.moment[0], table.moment[-1], SHOWN))
    nearest = [int(np.argmin(np.abs(table.moment - strain))) for strain in strains]
    return list(dict.fromkeys(nearest))


def _asked_fraction(scene: Mapping[str, Any]) -> dict[str, tuple[Floats, Floats]]:
    """Edges (m) and values of the volume fraction that the layers of the scene ask for.

    Of a table that was split into lengths only the first group carries the layers.
    """
    groups = scene.get("fibers") or []
    tables = {group.get("table", k) for k, group in enumerate(groups)}
    layers = [group["layers"] for group in groups if group.get("layers")]
    if len(tables) != 1 or not layers:
        return {}
    edges = np.cumsum([0.0] + [float(layer["thickness"]) for layer in layers[0]])
    return {"volume_fraction": (edges, np.array([row["volume_fraction"] for row in layers[0]]))}


def _draw(
    path: Path,
    title: str,
    columns: Sequence[tuple[str, str]],
    table: LayerTable,
    values: Mapping[str, Floats],
    shown: Sequence[int],
    points: Mapping[str, Mapping[str, Any]],
    asked: Mapping[str, tuple[Floats, Floats]],
) -> None:
    """One panel per column, one line per strain, and the table of what is drawn."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.2 + 2.9 * len(columns), 3.9), dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(columns), squeeze=False, sharey=False)[0]
    shades = colormaps["viridis"](np.linspace(0.0, 0.85, max(2, len(shown))))
    rows: list[list[Any]] = []
    word = "strain" if table.against == "strain" else "time"
    for axes, (name, label) in zip(panels, columns, strict=True):
        plain_axes(axes)
        axes.set_title(label, loc="left", fontsize=11, color=INK)
        axes.set_xlabel("height in the box (mm)", color=INK)
        for frame, shade in zip(shown, shades, strict=False):
            z, y = 1e3 * table.middle[frame], values[name][frame]
            moment = float(table.moment[frame])
            axes.plot(z, y, color=shade, marker=".", linewidth=1.5, label=f"{word} {moment:.4g}")
            rows += [["run", name, moment, a, b] for a, b in zip(1e-3 * z, y, strict=True)]
            for stem, mark in points.items():
                if name not in mark:
                    continue
                strains = np.asarray(mark["strain"], float)
                nearest = np.argmin(np.abs(strains[:, None] - table.moment[shown]), axis=1)
                mine = np.asarray(shown)[nearest] == frame
                z_mark, y_mark = np.asarray(mark["z"])[mine], np.asarray(mark[name])[mine]
                style = {"marker": "o", "linestyle": "", "markerfacecolor": "white"}
                axes.plot(1e3 * z_mark, y_mark, color=shade, **style)
                rows += [
                    [f"reference {stem}", name, s, a, b]
                    for s, a, b in zip(strains[mine], z_mark, y_mark, strict=True)
                ]
        if name in asked:
            edges, wanted = asked[name]
            axes.stairs(wanted, 1e3 * edges, color=GRAY, linestyle="--", label="asked")
            middle = 0.5 * (edges[1:] + edges[:-1])
            rows += [["asked", name, "", a, b] for a, b in zip(middle, wanted, strict=True)]
        low, high = axes.get_ylim()
        axes.set_ylim(min(0.0, low), max(high, 1.0 if name.startswith("a11") else high))
    panels[-1].legend(fontsize=8, labelcolor=GRAY, framealpha=0.88)
    figure.suptitle(f"Through the thickness: {title}", x=0.02, ha="left", fontsize=12, color=INK)
    with record_errors(path, "write"):
        figure.savefig(path)
        with path.with_suffix(".csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["run", "column", table.against, "z", "value"])
            writer.writerows(rows)
