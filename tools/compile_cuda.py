"""Compile every kernel for CUDA without a GPU and read what it costs from the machine code.

    python tools/compile_cuda.py [--json FILE] [--arch 80 90]

Kernels of representative scenes are compiled to cubins. A table lists registers and the stack frame
per thread; a frame means values that do not fit into registers and go through slow local memory. A
kernel that yields no cubin, or has a frame that FRAMES does not explain, is a failure (exit code
1).

Source: CUDA ELF, section `.nv.info`: records (u8 format, u8 attribute, u16 size), format 4 followed
    by `size` bytes; attributes 0x2f register count and 0x11 frame bytes hold (u32 symbol, u32
    value).
Limits: that a kernel compiles does not say that it runs.
"""

from __future__ import annotations

import argparse
import json
import struct
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import warp as wp

from warpfiber.laws.contact_compliance import LAWS
from warpfiber.passes.bond_drift import make_bond_drift
from warpfiber.passes.bond_energy import make_measure_bonds
from warpfiber.passes.bond_losses import make_bond_losses
from warpfiber.passes.bonds import BondFeatures, make_bond_sweep
from warpfiber.passes.capsule_pairs import CapsuleFeatures, make_capsule_pairs
from warpfiber.passes.cells import ListFeatures, make_cell_kernels
from warpfiber.passes.chain_blocks import make_chain_moves, make_end_kernels
from warpfiber.passes.chain_load import make_chain_load
from warpfiber.passes.chain_pace import make_chain_pace
from warpfiber.passes.chain_response import make_chain_apply, make_chain_response
from warpfiber.passes.chain_solve import CHI, make_chain_step
from warpfiber.passes.check_sweeps import CheckFeatures, make_check_sweeps
from warpfiber.passes.clock import make_clock
from warpfiber.passes.contact_energy import make_contact_energy
from warpfiber.passes.contact_memory import make_carry_memory
from warpfiber.passes.contact_verdict import make_contact_verdict
from warpfiber.passes.dual_rows import make_dual_balance, make_dual_step, make_fold_sums
from warpfiber.passes.dual_setup import make_dual_begin, make_dual_lists
from warpfiber.passes.grip_meter import make_grip_meter, make_grip_sum
from warpfiber.passes.held_nodes import make_carry_fibers
from warpfiber.passes.list_bound import make_list_bound
from warpfiber.passes.measure import (
    MeasureFeatures,
    make_measure_fibers,
    make_measure_pairs,
    make_measure_terms,
)
from warpfiber.passes.measure_layers import make_measure_layers
from warpfiber.passes.measure_stress import make_measure_stress
from warpfiber.passes.nodes import NodeFeatures, make_node_sweep
from warpfiber.passes.pair_motion import make_pair_motion
from warpfiber.passes.pairs import PairFeatures, make_pair_sweep
from warpfiber.passes.rigid_rods import make_rod_maps, make_rod_step
from warpfiber.passes.rod_response import make_rod_apply, make_rod_response
from warpfiber.passes.row_count import RowFeatures, make_row_count
from warpfiber.passes.row_fill import make_row_fill
from warpfiber.passes.rows import make_row_kernels
from warpfiber.passes.step_control import (
    make_largest_error,
    make_step_begin,
    make_step_end,
    make_take_back,
)
from warpfiber.passes.wall_press import make_push_sum, make_wall_meter, make_wall_motion
from warpfiber.passes.wall_servo import make_wall_servo

ARCHITECTURES = (80, 90)
PRECISIONS = ("float32", "float64")
# Kernels that may have a stack frame: name of the kernel, largest frame in bytes, and why.
FRAMES: dict[str, tuple[int, str]] = {
    "bond_sweep": (40, "sine and cosine, of nodes that turn by more than 0.2 in a step"),
    "bond_drift": (40, "as bond_sweep"),
    "chain_step": (640, "in float64 two blocks and three nodes need more than 255 registers"),
}

STRESS_KERNELS = ("drag_moments", "contact_moments")

FORMAT_SIZED = 0x04
ATTRIBUTE_FRAME = 0x11
ATTRIBUTE_REGISTERS = 0x2F
SECTION_SYMBOLS = 2


@dataclass(frozen=True)
class Cost:
    """What one kernel of one variant needs on one architecture."""

    kernel: str
    variant: str
    arch: int
    registers: int
    frame: int  # bytes per thread
    size: int  # bytes of the cubin


class CudaElf:
    """The few parts of a cubin (ELF, 64 bit, little endian) that say what its functions need."""

    def __init__(self, data: bytes) -> None:
        """Raises ValueError if `data` is no such file."""
        if data[:6] != b"\x7fELF\x02\x01":
            raise ValueError("not a 64-bit little-endian ELF file")
        self.data = data
        (table,) = struct.unpack_from("<Q", data, 0x28)
        entry, count, names = struct.unpack_from("<HHH", data, 0x3A)
        headers = [struct.unpack_from("<IIQQQQIIQQ", data, table + k * entry) for k in range(count)]
        start = headers[names][4]
        self.sections = [
            (self._text(start + h[0]), h[1], data[h[4] : h[4] + h[5]], h[6]) for h in headers
        ]

    def _text(self, offset: int) -> str:
        return self.data[offset : self.data.index(b"\0", offset)].decode()

    def symbols(self) -> list[str]:
        """Names of all symbols, by their index."""
        for _, kind, body, link in self.sections:
            if kind != SECTION_SYMBOLS:
                continue
            strings = self.sections[link][2]
            starts = [struct.unpack_from("<I", body, k)[0] for k in range(0, len(body), 24)]
            return [strings[s : strings.index(b"\0", s)].decode() for s in starts]
        return []

    def values(self, attribute: int) -> dict[str, int]:
        """Value of one attribute per function."""
        names = self.symbols()
        found: dict[str, int] = {}
        for section, _, body, _ in self.sections:
            if section == ".nv.info":
                for symbol, value in _records(body, attribute):
                    found[names[symbol]] = value
        return found


def _records(body: bytes, attribute: int) -> Iterator[tuple[int, int]]:
    """(symbol, value) of the records of one attribute."""
    at = 0
    while at + 4 <= len(body):
        kind, name, size = struct.unpack_from("<BBH", body, at)
        at += 4
        if kind != FORMAT_SIZED:
            continue  # the value is in place of the size
        if name == attribute and size >= 8:
            symbol, value = struct.unpack_from("<II", body, at)
            yield symbol, value
        at += size


def read_cost(cubin: Path, kernel: str, variant: str, arch: int) -> Cost:
    """Registers and frame of a cubin, the largest over its functions; ValueError if unreadable."""
    data = cubin.read_bytes()
    elf = CudaElf(data)
    registers, frames = elf.values(ATTRIBUTE_REGISTERS), elf.values(ATTRIBUTE_FRAME)
    if not registers or not frames:
        raise ValueError(f"{cubin.name} says nothing about registers and frames")
    return Cost(kernel, variant, arch, max(registers.values()), max(frames.values()), len(data))


def _node_variants() -> list[tuple[str, NodeFeatures]]:
    layer, box = (False, False, True), (True, True, True)
    variants = [
        ("none", NodeFeatures("none")),
        ("none closest", NodeFeatures("none", pairs="closest")),
        ("paper arms wall", NodeFeatures("paper", pairs="arms", walls=layer)),
        ("consistent", NodeFeatures("consistent")),
        ("consistent closest", NodeFeatures("consistent", pairs="closest")),
        ("consistent arms wall", NodeFeatures("consistent", pairs="arms", walls=layer)),
    ]
    for closure in ("paper", "consistent"):
        everything = NodeFeatures(closure, pairs="arms", walls=box, gravity=True)
        variants.append((f"{closure} arms walls gravity", everything))
    return variants


def _pair_variants() -> list[tuple[str, PairFeatures]]:
    return [
        ("repulsion", PairFeatures()),
        ("repulsion sheared", PairFeatures(periodic=True, sheared=True)),
        ("paper", PairFeatures(lubrication="paper", periodic=True)),
        ("shifted sheared", PairFeatures(lubrication="shifted", periodic=True, sheared=True)),
        ("lubrication alone", PairFeatures(repulsion=False, lubrication="paper")),
    ]


def _bond_variants() -> list[tuple[str, BondFeatures, tuple[bool, bool]]]:
    """(variant, features, (drifts, kicks)) of the sweep over bonded spheres."""
    floor = (False, False, True)
    bed = BondFeatures(dashpots=True, walls=floor, pairs=True, wall_friction=True)
    return [
        ("alone", BondFeatures(), (True, True)),
        (
            "held rings",
            BondFeatures(dashpots=True, walls=floor, loads=True, closed=True),
            (True, True),
        ),
        ("bed", bed, (False, True)),
        ("pressed bed", replace(bed, press=2), (False, True)),
        ("bed in a container", replace(bed, container=True), (False, True)),
        ("rings in a container", replace(bed, container=True, closed=True), (False, True)),
        ("gripped bed", replace(bed, press=2, loads=True, grips=True), (False, True)),
        ("start of a bed", bed, (False, False)),
    ]


def _dual_kernels(precision: str) -> Iterator[tuple[str, str, Any]]:
    for law in LAWS:
        yield "dual_begin", law, make_dual_begin(precision, law, False)
        for by_ends, variant in ((False, "rods"), (True, "chains")):
            yield "dual_balance", f"{law} {variant}", make_dual_balance(precision, law, by_ends)
    yield "dual_lists", "", make_dual_lists(precision)
    yield "dual_step", "", make_dual_step(precision)
    yield "fold_sums", "", make_fold_sums()
    yield "rod_response", "", make_rod_response(precision, False)
    yield "rod_apply", "", make_rod_apply(precision)
    for name, kernel in make_end_kernels(precision).items():
        yield name, "", kernel
    yield "chain_moves", "", make_chain_moves(precision, False)
    yield "chain_response", "", make_chain_response(precision, False)
    yield "chain_apply", "", make_chain_apply(precision)
    yield "set_pace", "", make_chain_pace(precision)
    for name, kernel in make_chain_load(precision, True).items():
        yield name, "", kernel


def kernels(precision: str) -> Iterator[tuple[str, str, Any]]:
    """(kernel, variant, Warp kernel) of everything that representative scenes launch."""
    for sheared, scheduled in ((False, False), (True, False), (True, True)):
        variant = " ".join(["sheared"] * sheared + ["scheduled"] * scheduled) or "plain"
        yield "clock_step", variant, make_clock(precision, sheared, scheduled)
    yield "step_begin", "", make_step_begin(precision)
    yield "chain_step", "", make_chain_step(precision)
    yield "chain_step", "loads", make_chain_step(precision, True, True)
    yield "carry_fibers", "", make_carry_fibers(precision, True, CHI)
    yield "rod_maps", "", make_rod_maps(precision)
    yield "rod_step", "", make_rod_step(precision)
    for variant, bonds, parts in _bond_variants():
        yield "bond_sweep", variant, make_bond_sweep(precision, bonds, *parts)
    yield "bond_drift", "", make_bond_drift(precision)
    yield "capsule_pairs", "plain", make_capsule_pairs(precision, CapsuleFeatures())
    rubbing = CapsuleFeatures(periodic=True, dashpot=True, friction=True)
    yield "capsule_pairs", "everything", make_capsule_pairs(precision, rubbing)
    rings = CapsuleFeatures(periodic=True, dashpot=True, friction=True, closed=True)
    yield "capsule_pairs", "rings", make_capsule_pairs(precision, rings)
    for name, kernel in zip(
        ("keep_memory", "carry_memory"), make_carry_memory(precision, True), strict=True
    ):
        yield name, "", kernel
    yield "move_walls", "", make_wall_motion(2)
    yield "sum_pushes", "", make_push_sum()
    yield "meter_walls", "", make_wall_meter(2)
    yield "steer_wall", "", make_wall_servo()
    yield "sum_grips", "", make_grip_sum(precision)
    yield "meter_grips", "", make_grip_meter()
    yield "measure_bonds", "", make_measure_bonds(precision, (False, False, True), True)
    for variant, bonds, _ in _bond_variants():
        yield "bond_losses", variant, make_bond_losses(precision, bonds)
    for is_step in (True, False):
        yield "contact_energy", str(is_step), make_contact_energy(precision, rubbing, is_step)
    yield "largest_error", "", make_largest_error(precision)
    yield "take_back", "", make_take_back(precision)
    yield from _dual_kernels(precision)
    for name, kernel in make_contact_verdict().items():
        yield name, "", kernel
    for variant, adaptive in (("plain", False), ("tolerance", True)):
        yield "step_end", variant, make_step_end(precision, True, adaptive)
        yield "step_end", f"{variant} contact", make_step_end(precision, True, adaptive, True)
    for variant, nodes in _node_variants():
        yield "node_sweep", variant, make_node_sweep(precision, nodes)
    for variant, pairs in _pair_variants():
        yield "pair_sweep", variant, make_pair_sweep(precision, pairs)
    lists = {
        "open": ListFeatures((False, False, False)),
        "layer": ListFeatures((True, True, False)),
        "sheared": ListFeatures((True, True, True), (0, 2), True),
        "deformed": ListFeatures((True, True, True), None, True),
        "pieces": ListFeatures((True, True, True), (0, 2), True, True),
    }
    for variant, list_features in lists.items():
        for make in (make_cell_kernels, make_row_kernels):
            for name, kernel in make(precision, list_features).items():
                yield name, variant, kernel
    for variant, walls, lubrication, arrays in (
        ("sheared", (False, False, False), "none", False),
        ("wall paper", (False, False, True), "paper", False),
        ("array", (False, False, True), "none", True),
    ):
        features = RowFeatures(True, walls, lubrication, arrays)
        check = CheckFeatures(True, walls, shifted=True, again=True, arrays=arrays)
        checks = make_check_sweeps(precision, check)
        for name, kernel in (make_row_count(precision, features) | checks).items():
            yield name, variant, kernel
        yield "fill_rows", variant, make_row_fill(precision, features)
    yield "pair_motion", "", make_pair_motion(precision, True)
    for name, kernel in make_list_bound(precision).items():
        yield name, "", kernel
    for variant, fibers in {
        "orientation": MeasureFeatures(),
        "everything": MeasureFeatures(orientation4=True, energy=True, curvature=True),
        "overdamped": MeasureFeatures(energy=True, curvature=True, inertia=False),
    }.items():
        yield "measure_fibers", variant, make_measure_fibers(precision, fibers)
    for tensor4 in (False, True):
        kernel = make_measure_layers(precision, tensor4)
        yield "measure_layers", "everything" if tensor4 else "orientation", kernel
    for name, kernel in zip(STRESS_KERNELS, make_measure_stress(precision), strict=True):
        yield name, "", kernel
    for variant, pairs in _pair_variants()[1:3]:
        yield "measure_pairs", variant, make_measure_pairs(precision, pairs)
    for variant in ("none", "closest"):
        yield "measure_terms", variant, make_measure_terms(precision, variant)


def compile_all(architectures: Sequence[int], folder: Path) -> tuple[list[Cost], list[str]]:
    """Costs of all kernels and what failed. A module two variants share is compiled once."""
    costs: list[Cost] = []
    failures: list[str] = []
    done: set[str] = set()
    for precision in PRECISIONS:
        for kernel, variant, made in kernels(precision):
            if made.module.name in done:
                continue
            done.add(made.module.name)
            where = f"{precision} {variant}"
            try:
                paths = wp.compile_aot_module(
                    made.module, arch=architectures, module_dir=folder, use_ptx=False
                )
                if len(paths) != len(architectures):
                    raise ValueError(f"{len(paths)} files for {len(architectures)} architectures")
                costs += [
                    read_cost(path, kernel, where, arch)
                    for path, arch in zip(paths, architectures, strict=True)
                ]
            except Exception as fault:  # a compiler that gives up is what this tool looks for
                failures.append(f"{kernel} ({where}): {fault}")
    return costs, failures


def frame_faults(costs: Sequence[Cost]) -> list[str]:
    """Frames that FRAMES does not explain."""
    faults = []
    for cost in costs:
        allowed, _ = FRAMES.get(cost.kernel, (0, ""))
        if cost.frame > allowed:
            faults.append(
                f"{cost.kernel} ({cost.variant}), sm_{cost.arch}: frame of {cost.frame} bytes, "
                f"{allowed} allowed"
            )
    return faults


def table(costs: Sequence[Cost]) -> list[str]:
    """One line per kernel, variant and architecture."""
    lines = [f"{'kernel':<15}{'variant':<42}{'arch':>6}{'registers':>10}{'frame':>7}{'kB':>7}"]
    for c in costs:
        where = f"{c.kernel:<15}{c.variant:<42}{f'sm_{c.arch}':>6}"
        lines.append(f"{where}{c.registers:>10}{c.frame:>7}{c.size / 1e3:>7.1f}")
    return lines


def main(argv: Sequence[str] | None = None) -> int:
    """Compile, print, return 1 if anything failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the table as JSON too")
    parser.add_argument("--arch", type=int, nargs="+", default=list(ARCHITECTURES), metavar="N")
    args = parser.parse_args(argv)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        costs, failures = compile_all(args.arch, Path(folder))
    failures += frame_faults(costs)
    print("\n".join(table(costs)))
    for kernel, (size, reason) in FRAMES.items():
        print(f"allowed: {kernel} up to {size} bytes: {reason}")
    print(f"{len(costs)} cubins in {time.perf_counter() - began:.0f} s")
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(cost) for cost in costs], indent=1) + "\n")
    for failure in failures:
        print(f"FAILED: {failure}", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
