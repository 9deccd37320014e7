"""A settled bed of bonded fibers under a moving plate: ns per node-step of whole runs and passes.

The bed is made once per scene and kept as a checkpoint in a folder for temporary files: fibers fall
and settle with damping, then the plate presses them to the volume fraction from which all rows
start. A row is measured over steps of the run, with its list builds; contacts are counted in the
end, so a list that misses some shows.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import warpfiber as wf
from warpfiber.methods import bonded_spheres
from warpfiber.placement import Placement
from warpfiber.scene import scene_from_dict

EDGE, SPEED = 0.06, 0.1  # m, m/s
TILE = 500  # fibers that are settled; larger beds are periodic copies side by side
SETTLING = 0.5  # s
PLACED = 0.1  # volume fraction of the fibers as they are placed


def bed_tables(
    fibers: int, fraction: float, precision: str, copies: tuple[int, int] = (1, 1)
) -> dict[str, Any]:
    """Straight fibers of Xu et al. (2023), Table 2, on 60 mm x 60 mm, copied along x and y."""
    volume = fibers * 0.06283 * np.pi * 1.2e-3**2
    height = float(volume / (PLACED * EDGE * EDGE))
    plate = {"kind": "compress", "wall": "z+", "speed": SPEED, "time_limit": 10.0}
    return {
        "title": "settled bed under a plate",
        "box": {
            "size": [EDGE * copies[0], EDGE * copies[1], height],
            "boundary": ["periodic", "periodic", "wall"],
        },
        "gravity": {},
        "fibers": [
            {
                "count": fibers * copies[0] * copies[1],
                "centerline_length": 0.06283,
                "diameter": 2.4e-3,
                "density": 1340.0,
                "youngs_modulus": 7.5e5,
                "bond_damping": 0.0335,
            }
        ],
        "contact": {"friction": 1.4, "wall_friction": 0.6, "damping": 0.113},
        "stage": [
            {"kind": "settle", "damping": 8.0, "end_time": SETTLING},
            {"name": "press", **plate, "end_volume_fraction": fraction},
            {"name": "load", **plate, "end_volume_fraction": 0.42},
        ],
        "record": {"quantities": ["stress", "overlap"]},
        "numerics": {"method": "bonded_spheres", "segments": 26, "precision": precision},
    }


def settled_bed(
    tables: Mapping[str, Any], folder: Path, **options: Any
) -> tuple[wf.Simulation, float]:
    """Simulation at the start of its last stage, and the seconds until it could step."""
    begin = time.perf_counter()
    simulation = wf.Simulation(scene_from_dict(tables), **options)
    simulation.prepare()
    prepared = time.perf_counter() - begin
    stages = simulation.scene.stage_sequence
    snapshot = simulation.snapshot()
    key = json.dumps([tables, sorted(snapshot)], sort_keys=True).encode()
    file = folder / f"bed_{hashlib.sha256(key).hexdigest()[:16]}.npz"
    if not file.exists():
        for stage in stages[:-1]:
            run_stage(simulation, stage)
        folder.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(f".{os.getpid()}.npz")  # whole or not there
        np.savez(part, **simulation.snapshot())
        part.rename(file)
    with np.load(file) as arrays:
        simulation.restore(dict(arrays))
    simulation.begin_stage(stages[-1])
    return simulation, prepared


def tiled_bed(
    small: wf.Simulation, tables: Mapping[str, Any], copies: tuple[int, int], **options: Any
) -> wf.Simulation:
    """Copies of a settled bed side by side, without the memories of its contacts."""
    count, model = copies[0] * copies[1], small.model
    shifts = EDGE * np.array([[x, y, 0.0] for x in range(copies[0]) for y in range(copies[1])])
    nodes = (small.node_pos[None] + shifts[:, None]).reshape(-1, 3)
    per_fiber = np.tile(np.diff(small.fiber_node_start), count)
    starts = np.concatenate([[0], np.cumsum(per_fiber)]).astype(np.int32)
    group = np.zeros(len(per_fiber), dtype=np.int32)
    big = wf.Simulation(
        scene_from_dict(tables), placement=Placement(nodes, starts, group), dt=small.dt, **options
    )
    mine, arrays = small.snapshot(), big.snapshot()
    ratio = big.model.node_count // model.node_count
    for name, values in mine.items():
        if name.startswith(("contact_", "near_")) or name not in arrays or values.ndim == 0:
            continue
        if len(arrays[name]) == ratio * len(values) and len(values) >= model.fiber_count:
            arrays[name] = np.tile(values, (ratio,) + (1,) * (values.ndim - 1))
    for name in ("node_pos", "list_pos", "bonds_place"):
        shift = np.repeat(shifts, model.node_count, axis=0) / model.units.length
        arrays[name] = (np.tile(mine["bonds_place"], (ratio, 1)) + shift).astype(arrays[name].dtype)
    arrays["press_place"] = mine["press_place"].copy()
    arrays["press_place"][1, :2] *= copies
    for name in ("near_pos", "near_skin"):
        arrays.pop(name, None)
    for name in ("contact_acts", "contact_memory", "contact_written"):
        arrays[name] = arrays[name][:0]
    big.restore(arrays)
    return big


def copies_of(fibers: int) -> tuple[int, int]:
    """Numbers of tiles along x and y, as square as they can be."""
    tiles = max(1, round(fibers / TILE))
    along = max(n for n in range(1, int(tiles**0.5) + 1) if tiles % n == 0)
    return tiles // along, along


def run_stage(simulation: wf.Simulation, stage: Any) -> None:
    """Run a stage from now to its end."""
    start = (0.0, simulation.time)
    simulation.begin_stage(stage)
    while (steps := simulation.stage_steps(stage, start)) > 0:
        simulation.step(steps)


def dem_rows(
    args: argparse.Namespace, common: Callable[[wf.Simulation], dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """One row per precision and number of fibers."""
    folder = Path(tempfile.gettempdir()) / "warpfiber_beds"
    bonded_spheres.NATIVE = not args.plain
    for precision in args.precisions:
        for fibers in args.fibers:
            options = {"device": args.device, "workers": args.workers}
            copies = copies_of(fibers)
            tile = min(fibers, TILE)
            tables = bed_tables(tile, args.fraction, precision)
            simulation, prepared = settled_bed(tables, folder, **options)
            if copies != (1, 1):
                small, tables = simulation, bed_tables(tile, args.fraction, precision, copies)
                simulation = tiled_bed(small, tables, copies, **options)
                small.close()
                simulation.begin_stage(simulation.scene.stage_sequence[-1])
                simulation.step(200)  # contacts find their memories again
            row = common(simulation) | {"bench": "dem", "seconds_to_prepare": round(prepared, 2)}
            if args.load:
                yield row | load_time(simulation)
            else:
                yield row | step_times(simulation, args.steps, args.repeats)
            simulation.close()


def step_times(simulation: wf.Simulation, steps: int, repeats: int) -> dict[str, Any]:
    """Time per node-step of whole runs of `steps` steps, list builds apart and by pass."""
    method, nodes = simulation.method, simulation.model.node_count
    wall, processor, lists = [], [], []
    before = simulation.method.list_report()
    for _ in range(repeats):
        began = time.perf_counter(), time.process_time(), method.list_seconds
        simulation.step(steps)
        scale = 1e9 / steps / nodes
        wall.append((time.perf_counter() - began[0]) * scale)
        processor.append((time.process_time() - began[1]) * scale)
        lists.append((method.list_seconds - began[2]) * scale)
    after = simulation.method.list_report()
    builds = after["builds"] - before["builds"]
    found = state_of(simulation)
    passes = simulation.pass_times(min(200, steps))
    return {
        "nodes": nodes,
        "ns_per_node_step": round(float(np.median(wall)), 1),
        "ns_spread": [round(min(wall), 1), round(max(wall), 1)],
        "ns_processor": round(float(np.median(processor)), 1),
        "node_steps_per_second": round(1e9 / float(np.median(wall)), -4),
        "ns_list": round(float(np.mean(lists)), 1),
        "steps_per_build": round(repeats * steps / max(1, builds), 1),
        "ns_by_pass": {name: round(s * 1e9 / nodes, 2) for name, s in passes.items()},
        "vectorized": method.native is not None,
        "list": after,
        **found,
    }


def load_time(simulation: wf.Simulation) -> dict[str, Any]:
    """Seconds of the whole loading, to the volume fraction 0.42."""
    wall, processor, begun = time.perf_counter(), time.process_time(), simulation.step_count
    run_stage(simulation, simulation.scene.stage_sequence[-1])
    seconds = time.perf_counter() - wall
    steps = simulation.step_count - begun
    return {
        "seconds": round(seconds, 2),
        "processor_seconds": round(time.process_time() - processor, 2),
        "steps": steps,
        "ns_per_node_step": round(seconds / steps / simulation.model.node_count * 1e9, 1),
        "list": simulation.method.list_report(),
        **state_of(simulation),
    }


def state_of(simulation: wf.Simulation) -> dict[str, Any]:
    """What the bed does now; a fault of the list or the laws would show here."""
    row = simulation.measure()
    pairs = simulation.method.list.pair_count
    acting = int(simulation.method.contacts.acts.numpy()[:pairs].astype(bool).sum())
    speed = np.linalg.norm(simulation.node_velocity, axis=1)
    return {
        "listed_pairs_per_node": round(pairs / simulation.model.node_count, 3),
        "contacts": acting,
        "contacts_per_node": round(acting / simulation.model.node_count, 3),
        "speeds": [round(float(np.median(speed)), 4), round(float(speed.max()), 4)],
        "pressures": [row["pressure_low"], row["pressure_high"]],
        "volume_fraction": round(row["volume_fraction"], 4),
        "error": row["overlap_max"],
        "error_kind": "largest overlap, radii",
    }
