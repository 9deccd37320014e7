"""`warpfiber fit`: models fitted to a run, as a table, JSON, CSV and a figure in its folder.

`fit_<weighting>.json` holds constants with their confidence intervals, closure, shape factor,
weighting and every start; `figures/fit_<weighting>.csv` and `.png` the run, the models, and the
exact curve of its fibers without contact, which has no closure.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpfiber.output.axes_style import GRAY, INK, plain_axes
from warpfiber.output.cell_picture import AXIS_COLORS
from warpfiber.output.fit import (
    CLOSURE_FREE,
    CLOSURES,
    CONFIDENCE,
    MODELS,
    Estimate,
    Fitted,
    fit_model,
    selected,
)
from warpfiber.output.folder import ResultFolder
from warpfiber.output.orientation_curve import (
    INDEX,
    WEIGHTINGS,
    Floats,
    OrientationCurve,
    exact_orientation,
    read_curve,
)
from warpfiber.output.record_error import record_errors
from warpfiber.scene import Fault, SceneError

DEFAULT_MODELS = ("folgar_tucker", "rsc", "iard")
NOISE = 0.005
"""Standard deviation of a component of A of one cell with some thousand fibers."""
_DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (6, 2, 1.5, 2)), (0, (1.5, 1.5)), (0, (3, 3)))
_DRAWN = dict(zip(("a11", "a22", "a33", "a13"), (*AXIS_COLORS, INK), strict=True))
_LINE = 0.05
"""Height of a label, of the axis."""


@dataclass(frozen=True)
class FitReport:
    """What was fitted, and the files that tell it."""

    curve: OrientationCurve
    fits: tuple[Fitted, ...]
    exact: Floats
    """A without contact at the strains of the curve, (T, 3, 3)"""
    files: tuple[Path, ...]

    def lines(self) -> list[str]:
        """The table that the command prints."""
        curve = self.curve
        lines = [
            f"{len(curve.strain)} rows of strain {curve.strain[0]:g} to {curve.strain[-1]:g}, "
            f"weighted by {curve.weighting}; closure {self.fits[0].closure}",
            f"shape factor {curve.shape_factor:.6g} of r_W = {curve.aspect_ratio:.4g}, the "
            "length-weighted aspect ratio, one for all fibers",
            f"{'model':<14}{'constant':<10}{'value':>10}{'95 % interval':>24}"
            f"{'chi2/n':>9}{'rms':>9}  starts",
        ]
        for fit in self.fits:
            told = f"{fit.chi2:>9.3g}{fit.rms:>9.2g}  {fit.agreeing} of {len(fit.starts)} agree"
            title = MODELS[fit.model].title
            for name, estimate in fit.estimates.items():
                span = f"{estimate.low:.4g} ... {estimate.high:.4g}"
                lines.append(f"{title:<14}{name:<10}{estimate.value:>10.4g}{span:>24}{told}")
                if estimate.at_bound:
                    lines.append(f"{'':<14}{name} stands at the end of the range it is sought in")
                title = told = ""
        miss = np.sqrt(np.mean((self.exact - curve.tensor) ** 2))
        lines.append(f"without contact (exact, no closure): rms {miss:.2g}")
        return lines


def fit_run(
    folder: Any,
    models: Sequence[str] = DEFAULT_MODELS,
    *,
    closure: str = "IBOF",
    weighting: str = "length",
    low: float | None = None,
    high: float | None = None,
    noise: float = NOISE,
) -> FitReport:
    """Fit models to the orientation curve of a run and write the results into its folder.

    `low`, `high`: range of strain; `noise`: standard deviation of a component, for chi^2 alone.
    Raises SceneError if the run has no such curve, RecordError if a file is damaged or cannot be
    written, ImportError without fiberoripy and SciPy (extra `fit`).
    """
    _check_words(models, closure, weighting)
    place = folder if isinstance(folder, ResultFolder) else ResultFolder.open(folder)
    curve = selected(read_curve(place, weighting), low, high)
    exact = exact_orientation(place, curve.strain, weighting)
    fits = tuple(fit_model(curve, model, closure, noise) for model in models)
    name = f"fit_{weighting}"
    table, picture = (place.path / "figures" / f"{name}{end}" for end in (".csv", ".png"))
    with record_errors(place.path, "write"):
        table.parent.mkdir(exist_ok=True)
        _write_table(table, curve, fits, exact)
        facts = place.write_fit(name, _facts(curve, fits, noise))
    draw_fit(picture, place.path.resolve().name, curve, fits, exact)
    return FitReport(curve, fits, exact, (facts, table, picture))


def _check_words(models: Sequence[str], closure: str, weighting: str) -> None:
    """Raise SceneError for words that are not known."""
    asked = [("--model", model, tuple(MODELS)) for model in models]
    asked += [("--closure", closure, CLOSURES), ("--weighting", weighting, WEIGHTINGS)]
    faults = [
        Fault("command line", key, word, f"unknown; give one of {', '.join(known)}")
        for key, word, known in asked
        if word not in known
    ]
    if closure == CLOSURE_FREE and set(models) - {"folgar_tucker"}:
        remedy = "only --model folgar_tucker is known without a closure"
        faults.append(Fault("command line", "--closure", closure, remedy))
    if faults or not models:
        raise SceneError(faults or [Fault("command line", "--model", None, "name at least one")])


def _facts(curve: OrientationCurve, fits: Sequence[Fitted], noise: float) -> dict[str, Any]:
    """Content of the JSON file."""
    return {
        "weighting": curve.weighting,
        "strain": [curve.strain[0], curve.strain[-1]],
        "rows": len(curve.strain),
        "aspect_ratio_length_weighted": curve.aspect_ratio,
        "shape_factor": curve.shape_factor,
        "noise": noise,
        "confidence": CONFIDENCE,
        "models": {
            fit.model: {
                "closure": fit.closure,
                "constants": {name: _estimate(e) for name, e in fit.estimates.items()},
                "chi2_per_value": fit.chi2,
                "rms": fit.rms,
                "rows_that_count_as_one": fit.alike,
                "starts": [{**constants, "chi2_per_value": c} for constants, c in fit.starts],
                "starts_agreeing": fit.agreeing,
            }
            for fit in fits
        },
    }


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {
        "value": estimate.value,
        "interval": [estimate.low, estimate.high],
        "at_bound": estimate.at_bound,
    }


def _write_table(
    path: Path, curve: OrientationCurve, fits: Sequence[Fitted], exact: Floats
) -> None:
    """One row per strain: the run, every model, and the exact curve without contact."""
    several = [("", curve.tensor), *((f"{f.model}_", f.tensor) for f in fits)]
    several.append(("without_contact_", exact))
    header = ["strain", *(f"{prefix}{name}" for prefix, _ in several for name in INDEX)]
    rows, columns = zip(*INDEX.values(), strict=True)
    body = np.concatenate([tensor[:, rows, columns] for _, tensor in several], axis=1)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([[s, *line] for s, line in zip(curve.strain, body.tolist(), strict=True)])


def draw_fit(
    path: Path, label: str, curve: OrientationCurve, fits: Sequence[Fitted], exact: Floats
) -> None:
    """Draw the run as points, the models and the exact curve without contact as lines."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(6.8, 4.8), dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    x = curve.strain
    points: dict[str, Any] = {"marker": "o", "markersize": 3.5, "markerfacecolor": "white"}
    for name, color in _DRAWN.items():
        i, j = INDEX[name]
        axes.plot(x, curve.tensor[:, i, j], color=color, linestyle="", zorder=3, **points)
        for fit, dash in zip(fits, _DASHES, strict=False):
            axes.plot(x, fit.tensor[:, i, j], color=color, linestyle=dash, linewidth=1.4, zorder=4)
        axes.plot(x, exact[:, i, j], color=color, linewidth=4.0, alpha=0.22, zorder=2)
    above = -np.inf
    for name in sorted(_DRAWN, key=lambda name: float(curve.tensor[-1][INDEX[name]])):
        above = max(float(curve.tensor[-1][INDEX[name]]), above + _LINE)
        style: dict[str, Any] = {"textcoords": "offset points", "va": "center"}
        axes.annotate(f"$a_{{{name[1:]}}}$", (x[-1], above), (6, 0), color=_DRAWN[name], **style)
    entries = [Line2D([], [], color=GRAY, linestyle="", label=label, **points)]
    for fit, dash in zip(fits, _DASHES, strict=False):
        found = ", ".join(f"{_math(n)} = {e.value:.3g}" for n, e in fit.estimates.items())
        words = f"{MODELS[fit.model].title} ({fit.closure}): {found}"
        entries.append(Line2D([], [], color=GRAY, linestyle=dash, label=words))
    entries.append(
        Line2D([], [], color=GRAY, linewidth=4, alpha=0.3, label="exact without contact")
    )
    legend = figure.legend(
        handles=entries, loc="outside lower center", ncols=2, fontsize=8, labelcolor=GRAY
    )
    legend.get_frame().set_linewidth(0)
    title = f"Orientation models, weighted by {curve.weighting}"
    axes.set_title(title, loc="left", fontsize=12, fontweight="bold", color=INK)
    axes.set_xlabel("strain", color=INK)
    axes.set_ylabel("orientation tensor component", color=INK)
    axes.set_ylim(min(0.0, axes.get_ylim()[0]), 1.0)
    axes.margins(x=0)
    plain_axes(axes)
    with record_errors(path, "write"):
        figure.savefig(path)


def _math(name: str) -> str:
    """A constant's name in mathematical type."""
    words = {"kappa": r"\kappa", "Omega": r"\Omega"}
    return f"${words.get(name, name)}$"
