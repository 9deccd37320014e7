"""Where the time of a step goes: every pass of a scene, its memory traffic, and the neighbor list.

    python tools/profile_step.py SCENE.toml [--set key=value] [--device D] [--steps N] [--warm N]
        [--workers W]

Bytes: every array that a kernel may read or write, once each, pair arrays up to the pairs in use:
what a full sweep must move at least. They are compared with a copy of as many bytes by one core
(CPU only), so that a pass far below that bandwidth is bound by arithmetic or latency, not by
memory. One above it ended before it needed its arrays (no pair was near, nothing was left to
repeat). Passes of one name count together; of a sort or a scan of Warp the bytes are not known.
Overhead: whole steps less their passes, timed apart. Times of passes are medians over steps, so
what only some steps do (second solves, long relaxations, steps taken again) is in it.
With --workers W (2 or more) also what each worker computes in a step, list builds apart, and how
long it waits for the others: mean processor time by pass, and time.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from machine import commit, copy_bandwidth, processor

import warpfiber as wf
from warpfiber.passes.executor import Call, Executor, Launch
from warpfiber.passes.worker_times import WorkerTimes, clock_address
from warpfiber.scene import parse_override

# Arguments that a kernel both reads and writes.
BOTH_WAYS = {"node_pos", "node_velocity", "node_force_out", "status"}


def bytes_moved(launch: Launch | Call, pairs: Any) -> int | None:
    """Least traffic of one launch in bytes; None where Warp itself does the work."""
    if isinstance(launch, Call):
        return None
    total = 0
    names = [argument.label for argument in launch.kernel.adj.args]
    values = [0, *launch.inputs] if launch.split else launch.inputs
    for name, value in zip(names, values, strict=True):
        if not isinstance(value, wp.array):
            continue
        size = value.size * wp.types.type_size_in_bytes(value.dtype)
        if pairs is not None and value.size in (pairs.pair_capacity, 2 * pairs.pair_capacity):
            size = size * pairs.pair_count // value.size
        total += size * (2 if name in BOTH_WAYS else 1)
    return total


def profile(args: argparse.Namespace) -> None:
    """Run, measure and print."""
    scene = wf.load_scene(args.scene, dict(args.set))
    simulation = wf.Simulation(scene, device=args.device, workers=1)
    method, count = simulation.method, simulation.model.segment_count
    simulation.step(args.warm)
    builds_before, seconds_before, pruning_before = list_state(method)
    times = simulation.pass_times(args.steps)
    stepping = float(np.median([step_time(simulation, args.steps // 16) for _ in range(16)]))
    simulation.prepare()  # a list that grew has left no launches
    steps = args.steps + args.steps // 16 * 16
    builds, seconds, pruning = list_state(method)
    builds, seconds = builds - builds_before, seconds - seconds_before
    pruning -= pruning_before
    rows: dict[str, list[Launch | Call]] = {}
    for launch in method.executor.launches:
        rows.setdefault(launch.name, []).append(launch)
    overhead = stepping - sum(times.values())
    whole = stepping + seconds / steps
    print(f"{scene.name}: {simulation.model.fiber_count} fibers, {count} segments, ", end="")
    print(f"{scene.numerics.precision}, {simulation.device}, 1 worker")
    print(f"{processor()}, warpfiber {commit()}")
    print(f"{'pass':16}{'us/step':>10}{'ns/seg':>9}{'share':>8}{'B/seg':>8}{'GB/s':>8}{'copy':>8}")
    on_cpu = simulation.device.startswith("cpu")

    def line(name: str, per_step: float) -> str:
        return (
            f"{name:16}{per_step * 1e6:10.1f}{per_step / count * 1e9:9.1f}{per_step / whole:8.1%}"
        )

    for name, launches in rows.items():
        per_step, found = times[name], [bytes_moved(launch, method.list) for launch in launches]
        known = [size for size in found if size is not None]
        if len(known) < len(found):
            print(line(name, per_step) + f"{'-':>8}" * 3)
            continue
        moved = sum(known)
        limit = copy_bandwidth(moved // 2) / 1e9 if on_cpu else float("nan")
        rate = moved / per_step / 1e9 if per_step > 0.0 else float("nan")
        print(line(name, per_step) + f"{moved / count:8.0f}{rate:8.1f}{limit:8.1f}")
    if method.list is not None:
        print(line("list", seconds / steps))
    print(line("overhead", overhead))
    print(line("step", whole))
    if method.list is not None:
        print_list(method, count, builds, seconds - pruning, steps, pruning)
    simulation.close()
    if args.workers > 1 and on_cpu:
        profile_workers(scene, args)


def profile_workers(scene: wf.Scene, args: argparse.Namespace) -> None:
    """What every one of several workers does in a step."""
    simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
    method = simulation.method
    simulation.step(args.warm)
    simulation.prepare()
    if type(method.executor) is not Executor or not clock_address():
        print("workers       joined steps, or no clock: not timed apart")
        simulation.close()
        return
    times, count = WorkerTimes(method.executor), simulation.model.segment_count
    while times.steps < args.steps and times.executor is method.executor:
        simulation.step(1)  # does what halts steps
        if times.executor is method.executor:
            times.step()
    for worker in range(args.workers):
        busy = times.busy(worker)
        parts = ", ".join(f"{name} {seconds * 1e6:.1f}" for name, seconds in busy.items())
        whole = sum(busy.values())
        print(f"worker {worker + 1:<7}{whole * 1e6:.1f} us ({parts}), ", end="")
        print(f"{whole / count * 1e9:.1f} ns/seg, waits {times.waiting(worker) * 1e6:.1f} us")
    simulation.close()


def step_time(simulation: wf.Simulation, steps: int) -> float:
    """Seconds per step, list builds apart."""
    begin, listing = time.perf_counter(), simulation.method.list_seconds
    simulation.step(steps)
    listing = simulation.method.list_seconds - listing
    return (time.perf_counter() - begin - listing) / steps


def search_of(method: Any) -> Any:
    """The pair search of any method."""
    return getattr(method, "search", None) or getattr(
        getattr(method, "contact", None) or getattr(method, "contacts", None), "search", None
    )


def list_state(method: Any) -> tuple[int, float, float]:
    """Builds so far, seconds of these and of pruning, those of pruning alone."""
    if method.list is None:
        return 0, 0.0, 0.0
    return method.list.build_count, method.list_seconds, search_of(method).prune_seconds


def acting_pairs(method: Any) -> str:
    """How many listed pairs push now, or of implicit contact how many rows it solves for."""
    contact = getattr(method, "contact", None)
    if contact is not None:
        rows = [int(rows.row_count.numpy()[0]) for rows, _ in contact.solves]
        return f"{max(rows)} contact rows"
    acts = method.saved().get("contact_acts", method.pair_acts.numpy())
    return f"{acts[: method.list.pair_count].astype(bool).sum() / method.list.pair_count:.1%} act"


def print_list(
    method: Any, count: int, builds: int, seconds: float, steps: int, pruning: float
) -> None:
    """Statistics of the neighbor list."""
    pairs, report = method.list, method.list_report()
    kept = max(1, pairs.kept_count)
    rows = {
        "builds": f"{builds} in {steps} steps",
        "per build": f"{seconds / max(builds, 1) / count * 1e9:.0f} ns per segment",
        "skin": f"{report['skin_diameters']} diameters, mean {report['skin_mean_diameters']}",
        "listed pairs": f"{pairs.pair_count / count:.3f} per segment",
        "of these": acting_pairs(method) if pairs.pair_count else "none",
        "capacity": f"{pairs.pair_capacity} pairs",
        "cells": "x".join(map(str, pairs.cells.numpy()[0])),
        "pieces": f"{pairs.piece_count / count:.2f} per segment",
    }
    if "prunes" in report:
        wide = (
            f"{pairs.kept_count / count:.3f} pairs, skin {report['wide_skin_diameters']} diameters"
        )
        rows["wide list"] = f"{wide}, pruned {report['prunes']} times beside builds since the start"
        rows["pruning"] = f"{pruning / steps / count * 1e9:.1f} ns per segment-step"
    if "compared" in report:
        rows["candidates"] = (
            f"{report['in_cells'] / kept:.1f} in cells, {report['compared'] / kept:.1f} compared, "
            f"{report['confirmed'] / kept:.2f} confirmed per kept pair"
        )
    print("\n".join(f"{name:14}{text}" for name, text in rows.items()))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--set", action="append", default=[], type=parse_override)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", type=int, default=512)
    parser.add_argument("--warm", type=int, default=200)
    parser.add_argument("--workers", type=int, default=1)
    profile(parser.parse_args())


if __name__ == "__main__":
    main()
