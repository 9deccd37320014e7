"""What pressed, pulled and sheared beds show, over seeds: `tools/bed_table.py FOLDER ...`.

Folders are runs that differ by their seed; of every quantity the mean over them is printed, with
the standard deviation of one run, and `-` where no run has it.
Symbols: P pressure on the upper wall (`low`: on the lower), phi volume fraction, Z touching fibers
    per fiber, F mean contact force; a number after a name is phi. Branches of the cycles are the
    stages: settling, then loading and unloading in turn.
Source: the quantities are those of Xu, Ma & Guo 2023, Figs. 7 to 17.
Limits: values at a fraction are of lines through a window of 0.005 around it.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

Rows = dict[str, np.ndarray]
WINDOW = 0.005  # of phi
FRACTIONS = (0.30, 0.35, 0.40)
REST_PART = 0.05  # of settling, at its end: what is measured at rest
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


def fraction_at(rows: Rows, pressure: float) -> float:
    """phi at which loading first reaches a pressure (Pa); nan if it does not."""
    reached = rows["pressure_high"] >= pressure
    return float(rows["volume_fraction"][np.argmax(reached)]) if reached.any() else np.nan


def exponent(rows: Rows) -> float:
    """d log P / d log phi of loading, from the first to the last of FRACTIONS."""
    phi = rows["volume_fraction"]
    part = (phi > FRACTIONS[0]) & (phi < FRACTIONS[-1]) & (rows["pressure_high"] > 0.0)
    if part.sum() < 3:
        return np.nan
    logs = np.log(phi[part]), np.log(rows["pressure_high"][part])
    return float(np.polyfit(*logs, 1)[0])


def pressed(parts: list[Rows]) -> dict[str, float]:
    """Of a bed that settled, or of none, and was pressed and let go."""
    found: dict[str, float] = {}
    settles = np.isnan(at(parts[0], "pressure_high", FRACTIONS[0])) and len(parts) > 1
    loads = parts[settles::2]
    unloads = parts[settles + 1 :: 2]
    if settles:
        rest = parts[0]
        late = rest["time"] > rest["time"][-1] * (1.0 - REST_PART)
        found["P low at rest, Pa"] = float(rest["pressure_low"][late].mean())
        found |= _inclination(rest, "at rest")
    first = loads[0]
    for fraction in FRACTIONS:
        found[f"P {fraction:.2f}, kPa"] = 1e-3 * at(first, "pressure_high", fraction)
        found[f"P low {fraction:.2f}, kPa"] = 1e-3 * at(first, "pressure_low", fraction)
        found[f"Z {fraction:.2f}"] = at(first, "coordination_number", fraction)
        found[f"F {fraction:.2f}, mN"] = 1e3 * at(first, "contact_force_mean", fraction)
    found["exponent"] = exponent(first)
    for cycle, rows in enumerate(loads, 1):
        found[f"phi at 1 kPa, cycle {cycle}"] = fraction_at(rows, 1e3)
    if unloads:
        back = unloads[0]
        found["P 0.35 unloading, kPa"] = 1e-3 * at(back, "pressure_high", 0.35)
        found["Z 0.35 unloading"] = at(back, "coordination_number", 0.35)
        found |= _inclination(back, "after cycle 1")
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


def figures(folder: Path) -> dict[str, float]:
    """Quantities of one run."""
    parts = branches(folder)
    stages = json.loads((folder / "summary.json").read_text()).get("stages", [])
    drew = [row for row in stages if any(key.startswith("yield") for key in row)]
    return drawn(parts, drew[-1]) if drew else pressed(parts)


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


def main(folders: Sequence[str]) -> None:
    """Print the table."""
    if not folders:
        raise SystemExit(__doc__)
    table = summed([figures(Path(folder)) for folder in folders])
    for name, (mean, spread, count) in table.items():
        shown = "-" if count == 0 else f"{mean:.4g}"
        shown += f" ± {spread:.2g}" if count > 1 else ""
        print(f"{name:40} {shown}  ({count})")


if __name__ == "__main__":
    main(sys.argv[1:])
