"""Benchmark rows of implicit contact: overlaps, A_xx and time, beside explicit steps.

Parts, all unless named: `cell` rods and chains of three segments in one start of a sheared cell
(r_f = 20, V_f = 0.1, all axes periodic), steps of 0.05 with one and two linearizations, with and
without lubrication, against steps of 0.005, and the scatter over --seeds starts; `ratio` time of
bead_chain at 0.9 of its stable step over theirs, from the same start; `flexible` the same for
chains of 5 segments, r_f = 21, 70 GPa, steps of 0.1; `table` cells of 200 fibers beside
reference values of a prototype (float64, other random starts).
--cell-fibers N sets the size of the cell (1000), --strain its end (60): means and overlaps are over
the second half, from samples at every 0.05. Seconds are those of stepping alone, CPU seconds those
of all threads. Explicit steps are timed over --explicit units of strain from the start, because all
of them would take hours; the ratio is of seconds per strain.
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


def _run(keys: Keys, args: argparse.Namespace, common: Common, part: float = 1.0) -> dict[str, Any]:
    """One run to a part of args.strain: time of steps; means and overlaps of its second half."""
    end = part * args.strain
    scene = _load(keys)
    simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
    simulation.prepare()
    wall, cpu, rows, first = 0.0, 0.0, [], (0.0, 0.0)
    half = 0.5 * end
    marks = [*np.arange(1.0, half, 1.0), *np.arange(half, end + 1e-9, SAMPLE)]
    failure = None
    for mark in marks:
        begin, before = time.perf_counter(), time.process_time()
        try:
            simulation.run(until=float(mark))
        except wf.Diverged as found:
            failure = str(found)
            break
        wall += time.perf_counter() - begin
        cpu += time.process_time() - before
        if mark >= half:
            rows.append(simulation.measure())
        if mark <= args.explicit + 1e-9:
            first = wall / simulation.strain, cpu / simulation.strain
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
        "seconds": round(wall, 2),
        "cpu_seconds": round(cpu, 2),
        "seconds_per_strain_of_part": [round(value, 4) for value in first],
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


def _explicit_time(keys: Keys, args: argparse.Namespace, common: Common) -> dict[str, Any]:
    """Seconds per strain of bead_chain from the start; its overlap at the end of the part."""
    simulation = wf.Simulation(_load(keys), device=args.device, workers=args.workers)
    simulation.prepare()
    begin, cpu = time.perf_counter(), time.process_time()
    simulation.run(until=args.explicit)
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    strain, row = simulation.strain, simulation.measure()
    found = {
        "of": "bead_chain",
        "strain_step": simulation.dt * simulation.scene.flow.rate,
        "dt_over_limit": round(simulation.dt / simulation.limits[0].dt, 4),
        "lubrication_step": simulation.scene.numerics.lubrication_step,
        "timed_strain": round(strain, 3),
        "seconds_per_strain": [round(wall / strain, 4), round(cpu / strain, 4)],
        "overlap_max": row["overlap_max"],
    }
    simulation.close()
    return found


def _compare(row: dict[str, Any], explicit: dict[str, Any]) -> dict[str, Any]:
    whole = row["seconds"] / row["strain"], row["cpu_seconds"] / row["strain"]
    slow, part = explicit["seconds_per_strain"], row["seconds_per_strain_of_part"]
    return row | {
        "explicit": explicit,
        "ratio_kind": "seconds, CPU seconds per strain; explicit: of the timed part",
        "ratio": [round(a / b, 2) for a, b in zip(slow, whole, strict=True)],
        "ratio_same_part": [round(a / b, 2) for a, b in zip(slow, part, strict=True)],
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
