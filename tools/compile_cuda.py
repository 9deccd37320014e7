"""Compile every kernel for CUDA without a GPU and read what it costs from the machine code.

    python tools/compile_cuda.py [--json FILE] [--arch 80 90] [--jobs N]

The variants of `cuda_variants` are compiled to cubins, by default for sm_80 on all cores. A table
lists registers and the stack frame per thread; a frame means values that do not fit into registers
and go through slow local memory. A kernel that yields no cubin, or has a frame that FRAMES does not
explain, is a failure (exit code 1).

Source: CUDA ELF, section `.nv.info`: records (u8 format, u8 attribute, u16 size), format 4 followed
    by `size` bytes; attributes 0x2f register count and 0x11 frame bytes hold (u32 symbol, u32
    value).
Limits: that a kernel compiles does not say that it runs.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import struct
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import warp as wp
from cuda_variants import kernels

ARCHITECTURE = 80
# Kernels that may have a stack frame: name of the kernel, largest frame in bytes, and why.
FRAMES: dict[str, tuple[int, str]] = {
    "bond_sweep": (40, "sine and cosine, of nodes that turn by more than 0.2 in a step"),
    "bond_drift": (40, "as bond_sweep"),
    "find_pairs": (768, "lists of waiting midpoints, places in them are known at run time alone"),
    "chain_step": (640, "in float64 two blocks and three nodes need more than 255 registers"),
    "capsule_pairs": (160, "in float64 a share with its gradient needs more than 255 registers"),
}

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


@cache
def _modules() -> list[tuple[str, str, Any]]:
    """(kernel, variant, Warp kernel) of every module once, by its first kernel."""
    found = list(kernels())
    first: dict[str, tuple[str, str, Any]] = {}
    for row in found:
        first.setdefault(row[2].module.name, row)
    return list(first.values())


def _compile(index: int, architectures: Sequence[int], folder: Path) -> tuple[list[Cost], str]:
    """Costs of one module, or what failed."""
    kernel, variant, made = _modules()[index]
    try:
        paths = wp.compile_aot_module(
            made.module, arch=architectures, module_dir=folder, use_ptx=False
        )
        if len(paths) != len(architectures):
            raise ValueError(f"{len(paths)} files for {len(architectures)} architectures")
        return [
            read_cost(path, kernel, variant, arch)
            for path, arch in zip(paths, architectures, strict=True)
        ], ""
    except Exception as fault:  # a compiler that gives up is what this tool looks for
        return [], f"{kernel} ({variant}): {fault}"


def compile_all(
    architectures: Sequence[int], folder: Path, jobs: int = 1
) -> tuple[list[Cost], list[str]]:
    """Costs of all kernels and what failed, by `jobs` processes side by side."""
    count = len(_modules())
    compiled = partial(_compile, architectures=architectures, folder=folder)
    if jobs == 1:
        results = [compiled(index) for index in range(count)]
    else:
        # forked compilers would share the threads of one; a module at a time, as costs differ
        with multiprocessing.get_context("spawn").Pool(jobs) as pool:
            results = pool.map(compiled, range(count), chunksize=1)
    costs = [cost for found, _ in results for cost in found]
    return costs, [failure for _, failure in results if failure]


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
    names, variants = (
        max([len(text) for text in texts], default=0) + 1
        for texts in ([c.kernel for c in costs], [c.variant for c in costs])
    )
    heading = f"{'kernel':<{names}}{'variant':<{variants}}"
    lines = [f"{heading}{'arch':>6}{'registers':>10}{'frame':>7}{'kB':>7}"]
    for c in costs:
        where = f"{c.kernel:<{names}}{c.variant:<{variants}}{f'sm_{c.arch}':>6}"
        lines.append(f"{where}{c.registers:>10}{c.frame:>7}{c.size / 1e3:>7.1f}")
    return lines


def main(argv: Sequence[str] | None = None) -> int:
    """Compile, print, return 1 if anything failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the table as JSON too")
    parser.add_argument("--arch", type=int, nargs="+", default=[ARCHITECTURE], metavar="N")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N")
    args = parser.parse_args(argv)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        costs, failures = compile_all(args.arch, Path(folder), args.jobs)
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
