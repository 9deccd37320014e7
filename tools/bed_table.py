"""What pressed, pulled and sheared beds show: `tools/bed_table.py [--picture PNG] FOLDER ...`.

Runs whose scenes differ by their seed (or the number of cycles) alone make one column: of every
quantity the mean over them, the standard deviation of one run, and `-` where no run has it; the
head of a column names what the scenes differ by, and the number of runs. Pressed, pulled and
sheared beds make a table each.
Symbols: P pressure on the upper wall (`low`: on the lower), phi volume fraction, Z touching fibers
    per fiber, F mean contact force (`pair`: by touching pair of fibers), L_s free height between
    the grips, D_F maximum Feret diameter of the stress-free shape, L_c length of the centerline, d
    diameter; a number after a name is phi. Branches of the cycles are the stages: settling, then
    loading and unloading in turn. Below the tables of pulled and sheared beds: rank correlations
    (Spearman) of the yield stress with kappa (0: straight), D_F / L_c and L_s / d. The picture
    shows the yield stress over D_F / L_c, a point per column and a bar of one deviation.
Source: the quantities are those of Xu, Ma & Guo 2023, Figs. 4 and 7 to 18.
Limits: values at a fraction are of lines through a window of 0.005 around it, values at a pressure
    of means over such windows. Folders of runs that have not ended are left out, and named.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpfiber.placement.shapes import feret_diameter, rest_nodes
from warpfiber.scene import Shape

Rows = dict[str, np.ndarray]
Setting = Any  # of a scene: tables, lists and values
WINDOW = 0.005  # of phi
FRACTIONS = (0.20, 0.25, 0.28, 0.30, 0.35, 0.40)
PRESSURES = (200.0, 500.0, 1000.0)  # Pa
REST_PART = 0.05  # of settling, at its end: what is measured at rest
APART = {
    "seed",
    "repeat",
    "title",
    "path",
    "notes",
    "resolved",
    "record",
    "from",
    "volume_fraction_achieved",
}
NAMED = {"settle": "settled", "pour": "settled", "pull": "pulled", "shear": "sheared"}
ENDED = re.compile(r"stage '.*' ended at time ([-+.\deE]+)")


def branches(folder: Path) -> list[Rows]:
    """Rows of every stage that has ended."""
    table = np.genfromtxt(folder / "scalars.csv", delimiter=",", names=True)
    ends = [float(found[1]) for found in ENDED.finditer((folder / "log.txt").read_text())]
    marks = np.searchsorted(table["time"], [-np.inf, *(end * (1.0 + 1e-9) for end in ends)])
    names = table.dtype.names or ()
    parts = zip(marks[:-1], marks[1:], strict=True)
    return [{name: table[name][a:b] for name in names} for a, b in parts]


def at(rows: Rows, name: str, fraction: float) -> float:
    """A column where phi is this, by a line through the rows near it, or the rows next to it.

    nan if the branch does not reach it.
    """
    away = rows["volume_fraction"] - fraction
    if not len(away) or away.min() > 0.0 or away.max() < 0.0:
        return np.nan
    near = np.abs(away) < 0.5 * WINDOW
    if len(np.unique(away[near])) < 3:
        order = np.argsort(away)
        return float(np.interp(0.0, away[order], rows[name][order]))
    return float(np.polyfit(away[near], rows[name][near], 1)[1])


def at_pressure(rows: Rows, name: str, pressure: float) -> float:
    """A column where the pressure first passes a value (Pa), up or down; nan if it does not.

    Of means over windows of phi, a line between the two windows about it: beds swing.
    """
    window = np.round(rows["volume_fraction"] / WINDOW)
    if not len(window):
        return np.nan
    cut = np.flatnonzero(np.diff(window)) + 1
    high, value = (
        np.array([part.mean() for part in np.split(rows[key], cut)])
        for key in ("pressure_high", name)
    )
    above = high >= pressure
    passed = np.flatnonzero(above != above[0])
    if not len(passed):
        return np.nan
    after = passed[0]
    part = (pressure - high[after - 1]) / (high[after] - high[after - 1])
    return float(value[after - 1] + part * (value[after] - value[after - 1]))


def exponent(rows: Rows) -> float:
    """d log P / d log phi over the last decade of P of a loading."""
    phi, high = rows["volume_fraction"], rows["pressure_high"]
    low = at_pressure(rows, "volume_fraction", 0.1 * high.max())
    part = (phi > low) & (high > 0.0)
    if part.sum() < 3:
        return np.nan
    return float(np.polyfit(np.log(phi[part]), np.log(high[part]), 1)[0])


def pressed(parts: list[Rows], settles: bool) -> dict[str, float]:
    """Of a bed that settled, or of none, and was pressed and let go."""
    found: dict[str, float] = {}
    loads = parts[settles::2]
    unloads = parts[settles + 1 :: 2]
    if settles:
        rest = parts[0]
        late = rest["time"] > rest["time"][-1] * (1.0 - REST_PART)
        found["P low at rest, Pa"] = float(rest["pressure_low"][late].mean())
        found["Z at rest"] = float(rest["coordination_number"][late].mean())
        found |= _inclination(rest, "at rest")
    if not loads:
        return found
    first = loads[0]
    for fraction in FRACTIONS:
        found[f"P {fraction:.2f}, kPa"] = 1e-3 * at(first, "pressure_high", fraction)
        found[f"P low {fraction:.2f}, kPa"] = 1e-3 * at(first, "pressure_low", fraction)
        found[f"Z {fraction:.2f}"] = at(first, "coordination_number", fraction)
        found[f"F {fraction:.2f}, mN"] = 1e3 * at(first, "contact_force_mean", fraction)
        if "contact_force_pair_mean" in first:
            pair = at(first, "contact_force_pair_mean", fraction)
            found[f"F pair {fraction:.2f}, mN"] = 1e3 * pair
    found["exponent, last decade of P"] = exponent(first)
    for pressure in PRESSURES:
        name = f"phi at {1e-3 * pressure:g} kPa"
        found[f"{name}, cycle 1"] = at_pressure(first, "volume_fraction", pressure)
    shifts = [at_pressure(rows, "volume_fraction", 1e3) for rows in loads]
    for cycle in range(1, len(loads)):
        name = f"shift of cycle {cycle + 1} from {cycle} at 1 kPa"
        found[name] = shifts[cycle] - shifts[cycle - 1]
    found["Z at 1 kPa"] = at_pressure(first, "coordination_number", 1e3)
    if unloads:
        back = unloads[0]
        found["P 0.35 unloading, kPa"] = 1e-3 * at(back, "pressure_high", 0.35)
        found["Z 0.35 unloading"] = at(back, "coordination_number", 0.35)
        found["Z at 1 kPa, unloading"] = at_pressure(back, "coordination_number", 1e3)
        found |= _inclination(back, "after cycle 1")
    if len(loads) > 1:
        found["P 0.40, cycle 2, kPa"] = 1e-3 * at(loads[1], "pressure_high", 0.40)
    return found


def _inclination(rows: Rows, when: str) -> dict[str, float]:
    """Mean, and the middle of the fullest bin (degrees), of the last row."""
    if "inclination_mean" not in rows:
        return {}
    shares = {name: rows[name][-1] for name in rows if re.fullmatch(r"inclination_\d\d_\d\d", name)}
    fullest = max(shares, key=lambda name: float(shares[name]))
    mode = float(np.mean([int(edge) for edge in fullest.split("_")[1:]]))
    return {f"inclination {when}": float(rows["inclination_mean"][-1]), f"mode {when}": mode}


def drawn(parts: list[Rows], result: dict[str, float]) -> dict[str, float]:
    """Of a bed that was pulled or sheared."""
    rows = parts[-1]
    strain = rows["grip_strain"]
    if "yield_stress_xz" in result:
        late = strain > 0.5 * strain[-1]
        return {
            "yield shear, kPa": 1e-3 * result["yield_stress_xz"],
            "its deviation, kPa": 1e-3 * result["standard_deviation"],
            "Z, second half": float(rows["coordination_number"][late].mean()),
        }
    peak, where = result["yield_stress_zz"], result["yield_strain"]
    after = float(np.interp(2.0 * where, strain, rows["stress_zz"]))
    return {
        "yield tension, kPa": 1e-3 * peak,
        "its strain": where,
        "stress at twice that strain over peak": after / peak,
        "stress at the end, kPa": 1e-3 * float(rows["stress_zz"][-1]),
    }


def finished(folder: Path) -> bool:
    """Whether a run has reached the end of its last stage."""
    file = folder / "summary.json"
    return file.exists() and json.loads(file.read_text()).get("outcome") == "finished"


def figures(folder: Path) -> dict[str, float]:
    """Quantities of one run that has ended."""
    parts = branches(folder)
    stages = json.loads((folder / "summary.json").read_text()).get("stages", [])
    drew = [row for row in stages if any(key.startswith("yield") for key in row)]
    scene = json.loads((folder / "scene.json").read_text())
    if drew:
        return measures(scene) | drawn(parts, drew[-1])
    return pressed(parts, scene["stage"][0]["kind"] in ("settle", "pour"))


def measures(scene: Setting) -> dict[str, float]:
    """L_s / d, D_F / L_c and kappa (1/m; of straight and S fibers) of a bed between grips."""
    fiber, stage = scene["fibers"][0], scene["stage"][-1]
    length, diameter = fiber["centerline_length"], fiber["diameter"]
    shape = Shape(**fiber["shape"])
    found = {
        "L_s / d": (stage["freeze_above"] - stage["freeze_below"]) / diameter,
        "D_F / L_c": feret_diameter(rest_nodes(shape, length, fiber["segments"], diameter))
        / length,
    }
    if shape.kind in ("straight", "s"):
        found["kappa, 1/m"] = shape.curvature or 0.0
    return found


def settings(scene: Setting, path: str = "") -> dict[str, str]:
    """What one scene asks, by key, without its seed and what follows from other keys."""
    found: dict[str, str] = {}
    rows = scene.items() if isinstance(scene, dict) else enumerate(scene)
    for key, value in rows:
        if key in APART or (key == "end_time" and "end_strain" in scene):
            continue
        name = f"{path}.{key}" if path else str(key)
        if key == "shape":
            found[name] = " ".join(_text(part) for part in value.values() if part is not None)
        elif isinstance(value, (dict, list)):
            found |= settings(value, name)
        else:
            found[name] = _text(value)
    return found


def _text(value: Setting) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def columns(asked: Sequence[dict[str, str]]) -> list[str]:
    """Heads that name what scenes differ by: last word of a key and value, of a shape its value."""
    keys = sorted(
        dict.fromkeys(key for one in asked for key in one), key=lambda key: ".shape" not in key
    )
    differing = [key for key in keys if len({one.get(key) for one in asked}) > 1]
    heads = []
    for one in asked:
        words = [_word(key, one.get(key, "none")) for key in differing]
        heads.append(", ".join(dict.fromkeys(words)))
    return heads


def _word(key: str, value: str) -> str:
    last = [part for part in key.split(".") if not part.isdigit()][-1]
    return value if last == "shape" else f"{last} {value}"


def summed(runs: Sequence[dict[str, float]]) -> dict[str, tuple[float, float, int]]:
    """Mean, standard deviation of one run (nan of a single one) and number of runs."""
    found = {}
    for name in dict.fromkeys(name for run in runs for name in run):
        values = np.array([run.get(name, np.nan) for run in runs])
        values = values[np.isfinite(values)]
        mean = float(values.mean()) if len(values) else np.nan
        spread = float(values.std(ddof=1)) if len(values) > 1 else np.nan
        found[name] = mean, spread, len(values)
    return found


def table(runs: Sequence[tuple[dict[str, str], dict[str, float]]]) -> list[str]:
    """Lines of a Markdown table: a row per quantity, a column per scene."""
    groups: dict[str, list[tuple[dict[str, str], dict[str, float]]]] = {}
    for asked, found in runs:
        groups.setdefault(json.dumps(asked, sort_keys=True), []).append((asked, found))
    heads = columns([group[0][0] for group in groups.values()])
    sums = [summed([found for _, found in group]) for group in groups.values()]
    counts = [len(group) for group in groups.values()]
    named = [f"{head} ({n})" if head else f"({n})" for head, n in zip(heads, counts, strict=True)]
    lines = ["| quantity | " + " | ".join(named) + " |", "|---" * (len(named) + 1) + "|"]
    for name in dict.fromkeys(name for one in sums for name in one):
        pairs = zip(sums, counts, strict=True)
        cells = [_shown(one.get(name, (np.nan, np.nan, 0)), n) for one, n in pairs]
        if any(cell != "-" for cell in cells):
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def _shown(value: tuple[float, float, int], runs: int) -> str:
    mean, spread, count = value
    if count == 0:
        return "-"
    text = f"{mean:.4g}" + (f" ± {spread:.2g}" if spread > 0.0 else "")
    return text if count == runs else f"{text} ({count})"


def ranks(values: np.ndarray) -> np.ndarray:
    """Ranks from 0 of values (n,), equal ones at the mean of theirs."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - 0.5 * (count + 1))[place])


def trends(runs: Sequence[dict[str, float]]) -> list[str]:
    """Lines with the rank correlation of the yield stress with each measure, the others held.

    Kappa and D_F at one L_s, L_s at one D_F; three values of a measure make a trend.
    """
    lines = []
    for name, held in (
        ("kappa, 1/m", "L_s / d"),
        ("D_F / L_c", "L_s / d"),
        ("L_s / d", "D_F / L_c"),
    ):
        for value in sorted({round(run[held], 3) for run in runs}):
            part = [run for run in runs if round(run[held], 3) == value and name in run]
            measure = np.array([run[name] for run in part])
            if len(np.unique(measure)) < 3:
                continue
            stress = np.array([next(run[key] for key in run if "yield" in key) for run in part])
            rank = float(np.corrcoef(ranks(measure), ranks(stress))[0, 1])
            low, high = (stress[measure == end].mean() for end in (measure.min(), measure.max()))
            lines.append(
                f"yield stress against {name} at {held} = {value:g}: Spearman {rank:.2f} over "
                f"{len(part)} runs; from {low:.3g} at {measure.min():.3g} to {high:.3g} kPa at "
                f"{measure.max():.3g}"
            )
    return lines


def points(runs: Sequence[dict[str, float]]) -> dict[float, list[tuple[float, float, float]]]:
    """By L_s / d: D_F / L_c, mean yield stress and its deviation (kPa; 0 of one run)."""
    found: dict[float, list[tuple[float, float, float]]] = {}
    for height, feret in sorted({(round(r["L_s / d"], 1), round(r["D_F / L_c"], 4)) for r in runs}):
        same = [
            run
            for run in runs
            if (round(run["L_s / d"], 1), round(run["D_F / L_c"], 4)) == (height, feret)
        ]
        stress = [next(run[key] for key in run if "yield" in key) for run in same]
        spread = float(np.std(stress, ddof=1)) if len(stress) > 1 else 0.0
        found.setdefault(height, []).append((feret, float(np.mean(stress)), spread))
    return found


def picture(kinds: dict[str, list[dict[str, float]]], file: Path) -> None:
    """Yield stress over D_F / L_c, an axes for each kind of test."""
    from matplotlib.figure import Figure

    from warpfiber.output.axes_style import GRAY, plain_axes

    figure = Figure(figsize=(4.2 * len(kinds), 3.2), layout="constrained")
    boxes = figure.subplots(1, len(kinds), squeeze=False)[0]
    for axes, (kind, runs) in zip(boxes, kinds.items(), strict=True):
        for height, rows in points(runs).items():
            feret, stress, spread = np.array(rows).T
            axes.errorbar(feret, stress, spread, marker="o", ms=4, capsize=3, lw=1,
                          label=f"$L_s / d$ = {height:g}")  # fmt: skip
        plain_axes(axes)
        axes.set_ylim(bottom=0.0)
        axes.set_title(kind, loc="left", fontsize=11)
        axes.set_xlabel("maximum Feret diameter / centerline", color=GRAY)
        axes.set_ylabel("yield stress (kPa)", color=GRAY)
        axes.legend(frameon=False, labelcolor=GRAY)
    figure.savefig(file, dpi=110)


def main(words: Sequence[str]) -> None:
    """Print the tables; draw the picture that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, help="of runs")
    parser.add_argument("--picture", type=Path, help="PNG of yield stresses over D_F / L_c")
    asked = parser.parse_args(words)
    kinds: dict[str, list[tuple[dict[str, str], dict[str, float]]]] = {}
    for folder in filter(Path.is_dir, asked.folders):
        if not finished(folder):
            print(f"{folder}: has not run to its end; left out", file=sys.stderr)
            continue
        scene = json.loads((folder / "scene.json").read_text())
        kind = NAMED.get(scene["stage"][-1]["kind"], "pressed")
        kinds.setdefault(kind, []).append((settings(scene), figures(folder)))
    drew = {}
    for kind, runs in kinds.items():
        print(f"\n{kind}\n")
        print("\n".join(table(runs)))
        if kind in ("pulled", "sheared"):
            drew[kind] = [found for _, found in runs]
            print("\n".join(["", *trends(drew[kind])]))
    if asked.picture is not None and drew:
        picture(drew, asked.picture)


if __name__ == "__main__":
    main(sys.argv[1:])
