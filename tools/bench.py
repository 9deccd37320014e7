"""Benchmarks: time and error side by side, as JSON lines in tools/results/bench.jsonl.

    python tools/bench.py engine                  a dense cell: ns per segment-step of every pass
    python tools/bench.py beads                   1000 fibers of 20 beads: bead-steps per second
    python tools/bench.py accuracy                one flexible fiber: time and error, both methods
    python tools/bench.py period                  Fig. 3: period of a rigid fiber against N_seg
    python tools/bench.py suspensions [NAME ...]  Figs. 6-9: reduced against full chains over seeds;
                                                  these two with --method auto: as shipped
    python tools/bench.py dem                     a bed of bonded fibers under a plate: ns per
                                                  node-step (--load: seconds of a whole loading)
    python tools/bench.py contact [PART ...]      implicit contact: overlaps, A_xx, time over that
                                                  of explicit steps (parts: see bench_contact.py)
    python tools/bench.py plate [PART ...]        the sliding-plate cell: error of A against time
    options: --fibers N ..., --precisions P ..., --strain-step G, --seeds N, --strain S, --device D,
    --workers W ... (engine, beads: several alternate, with their ratio), --repeats N, --method M,
    --shuffled (engine: fibers numbered in no order),
    --dry (print, do not write)

A row has a time and an error; a run that is not finite is not timed. Times of this or that machine
compare only within one run of this tool.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from bench_contact import contact_rows
from bench_dem import dem_rows
from bench_overdamped import overdamped_rows
from bench_papers import period_rows, suspension_rows
from bench_plate import plate_rows
from machine import ROOT, SCENES, commit, processor

import warpfiber as wf
from warpfiber.methods import bead_chain
from warpfiber.methods.stability import chosen_step
from warpfiber.placement import Placement, place_fibers

RESULTS = ROOT / "tools" / "results" / "bench.jsonl"

# Single flexible fiber of Fig. 5: float64 restatement by RK4 (tests/reference), z/L of the last
# node.
FLEXIBLE_TIP = {20: -0.015848495, 30: -0.038916905, 35: -0.122312314, 40: -0.142961750}
PLACED_AT_ONCE = 2500  # fibers; more are periodic copies


def common(simulation: wf.Simulation) -> dict[str, Any]:
    """What identifies a row."""
    scene = simulation.scene
    return {
        "scene": scene.name,
        "method": scene.numerics.method,
        "segments": scene.fibers[0].segments,
        "closure": scene.numerics.closure,
        "dt": simulation.dt,
        "dt_over_limit": round(simulation.dt / simulation.limits[0].dt, 4),
        "precision": scene.numerics.precision,
        "device": simulation.device,
        "processor": processor(),
        "workers": simulation.method.workers,
        "segment_count": simulation.model.segment_count,
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
    }


def passes(simulation: wf.Simulation, steps: int) -> dict[str, float]:
    """ns per segment-step of every pass over `steps` steps, list included."""
    method, count = simulation.method, simulation.model.segment_count
    times = simulation.pass_times(steps)
    result = {name: round(value * 1e9 / count, 2) for name, value in times.items()}
    return (
        result | {"listed_pairs_per_segment": round(listed(simulation) / count, 3)}
        if (method.list)
        else result
    )


def listed(simulation: wf.Simulation) -> int:
    """Pairs in the neighbor list."""
    pairs = simulation.method.list
    return pairs.pair_count if pairs is not None else 0


def timed_steps(simulation: wf.Simulation, steps: int) -> tuple[float, float]:
    """Wall seconds of `steps` steps, and those of the list builds among them."""
    method = simulation.method
    before, begin = method.list_seconds, time.perf_counter()
    simulation.step(steps)
    return time.perf_counter() - begin, method.list_seconds - before


def engine(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Cells of r_f = 50 fibers at V_f = 0.1, segments of 5 diameters, repulsion only.

    The density is chosen so that half the stable step is the asked strain per step. Large cells are
    made of periodic copies of one with a few thousand fibers, which are numbered copy by copy;
    with `--shuffled` in no order.
    """
    for precision in args.precisions:
        for fibers in args.fibers:
            tiles = max(1, round((fibers / PLACED_AT_ONCE) ** (1 / 3)))
            fibers = tiles**3 * round(fibers / tiles**3)
            edge = (2.0 * np.pi * 5e-6**3 * 50 * fibers / 0.1) ** (1 / 3)
            overrides = {
                "box.size": [edge] * 3,
                "box.boundary": ["periodic"] * 3,
                "fibers.0.aspect_ratio": 51,
                "fibers.0.count": fibers,
                "contact.lubrication": "none",
                "numerics.method": "bead_chain",
                "numerics.segments": 10,
                "numerics.precision": precision,
                "numerics.dt_fraction": 0.5,
                "record.quantities": ["overlap"],
            }
            scene = wf.load_scene(SCENES / "shear_cell.toml", overrides)
            dt, rate = chosen_step(scene), scene.flow.rate
            overrides["fibers.0.density"] = 4e9 * (args.strain_step / (dt * rate)) ** 2
            scene = wf.load_scene(SCENES / "shear_cell.toml", overrides)
            placement = None
            if tiles > 1:
                overrides["box.size"] = [edge / tiles] * 3
                overrides["fibers.0.count"] = fibers // tiles**3
                part = wf.load_scene(SCENES / "shear_cell.toml", overrides)
                placement = tiled(place_fibers(part), tiles, edge / tiles)
            order = "copies" if tiles > 1 else "place"
            if args.shuffled:
                placement, order = shuffled(placement or place_fibers(scene)), "random"
            for row in cell_speeds(scene, args, placement):
                yield row | {"bench": "engine", "numbering": order}


def tiled(part: Placement, tiles: int, edge: float) -> Placement:
    """Periodic copies of a cube of this edge (m), side by side along all axes."""
    copies = np.stack(np.meshgrid(*[np.arange(tiles)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = part.node_pos[None] + edge * copies[:, None]
    per_fiber = np.tile(np.diff(part.fiber_node_start), len(copies))
    return Placement(
        nodes.reshape(-1, 3),
        np.concatenate([[0], np.cumsum(per_fiber)]).astype(np.int32),
        np.tile(part.fiber_group, len(copies)),
    )


def shuffled(placement: Placement) -> Placement:
    """The same fibers, numbered in no order."""
    counts = np.diff(placement.fiber_node_start)
    order = np.random.default_rng(1).permutation(len(counts))
    parts = np.split(placement.node_pos, placement.fiber_node_start[1:-1])
    return Placement(
        np.concatenate([parts[fiber] for fiber in order]),
        np.concatenate([[0], np.cumsum(counts[order])]).astype(np.int32),
        placement.fiber_group[order],
    )


def beads(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """1000 fibers of 20 beads, every bead a node: a sheared cell as molecular dynamics runs it."""
    edge = (2.0 * np.pi * 5e-6**3 * 20 * 1000 / 0.1) ** (1 / 3)
    for precision in args.precisions:
        scene = wf.load_scene(
            SCENES / "shear_cell.toml",
            {
                "box.size": [edge] * 3,
                "box.boundary": ["periodic"] * 3,
                "fibers.0.aspect_ratio": 20,
                "fibers.0.count": 1000,
                "contact.lubrication": "none",
                "numerics.method": "bead_chain",
                "numerics.reduced_beads": 0,
                "numerics.precision": precision,
                "record.quantities": ["overlap"],
            },
        )
        for row in cell_speeds(scene, args):
            ns = row["ns_per_segment_step"] * row["segment_count"] / 20_000
            yield row | {"bench": "beads", "bead_steps_per_second": round(1e9 / ns, -3)}


def cell_speeds(
    scene: wf.Scene, args: argparse.Namespace, placement: Placement | None = None
) -> Iterator[dict[str, Any]]:
    """Time of whole steps with list builds (median), by pass, and what the list looks like.

    With several numbers of workers their runs alternate, so that what else the machine does slows
    all alike; rows behind the first have the ratio to it.
    """
    bead_chain.NATIVE = not args.plain
    cells = [Cell(scene, args, workers, placement) for workers in args.worker_counts]
    for _ in range(args.repeats):
        for cell in cells:
            cell.run()
    for cell in cells:
        row = cell.row()
        if len(cells) == 1:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            row |= {"peak_memory_gb": round(peak / 2**20, 3)}
        if cell is not cells[0]:
            ratios = np.asarray(cells[0].whole) / np.asarray(cell.whole)
            row |= {
                "speedup": round(float(np.median(cells[0].whole) / np.median(cell.whole)), 3),
                "speedup_of_least": round(min(cells[0].whole) / min(cell.whole), 3),
                "speedup_spread": [round(float(ratios.min()), 3), round(float(ratios.max()), 3)],
            }
        yield row
        cell.simulation.close()


class Cell:
    """A simulation whose steps are timed."""

    def __init__(
        self, scene: wf.Scene, args: argparse.Namespace, workers: int, placement: Placement | None
    ) -> None:
        begin = time.perf_counter()
        self.scene = scene
        self.simulation = wf.Simulation(
            scene, device=args.device, workers=workers, placement=placement
        )
        self.placed = time.perf_counter() - begin
        self.count = self.simulation.model.segment_count
        # of several lists, in cells of all sizes
        self.steps = max(20, min(100, 100_000_000 // self.count))
        self.simulation.step(200)  # skins of all sizes have settled
        self.whole: list[float] = []  # ns per segment-step of every run
        self.lists: list[float] = []
        self.before = self._list_work()

    def _list_work(self) -> np.ndarray:
        """Builds, prunes beside them, seconds of pruning."""
        search = self.simulation.method.search
        return np.asarray([search.list.build_count, search.prune_count, search.prune_seconds])

    def run(self) -> None:
        """One timed run."""
        seconds, building = timed_steps(self.simulation, self.steps)
        self.whole.append(seconds / self.steps / self.count * 1e9)
        self.lists.append(building / self.steps / self.count * 1e9)

    def row(self) -> dict[str, Any]:
        """What was measured."""
        simulation, whole, steps = self.simulation, self.whole, self.steps
        builds, prunes, pruning = self._list_work() - self.before
        pruning *= 1e9 / self.count
        median = float(np.median(whole))
        return common(simulation) | {
            "strain_per_step": round(simulation.dt * self.scene.flow.rate, 6),
            "ns_per_segment_step": round(median, 1),
            "ns_spread": [round(min(whole), 1), round(max(whole), 1)],
            "us_per_step": round(median * self.count * 1e-3, 1),
            "ns_list": round(float(np.mean(self.lists)), 1),
            "ns_per_build": round((sum(self.lists) * steps - pruning) / max(1, builds), 1),
            "ns_per_pruning": round(pruning / max(1, prunes), 1),
            "ns_by_pass": passes(simulation, min(50, steps)),
            "vectorized": simulation.method.native,
            "list": simulation.method.list_report(),
            "seconds_to_place": round(self.placed, 1),
            "error": simulation.measure()["overlap_max"],
            "error_kind": "largest overlap, radii",
        }


def accuracy(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Flexible fiber of Fig. 5: wall time to strain 40 and the worst tip error on the way.

    With inertia, then without (`bench_overdamped`).
    """
    for segments, closure in (
        (49, "consistent"),
        (25, "consistent"),
        (25, "paper"),
        (15, "consistent"),
        (15, "paper"),
        (7, "consistent"),
    ):
        for fraction in (0.8, 0.4, 0.1, 0.025):
            scene = wf.load_scene(
                SCENES / "flexible.toml",
                {
                    "numerics.method": "bead_chain",
                    "numerics.segments": segments,
                    "numerics.closure": closure,
                    "numerics.dt_fraction": fraction,
                },
            )
            simulation = wf.Simulation(scene, device=args.device, workers=args.workers)
            simulation.step(1)
            length = scene.fibers[0].centerline_length
            worst, seconds = 0.0, 0.0
            for strain, tip in FLEXIBLE_TIP.items():
                begin = time.perf_counter()
                simulation.run(until=float(strain))
                seconds += time.perf_counter() - begin
                nodes = simulation.node_pos
                here = (nodes[-1] - nodes.mean(axis=0))[2] / length
                worst = max(worst, abs(here - tip))
            steps = simulation.step_count
            yield common(simulation) | {
                "bench": "accuracy",
                "seconds": round(seconds, 4),
                "steps": steps,
                "ns_per_segment_step": round(seconds / steps / segments * 1e9, 1),
                "error": worst,
                "error_kind": "tip z/L at strain 20, 30, 35, 40 against the full chain by RK4",
            }
            simulation.close()
    yield from overdamped_rows(SCENES / "flexible.toml", args, common)


def period(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Fig. 3 (`bench_papers`)."""
    yield from period_rows(args, common)


def suspensions(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Figs. 6-9 (`bench_papers`)."""
    yield from suspension_rows(args, common)


def contact(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Implicit contact (`bench_contact`)."""
    yield from contact_rows(args, common)


def dem(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A bed of bonded fibers (`bench_dem`)."""
    yield from dem_rows(args, common)


def plate(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The sliding-plate cell (`bench_plate`)."""
    yield from plate_rows(args, common)


def main() -> None:
    """Run one benchmark and append its rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    benches = ["engine", "beads", "accuracy", "period", "suspensions", "contact", "dem", "plate"]
    parser.add_argument("bench", choices=benches)
    parser.add_argument("names", nargs="*", help="cells of `suspensions`, parts of `contact`")
    parser.add_argument("--method", default="bead_chain", help="of `period`, `suspensions`")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--strain", type=float, default=60.0)
    parser.add_argument("--segments", type=int, nargs="*", help="0 = full chain")
    parser.add_argument("--fibers", type=int, nargs="*", default=[50, 2000])
    parser.add_argument("--strain-step", type=float, default=1e-3, help="of `engine`")
    parser.add_argument("--plain", action="store_true", help="on the CPU what CUDA runs")
    parser.add_argument("--precisions", nargs="*", default=["float64", "float32"])
    parser.add_argument("--cell-fibers", type=int, default=1000, help="of `contact`")
    parser.add_argument("--explicit", type=float, help="strain, of `contact`; else --strain")
    parser.add_argument("--fraction", type=float, default=0.29, help="where `dem` starts")
    parser.add_argument("--volume", type=float, default=1.0, help="part of the fibers, of `plate`")
    parser.add_argument("--steps", type=int, default=400, help="of one repeat of `dem`")
    parser.add_argument("--load", action="store_true", help="`dem`: the whole loading")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, nargs="+", default=[1])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--set", action="append", default=[], type=_override)
    parser.add_argument("--shuffled", action="store_true", help="number fibers at random")
    parser.add_argument("--dry", action="store_true", help="print only")
    args = parser.parse_intermixed_args()
    args.worker_counts, args.workers = args.workers, args.workers[0]
    for row in globals()[args.bench](args):
        line = json.dumps(row)
        print(line, flush=True)
        if not args.dry:
            RESULTS.parent.mkdir(exist_ok=True)
            with RESULTS.open("a", encoding="utf-8") as file:
                file.write(line + "\n")


def _override(text: str) -> tuple[str, object]:
    from warpfiber.scene import parse_override

    return parse_override(text)


if __name__ == "__main__":
    main()
