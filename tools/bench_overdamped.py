"""Benchmark rows of fibers without inertia: wall time, ns per node and solve, error against dt.

`accuracy` of bench.py adds them to its own: the flexible fiber of Fig. 5 without inertia, a cell of
such fibers that shows the cost where the launches no longer count, and the run time of bead_chain
over that of overdamped at the same error.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import warpfiber as wf
from warpfiber.placement import Placement

# x/L and z/L of the last node, SDIRK2 with three Newton iterations at dt = 0.0025 (halving it
# changes 1.2e-7 L).
TIP = {
    20: (0.49901462, -0.01589661),
    30: (0.49493013, -0.03944748),
    35: (0.4208568, -0.1278601),
    40: (-0.0624327, -0.1408430),
    45: (-0.4902699, -0.1237738),
    60: (-0.50070480, -0.02325492),
}
STEPS = (0.2, 0.1, 0.05, 0.02)
SOLVES = {"sdirk2": 2, "bdf2": 1}
CELL_FIBERS = 1000
WARM_STEPS = 20  # not timed: within them everything is captured

# z/L of the last node with the bending energy k_b theta^2/2 of bead_chain and no inertia.
ANGLE_TIP = {20: -0.0158837, 30: -0.0392774, 35: -0.12649, 40: -0.14193, 45: -0.12488}
# Young's modulus (Pa): density (kg/m3) with which inertia errs by 1e-3 of the length, and the
# strains at which the last node is looked at. Steps of bead_chain: 0.9 of its stable limit; smaller
# ones err the same.
EQUAL_ERROR = {5e8: (9e8, tuple(ANGLE_TIP)), 7e10: (1.4e9, (60, 90, 105, 110, 112, 115, 120))}
REFERENCE_STEP = 0.005

Common = Callable[[wf.Simulation], dict[str, Any]]


def overdamped_rows(
    scene_file: Path, args: argparse.Namespace, common: Common
) -> Iterator[dict[str, Any]]:
    """The fiber with both integrators at STEPS and two tolerances, then the cell."""
    for integrator in SOLVES:
        for step in STEPS:
            keys = {"numerics.integrator": integrator, "numerics.strain_step": step}
            yield _turn(scene_file, keys, args, common)
    for tolerance in (1e-3, 1e-4):
        yield _turn(scene_file, {"numerics.tolerance": tolerance}, args, common)
    for precision in args.precisions:
        for integrator in SOLVES:
            keys = {"numerics.integrator": integrator, "numerics.precision": precision}
            yield _cell(scene_file, keys, args, common)
    for modulus in EQUAL_ERROR:
        yield _ratio(scene_file, modulus, args, common)


def _scene(scene_file: Path, keys: dict[str, Any]) -> wf.Scene:
    return wf.load_scene(scene_file, {"numerics.method": "overdamped", **keys})


def _turn(
    scene_file: Path, keys: dict[str, Any], args: argparse.Namespace, common: Common
) -> dict[str, Any]:
    """One fiber to strain 60; error of the tip in fiber lengths."""
    scene = _scene(scene_file, keys)
    simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
    simulation.step(WARM_STEPS)
    length, worst, seconds = scene.fibers[0].centerline_length, 0.0, 0.0
    for strain, tip in TIP.items():
        begin = time.perf_counter()
        simulation.run(until=float(strain))
        seconds += time.perf_counter() - begin
        late = (simulation.strain - strain) / scene.flow.rate
        nodes = simulation.node_pos - late * simulation.node_velocity
        here = (nodes[-1] - nodes.mean(axis=0))[[0, 2]] / length
        worst = max(worst, float(np.abs(here - tip).max()))
    steps = simulation.step_count
    solves = (steps - WARM_STEPS) * SOLVES[scene.numerics.integrator] * simulation.model.node_count
    row = common(simulation) | {
        "bench": "accuracy",
        "integrator": scene.numerics.integrator,
        "tolerance": scene.numerics.tolerance,
        "strain_step": round(simulation.dt * scene.flow.rate, 6),
        "seconds": round(seconds, 4),
        "steps": steps,
        "ns_per_node_solve": round(seconds / solves * 1e9, 1),
        "error": worst,
        "error_kind": "tip x/L, z/L at strain 20 to 60 against steps of 0.0025 with Newton",
    }
    simulation.close()
    return row


def _cell(
    scene_file: Path, keys: dict[str, Any], args: argparse.Namespace, common: Common
) -> dict[str, Any]:
    """Many of these fibers, all alike: ns per node and solve (median), lengths as the error."""
    scene = _scene(scene_file, keys | {"fibers.0.count": CELL_FIBERS})
    group = scene.fibers[0]
    along = np.linspace(-0.5, 0.5, group.segments + 1) * group.centerline_length
    axis = np.array([1.0, 0.2, 0.3]) / np.linalg.norm([1.0, 0.2, 0.3])
    start = np.arange(CELL_FIBERS + 1, dtype=np.int32) * (group.segments + 1)
    nodes = np.tile(along[:, None] * axis, (CELL_FIBERS, 1))
    placement = Placement(nodes, start, np.zeros(CELL_FIBERS, dtype=np.int32))
    simulation = wf.Simulation(scene, device=args.device, workers=args.workers, placement=placement)
    simulation.step(20)
    times = []
    for _ in range(args.repeats):
        begin = time.perf_counter()
        simulation.step(10)
        times.append((time.perf_counter() - begin) / 10)
    per_solve = 1e9 / (simulation.model.node_count * SOLVES[scene.numerics.integrator])
    row = common(simulation) | {
        "bench": "accuracy cell",
        "integrator": scene.numerics.integrator,
        "fibers": CELL_FIBERS,
        "ns_per_node_solve": round(float(np.median(times)) * per_solve, 1),
        "ns_spread": [round(min(times) * per_solve, 1), round(max(times) * per_solve, 1)],
        "error": float(simulation.measure()["axial_strain_max"]),
        "error_kind": "largest axial strain",
    }
    simulation.close()
    return row


def _tips(simulation: wf.Simulation, strains: tuple[int, ...]) -> tuple[dict[int, float], float]:
    """z/L of the last node at the strains; seconds of all steps, the warm ones as the others."""
    flow, length = simulation.scene.flow, simulation.scene.fibers[0].centerline_length
    tips, seconds = {}, 0.0
    simulation.step(WARM_STEPS)
    for strain in strains:
        begin = time.perf_counter()
        simulation.run(until=float(strain))
        seconds += time.perf_counter() - begin
        late = (simulation.strain - strain) / flow.rate
        nodes = simulation.node_pos - late * simulation.node_velocity
        tips[strain] = float((nodes[-1] - nodes.mean(axis=0))[2] / length)
    steps = simulation.step_count
    return tips, seconds * steps / (steps - WARM_STEPS)


def _ratio(
    scene_file: Path, modulus: float, args: argparse.Namespace, common: Common
) -> dict[str, Any]:
    """Seconds of bead_chain over those of both integrators, run in turns (medians).

    Errors are against steps of REFERENCE_STEP; for bead_chain, whose bending law differs where
    joints bend far, against its own law.
    """
    density, strains = EQUAL_ERROR[modulus]
    fiber = {"fibers.0.youngs_modulus": modulus}
    explicit = {"numerics.method": "bead_chain", "numerics.dt_fraction": 0.9}
    cases = {"bead_chain": fiber | explicit | {"fibers.0.density": density}}
    implicit = fiber | {"numerics.method": "overdamped"}
    for name in SOLVES:
        cases[name] = implicit | {"numerics.integrator": name, "numerics.strain_step": STEPS[0]}

    def run(keys: dict[str, Any]) -> tuple[dict[int, float], float]:
        scene = wf.load_scene(scene_file, keys)
        simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
        found = _tips(simulation, strains)
        rows.append(common(simulation))
        simulation.close()
        return found

    rows: list[dict[str, Any]] = []
    exact, _ = run(implicit | {"numerics.strain_step": REFERENCE_STEP})
    times: dict[str, list[float]] = {name: [] for name in cases}
    errors = {}
    for _ in range(args.repeats):
        for name, keys in cases.items():
            tips, seconds = run(keys)
            own = ANGLE_TIP if name == "bead_chain" and modulus == 5e8 else exact
            times[name].append(seconds)
            errors[name] = max(abs(tips[strain] - own[strain]) for strain in strains)
    median = {name: float(np.median(values)) for name, values in times.items()}
    return rows[-1] | {
        "bench": "accuracy ratio",
        "youngs_modulus": modulus,
        "strain": strains[-1],
        "seconds": {name: round(value, 5) for name, value in median.items()},
        "seconds_least": {name: round(min(values), 5) for name, values in times.items()},
        "ratio": {name: round(median["bead_chain"] / median[name], 1) for name in SOLVES},
        "error": errors,
        "error_kind": "tip z/L against the same bending law without inertia",
    }
