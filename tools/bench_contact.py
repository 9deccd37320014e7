"""Benchmark rows of implicit contact: overlaps, A_xx and time, beside explicit steps.

Parts, all unless named: `cell` rods and chains of three segments in one start of a sheared cell
(r_f = 20, V_f = 0.1, all axes periodic), steps of 0.05 with one and two linearizations, with and
without lubrication, against steps of 0.005, and the scatter over --seeds starts; `ratio` time of
bead_chain at 0.9 of its stable step over theirs, from the same start; `flexible` the same for
chains of 5 segments, r_f = 21, 70 GPa, steps of 0.1; `table` cells of 200 fibers beside
reference values of a prototype (float64, other random starts).
--cell-fibers N sets the size of the cell (1000), --strain its end (60): means and overlaps are over
the second half, from samples at every 0.05. Seconds are those of stepping alone, CPU seconds those
of all threads. Explicit steps are timed from the start to the strain --explicit (the end, unless
given); the ratio is that of both to this strain, beside it that of WINDOWS. A cell from the start
on is not the same all the time: fibers turn together, and there are two to three times as many
contacts and pairs when they are across the flow as when they lie along it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from machine import SCENES

import warpfiber as wf

SAMPLE = 0.05
WINDOWS = ((0.0, 2.0), (28.0, 30.0), (58.0, 60.0))  # strain
EXPLICIT = 0.9  # of the stable step
Common = Callable[[wf.Simulation], dict[str, Any]]
Keys = dict[str, Any]

# V_f: (strain step, linearizations): A_xx over strain 30-60, largest and mean overlap (radii).
RODS = {
    0.056: {
        (0.02, 1): (0.806, 3e-3, 1e-4),
        (0.05, 1): (0.812, 0.017, 6e-4),
        (0.1, 1): (0.812, 0.074, 2e-3),
        (0.1, 2): (0.815, 0.013, None),
        (0.2, 1): (0.808, 1.1, 0.014),
    },
    0.1: {
        (0.02, 1): (0.859, 3e-3, 9e-5),
        (0.05, 1): (0.860, 0.024, 6e-4),
        (0.1, 1): (0.858, 0.39, 2e-3),
        (0.1, 2): (0.858, 0.011, None),
        (0.2, 1): (0.846, 1.2, 0.010),
    },
}
RODS_LUBRICATED = {0.056: {(0.05, 1): (0.801, 0.015, 7e-4)}}
SCATTER = {0.056: (0.805, 0.827), 0.1: (0.836, 0.858)}
# E / (eta rate): strain step: A_xx, largest overlap. Over which strains is not told; 20-40 agrees.
CHAIN_PART = 2.0 / 3.0  # of --strain
CHAINS = {
    1e4: {0.1: (0.9235, 0.08), 0.05: (0.9232, 0.06), 0.02: (0.9229, 0.02)},
    7e6: {0.1: (0.9293, 0.005), 0.05: (0.9309, 0.0016), 0.02: (0.9314, 0.0013)},
}
STRESS = 1e4  # Pa, eta rate of the scene


def contact_rows(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """The parts asked for, each with the start that its rows share."""
    parts = {"cell": _cell, "ratio": _ratio, "flexible": _flexible, "table": _table}
    for name in args.names or parts:
        for row in parts[name](args, common):
            yield row | {"bench": f"contact {name}"}


def _periodic(fibers: int, ratio: float, fraction: float, **keys: Any) -> Keys:
    """Overrides of shear_cell.toml: a cube with this many fibers."""
    edge = (2.0 * np.pi * 5e-6**3 * ratio * fibers / fraction) ** (1 / 3)
    return {
        "box.size": [edge] * 3,
        "box.boundary": ["periodic"] * 3,
        "fibers.0.aspect_ratio": ratio,
        "fibers.0.count": fibers,
        "contact.lubrication": "none",
        "record.quantities": ["orientation", "contacts", "overlap"],
    } | keys


def _method(name: str, step: float, linearizations: int = 1, segments: int = 3) -> Keys:
    shape = {} if name == "rigid_rod" else {"numerics.segments": segments}
    return shape | {
        "numerics.method": name,
        "numerics.strain_step": step,
        "numerics.linearizations": linearizations,
    }


def _explicit(segments: int = 3) -> Keys:
    return {
        "numerics.method": "bead_chain",
        "numerics.segments": segments,
        "numerics.dt_fraction": EXPLICIT,
    }


def _load(keys: Keys) -> wf.Scene:
    given = dict(keys)
    if given["numerics.method"] == "rigid_rod":
        given["numerics.segments"] = 1
    return wf.load_scene(SCENES / "shear_cell.toml", given)


class Clock:
    """Seconds, and CPU seconds, that a simulation takes to every strain that it is run to."""

    def __init__(self, simulation: wf.Simulation) -> None:
        self.simulation = simulation
        self.strain, self.taken = [0.0], [np.zeros(2)]

    def run(self, until: float) -> None:
        """Step to this strain."""
        begin = np.asarray([time.perf_counter(), time.process_time()])
        self.simulation.run(until=until)
        end = np.asarray([time.perf_counter(), time.process_time()])
        self.strain.append(self.simulation.strain)
        self.taken.append(self.taken[-1] + end - begin)

    def per_strain(self, first: float, last: float) -> list[float]:
        """Seconds and CPU seconds per strain between two of them; nothing if it was not there."""
        if last > self.strain[-1] + 1e-6:
            return []
        parts = np.asarray(self.taken)
        ends = [[np.interp(x, self.strain, part) for part in parts.T] for x in (first, last)]
        return [round(float(b - a) / (last - first), 5) for a, b in zip(*ends, strict=True)]

    def told(self, end: float) -> dict[str, list[float]]:
        """To the strain `end`, and over every window."""
        windows = {f"{a:g}-{b:g}": self.per_strain(a, b) for a, b in WINDOWS}
        return {f"0-{end:g}": self.per_strain(0.0, end)} | windows


def _run(keys: Keys, args: argparse.Namespace, common: Common, part: float = 1.0) -> dict[str, Any]:
    """One run to a part of args.strain: time of steps; means and overlaps of its second half."""
    end = part * args.strain
    scene = _load(keys)
    simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
    simulation.prepare()
    clock, rows = Clock(simulation), []
    half = 0.5 * end
    marks = [*np.arange(1.0, half, 1.0), *np.arange(half, end + 1e-9, SAMPLE)]
    failure = None
    for mark in marks:
        try:
            clock.run(float(mark))
        except wf.Diverged as found:
            failure = str(found)
            break
        if mark >= half:
            rows.append(simulation.measure())
    if not rows:
        rows.append(simulation.measure())
    touching = sum(row["contacts_per_fiber"] for row in rows)
    overlap = sum(row["contacts_per_fiber"] * row["overlap_mean"] for row in rows)
    report = simulation.method.step_report()
    found = common(simulation) | {
        "seed": scene.seed,
        "fibers": simulation.model.fiber_count,
        "volume_fraction": round(scene.fibers[0].volume_fraction_achieved, 4),
        "lubrication": scene.contact.lubrication,
        "strain_step": scene.numerics.strain_step,
        "linearizations": scene.numerics.linearizations,
        "strain": end,
        "steps": simulation.step_count,
        "rejected_steps": report["rejected_steps"],
        "rows_end": report["rows"],
        "updates_end": report["updates"],
        "seconds": round(float(clock.taken[-1][0]), 2),
        "cpu_seconds": round(float(clock.taken[-1][1]), 2),
        "seconds_per_strain": clock.told(_explicit_end(args)),
        "a11": round(float(np.mean([row["a11"] for row in rows])), 5),
        "overlap_max": float(max(row["overlap_max"] for row in rows)),
        "overlap_mean": float(overlap / max(touching, 1e-300)),
    }
    simulation.close()
    return (
        found
        if failure is None
        else found | {"diverged": failure, "strain": round(simulation.strain, 3)}
    )


def _against(row: dict[str, Any], exact: float) -> dict[str, Any]:
    return row | {
        "error": round(row["a11"] - exact, 5),
        "error_kind": "A_xx, mean over the second half, less that of steps of 0.005",
    }


def _cell(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """Overlap and A_xx at steps of 0.05 against steps of 0.005; then other starts."""
    cell = _periodic(args.cell_fibers, 20, 0.1)
    for name in ("rigid_rod", "overdamped"):
        for lubrication in ("none", "paper"):
            keys = cell | {"contact.lubrication": lubrication}
            exact = _run(keys | _method(name, 0.005), args, common)
            yield _against(exact, exact["a11"])
            for linearizations in (1, 2):
                row = _run(keys | _method(name, 0.05, linearizations), args, common)
                yield _against(row, exact["a11"])
    for name in ("rigid_rod", "overdamped"):
        found = []
        for seed in range(1, args.seeds + 1):
            row = _run(cell | _method(name, 0.05) | {"seed": seed}, args, common)
            found.append(row["a11"])
        yield row | {
            "seeds": args.seeds,
            "a11_by_seed": found,
            "a11": round(float(np.mean(found)), 5),
            "error": round(max(found) - min(found), 5),
            "error_kind": "range of A_xx over the starts",
        }


def _ratio(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """Time per strain of explicit steps over that of implicit ones, same start."""
    cell = _periodic(args.cell_fibers, 20, 0.1)
    lubricated = {"contact.lubrication": "paper"}
    published = lubricated | {"numerics.lubrication_step": "explicit"}
    for implicit, explicit in (({}, {}), (lubricated, lubricated), (lubricated, published)):
        timed = _explicit_time(cell | explicit | _explicit(), args, common)
        for name in ("rigid_rod", "overdamped"):
            yield _compare(_run(cell | implicit | _method(name, 0.05), args, common), timed)


def _flexible(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """Chains of 5 segments at 70 GPa."""
    cell = _periodic(args.cell_fibers, 21, 0.1, **{"fibers.0.youngs_modulus": 7e6 * STRESS})
    timed = _explicit_time(cell | _explicit(5), args, common)
    yield _compare(_run(cell | _method("overdamped", 0.1, segments=5), args, common), timed)


def _explicit_end(args: argparse.Namespace) -> float:
    """Strain to which explicit steps are timed."""
    return float(args.strain if args.explicit is None else min(args.explicit, args.strain))


def _explicit_time(keys: Keys, args: argparse.Namespace, common: Common) -> dict[str, Any]:
    """Seconds per strain of bead_chain from the start; its largest overlap at ends of samples."""
    simulation = wf.Simulation(_load(keys), device=args.device, workers=args.workers)
    simulation.prepare()
    clock, end, overlap = Clock(simulation), _explicit_end(args), 0.0
    for mark in [*np.arange(1.0, end, 1.0), end]:
        clock.run(float(mark))
        overlap = max(overlap, simulation.measure()["overlap_max"])
    found = {
        "of": "bead_chain",
        "strain_step": simulation.dt * simulation.scene.flow.rate,
        "dt_over_limit": round(simulation.dt / simulation.limits[0].dt, 4),
        "lubrication_step": simulation.scene.numerics.lubrication_step,
        "timed_strain": round(simulation.strain, 3),
        "seconds_per_strain": clock.told(end),
        "overlap_max": overlap,
    }
    simulation.close()
    return found


def _compare(row: dict[str, Any], explicit: dict[str, Any]) -> dict[str, Any]:
    slow, fast = explicit["seconds_per_strain"], row["seconds_per_strain"]
    ratios = {
        window: [round(a / b, 2) for a, b in zip(slow[window], fast[window], strict=False)]
        for window in slow
    }
    whole = next(iter(slow))
    return row | {
        "explicit": explicit,
        "ratio_kind": f"seconds, CPU seconds of explicit steps over these, strain {whole}",
        "ratio": ratios.pop(whole),
        "ratio_of_windows": ratios,
        "error": row["overlap_max"],
        "error_kind": "largest overlap, radii",
    }


def _table(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """Cells of 200 fibers beside the reference values."""
    for lubrication, table in (("none", RODS), ("paper", RODS_LUBRICATED)):
        for fraction, cases in table.items():
            cell = _periodic(200, 20, fraction, **{"contact.lubrication": lubrication})
            for (step, linearizations), expected in cases.items():
                row = _run(cell | _method("rigid_rod", step, linearizations), args, common)
                yield _beside(row, expected) | {"expected_scatter": SCATTER[fraction]}
    for modulus, by_step in CHAINS.items():
        cell = _periodic(200, 21, 0.1, **{"fibers.0.youngs_modulus": modulus * STRESS})
        for step, expected in by_step.items():
            keys = cell | _method("overdamped", step, segments=5)
            row = _run(keys, args, common, CHAIN_PART)
            yield _beside(row, expected) | {"youngs_modulus": modulus * STRESS}


def _beside(row: dict[str, Any], expected: tuple[float | None, ...]) -> dict[str, Any]:
    names = ("a11", "overlap_max", "overlap_mean")
    return row | {
        "expected": dict(zip(names, expected, strict=False)),
        "error": round(row["a11"] - expected[0], 5),
        "error_kind": "A_xx less that of the prototype, which has other starts",
    }
