"""Benchmark rows of the scenes of Sasayama & Inagaki 2018: period, and cells over seeds."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from machine import SCENES

import warpfiber as wf
from warpfiber.scene.derived import jeffery_period
from warpfiber.trial import after_trial

# Scene -> segments of the reduced chain; every cell also runs as the full chain.
CELLS = {
    "rigid_rf10_vf122": 3,
    "rigid_rf10_vf201": 3,
    "shear_cell": 3,
    "flexible_rf20_vf056": 7,
    "flexible_rf30_vf037": 10,
}

Common = Callable[[wf.Simulation], dict[str, Any]]


def period_rows(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """Fig. 3: 2 t_1 of a rigid fiber, by N_seg.

    The published scheme with each closure, against its own full chain; by another --method without
    inertia, as chains and as a rod, against the exact rod.
    """
    full: float | None = None
    fewer = (33, 11, 9, 3, 1)
    cases = [("bead_chain", "paper", n) for n in (99, *fewer)]
    cases += [("bead_chain", closure, n) for closure in ("consistent", "none") for n in fewer]
    if args.method != "bead_chain":
        cases = [("overdamped", "consistent", n) for n in (99, *fewer)]
        cases.append(("rigid_rod", "consistent", 1))
    for method, closure, segments in cases:
        keys = {"method": method, "closure": closure, "segments": segments}
        overrides = {f"numerics.{key}": value for key, value in keys.items()}
        scene = wf.load_scene(SCENES / "period.toml", overrides)
        simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
        simulation.step(1)
        begin = time.perf_counter()
        value = 2.0 * half_turn(simulation) / scene.flow.rate
        seconds = time.perf_counter() - begin
        full = value if full is None else full
        exact = full if method == "bead_chain" else jeffery_period(scene, scene.fibers[0])
        steps = simulation.step_count
        yield common(simulation) | {
            "bench": "period",
            "period": value,
            "seconds": round(seconds, 3),
            "steps": steps,
            "ns_per_segment_step": round(seconds / steps / segments * 1e9, 1),
            "error": value / exact - 1.0,
            "error_kind": "relative to "
            + ("the full chain (99 segments)" if method == "bead_chain" else "a rigid rod, exact"),
        }
        simulation.close()


def half_turn(simulation: wf.Simulation, limit: float = 1000.0, every: float = 0.2) -> float:
    """Strain at which the end-to-end vector of fiber 0 passes -x, by cubic interpolation."""
    strains, angles = [0.0], [0.0]
    last = simulation.fiber_node_start[1] - 1
    while strains[-1] < limit:
        simulation.run(until=simulation.strain + every)
        nodes = simulation.node_pos
        axis = nodes[last] - nodes[0]
        angle = np.arctan2(axis[2], axis[0])
        step = (angle - angles[-1] + np.pi) % (2.0 * np.pi) - np.pi
        strains.append(simulation.strain)
        angles.append(angles[-1] + step)
        if len(angles) > 4 and angles[-3] < -np.pi:
            # inverse interpolation through the four samples around the passage
            x, y = np.array(angles[-5:-1]) + np.pi, np.array(strains[-5:-1])
            return float(np.polyval(np.polyfit(x, y - y[0], 3), 0.0) + y[0])
    raise RuntimeError("the fiber did not turn")


def suspension_rows(args: argparse.Namespace, common: Common) -> Iterator[dict[str, Any]]:
    """Cells of Figs. 6-9: A and interactions over the second half of the strain, per seed.

    By bead_chain reduced and full chains; by another --method the segments of the scene.
    """
    for name in args.names or CELLS:
        both = (CELLS[name], 0) if args.method == "bead_chain" else (CELLS[name],)
        for seed in range(1, args.seeds + 1):
            for segments in args.segments or both:
                key = "segments" if segments else "reduced_beads"
                keys = {"numerics.method": args.method, f"numerics.{key}": segments}
                overrides = {"seed": seed} | keys | dict(args.set)
                scene = after_trial(wf.load_scene(SCENES / f"{name}.toml", overrides), args.workers)
                yield suspension(scene, args, common)


def suspension(scene: wf.Scene, args: argparse.Namespace, common: Common) -> dict[str, Any]:
    """One run: means over the second half of the strain."""
    simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
    simulation.prepare()
    begin, cpu = time.perf_counter(), time.process_time()
    rows: list[dict[str, float]] = []
    for strain in np.linspace(0.0, args.strain, 301):
        simulation.run(until=float(strain))
        rows.append(simulation.measure())
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    late = rows[len(rows) // 2 :]
    mean = {k: float(np.mean([row[k] for row in late])) for k in late[0] if k != "step"}
    steps = simulation.step_count
    simulation.close()
    return common(simulation) | {
        "bench": "suspension",
        "seed": scene.seed,
        "strain": args.strain,
        "lubrication_step": scene.numerics.lubrication_step,
        "lubrication": scene.contact.lubrication,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu, 1),
        "steps": steps,
        "ns_per_segment_step": round(seconds / steps / simulation.model.segment_count * 1e9, 1),
        "a11": round(mean["a11"], 5),
        "a22": round(mean["a22"], 5),
        "a33": round(mean["a33"], 5),
        "a11_end": round(rows[-1]["a11"], 5),
        "interactions_per_fiber": round(mean["interactions_per_fiber"], 4),
        "contacts_per_fiber": round(mean["contacts_per_fiber"], 4),
        "overlap_max": round(max(row["overlap_max"] for row in rows), 4),
        "rejected_steps": simulation.method.step_report().get("rejected_steps", 0),
        "curve_strain": [round(row["strain"], 2) for row in rows[::10]],
        "curve_a11": [round(row["a11"], 4) for row in rows[::10]],
        "error": max(row.get("axial_strain_max", 0.0) for row in rows),
        "error_kind": "largest axial strain",
    }
