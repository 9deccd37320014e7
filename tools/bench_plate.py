"""Error against run time in the sliding-plate cell: strain step, contact tolerance, segment length.

The cell of "Direct fiber model validation: orientation evolution in simple shear flow" (4.4 x 4.4 x
2 mm, fibers of 19 um with L_N 0.83, L_W 1.53, at most 4 mm, start (.36, .62, .02)), as rods at half
its concentration, and as chains without contact (and walls) at all of it.
Parts, all unless named: `rods` strain steps, `tolerance` of the contacts of rods at a step of 0.05,
`chains` strain steps, `segments` length of the chains' segments at a step of 0.05. The last row of
a part is its finest and the reference of the others: the error is the largest difference of a11,
a22, a33, a13 in both weightings at whole strains up to --strain. Rows of `exact` are rods without
contact against the exact orientation of their own start. Seconds are CPU seconds of stepping.
--volume F takes that part of the cell's fibers (1: all), for a quick look.
`packed`, `packed_tolerance`, `packed_segments`: the same of chains in contact at all of the
concentration, in a cell of 2.2 x 2.2 x 0.3 mm with fibers half as long (977 chains). Chains of
other segments are packed otherwise. Curves are means over --seeds cells; what is left of their
scatter is in the errors.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import warpfiber as wf
from warpfiber.placement import Placement, place_fibers, split_tables
from warpfiber.placement.without_contact import direction_tensors, shape_factor
from warpfiber.scene import Scene, scene_from_dict

Common = Callable[[wf.Simulation], dict[str, Any]]
Curve = np.ndarray

FULL = 0.0793
COMPONENTS = ("a11", "a22", "a33", "a13")
INDEX = ((0, 0), (1, 1), (2, 2), (0, 2))
SMALL = (2.2e-3, 2.2e-3, 3e-4)
PACKED_STEPS = (0.05, 0.025, 0.0125)
PACKED_TOLERANCES = (4e-2, 1e-2, 2.5e-3)
PACKED_LENGTHS = (4e-4, 2e-4, 1e-4)
STEPS = (0.2, 0.1, 0.05, 0.025, 0.0125)
TOLERANCES = (1.6e-2, 4e-3, 1e-3, 2.5e-4)
SEGMENT_LENGTHS = (8e-4, 4e-4, 2e-4, 1e-4)


def plate_rows(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """The parts asked for; the finest row of a part is measured first and written last."""
    rods = {"method": "rigid_rod"}
    chains = {"method": "overdamped", "segment_length": 2e-4}
    packed = chains | {"contact_tolerance": 1e-2, "strain_step": 0.05}
    parts: dict[str, list[dict[str, Any]]] = {
        "exact": [rods | {"strain_step": step} for step in (1.0, 0.05)],
        "rods": [rods | {"strain_step": step} for step in STEPS],
        "tolerance": [rods | {"strain_step": 0.05, "contact_tolerance": t} for t in TOLERANCES],
        "chains": [chains | {"strain_step": step} for step in STEPS],
        "segments": [chains | {"strain_step": 0.05, "segment_length": s} for s in SEGMENT_LENGTHS],
        "packed": [packed | {"strain_step": step} for step in PACKED_STEPS],
        "packed_tolerance": [packed | {"contact_tolerance": t} for t in PACKED_TOLERANCES],
        "packed_segments": [packed | {"segment_length": s} for s in PACKED_LENGTHS],
    }
    for name in args.names or parts:
        small = name.startswith("packed")
        touching = small or name in ("rods", "tolerance")
        fraction = args.volume * (0.5 * FULL if touching and not small else FULL)
        reference, last = None, None
        starts: dict[int, Placement] = {}
        # one small cell differs from another by more than what is asked for
        seeds = range(1, args.seeds + 1) if small else (None,)
        for numerics in reversed(parts[name]):
            found = []
            for seed in seeds:
                settings = args.set if seed is None else [*args.set, ("seed", seed)]
                scene = plate_scene(numerics, fraction, touching, settings, small)
                start = starts.get(seed or 0)
                if start is None or name.endswith("segments"):
                    start = starts[seed or 0] = place_fibers(scene)
                found.append(_run(scene, start, args, common))
            curve, row = _mean(found)
            if name == "exact":
                reference = exact_curve(scene, start, args.strain)
            row |= {"bench": f"plate {name}", **numerics}
            if reference is None:
                reference, last = curve, row | {"error": 0.0, "error_kind": "the reference"}
                continue
            far = "exact" if name == "exact" else "the finest row"
            yield row | {
                "error": float(np.max(np.abs(curve - reference))),
                "error_kind": f"largest difference of A from {far}, both weightings",
            }
        if last is not None:
            yield last


def plate_scene(
    numerics: dict[str, Any],
    fraction: float,
    touching: bool,
    settings: list[Any],
    small: bool = False,
) -> Scene:
    """The cell with this volume fraction of fibers; `small`: a part of it, fibers half as long."""
    unit = 0.5 if small else 1.0
    # walls push by contact: without it the cell is a periodic cube with the same fibers
    height, through = (2e-3, "wall") if touching else (4.4e-3, "periodic")
    fraction *= 2e-3 / height
    size = SMALL if small else (4.4e-3, 4.4e-3, height)
    tables = {
        "title": "sliding plate",
        "box": {"size": list(size), "boundary": ["periodic", "periodic", through]},
        "flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 300.0},
        "fibers": [
            {
                "volume_fraction": fraction,
                "diameter": 19e-6,
                "youngs_modulus": 7e10,
                "inextensible": numerics["method"] == "overdamped" and not touching,
                "orientation": [0.36, 0.62, 0.02, 0.0, 0.0, 0.0],
                "length_distribution": {
                    "number_average": unit * 0.83e-3,
                    "weight_average": unit * 1.53e-3,
                    "maximum": unit * 4e-3,
                    "minimum": 5e-5,
                },
            }
        ],
        "contact": {} if touching else {"law": "none"},
        "stage": [{"kind": "flow", "end_strain": 60.0}],
        "record": {"quantities": ["orientation", *(["contacts", "overlap"] if touching else [])]},
        "numerics": numerics,
    }
    return split_tables(scene_from_dict(tables, "plate.toml", dict(settings)))


def exact_curve(scene: Scene, start: Placement, strain: float) -> Curve:
    """Components of A (marks, 2, 4) of rods without contact."""
    first = start.node_pos[start.fiber_node_start[:-1]]
    axis = start.node_pos[start.fiber_node_start[1:] - 1] - first
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    ratio = np.array([group.aspect_ratio for group in scene.fibers])[start.fiber_group]
    long = np.array([group.centerline_length for group in scene.fibers])[start.fiber_group]
    factor = shape_factor(np.sqrt(0.5 * (ratio**2 + 1.0)))
    gradient = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    rows, columns = zip(*INDEX, strict=True)
    both = [
        direction_tensors(axis, gradient, factor, weight, _marks(strain))[:, rows, columns]
        for weight in (long, np.ones(len(long)))
    ]
    return np.stack(both, axis=1)


def _marks(strain: float) -> np.ndarray:
    return np.arange(1.0, strain + 0.5)


def _mean(found: list[tuple[Curve, dict[str, Any]]]) -> tuple[Curve, dict[str, Any]]:
    """Mean curve and row of runs that differ in their seed alone, overlaps the largest."""
    curves, rows = zip(*found, strict=True)
    row = dict(rows[0])
    for key in ("seconds_cpu", "steps", "rejected_steps", "a11", "a11_fiber"):
        row[key] = round(float(np.mean([one[key] for one in rows])), 5)
    row["overlap_max"] = max(one["overlap_max"] for one in rows)
    if len(rows) > 1:
        row["seeds"] = len(rows)
    return np.mean(curves, axis=0), row


def _run(
    scene: Scene, start: Placement, args: argparse.Namespace, common: Common
) -> tuple[Curve, dict[str, Any]]:
    """Components of A at whole strains (marks, 2, 4), and the row of a run without its error."""
    simulation = wf.Simulation(scene, placement=start, device=args.device, workers=args.workers)
    simulation.prepare()
    seconds, curve, overlaps, row = 0.0, [], [], {}
    for mark in _marks(args.strain):
        begin = time.process_time()
        simulation.run(until=float(mark))
        seconds += time.process_time() - begin
        row = simulation.measure()
        curve.append([[row[f"{name}{end}"] for name in COMPONENTS] for end in ("", "_fiber")])
        overlaps.append(row.get("overlap_max", 0.0))
    told = common(simulation) | {
        "fibers": len(start.fiber_group),
        "strain": args.strain,
        "seconds_cpu": round(seconds, 3),
        "steps": simulation.step_count,
        "rejected_steps": int(simulation.method.step_report().get("rejected_steps", 0)),
        "a11": round(row["a11"], 5),
        "a11_fiber": round(row["a11_fiber"], 5),
        "overlap_max": max(overlaps),
    }
    simulation.close()
    return np.array(curve), told
