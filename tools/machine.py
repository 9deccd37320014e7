"""What a measurement was made on: commit, processor, memory bandwidth."""

from __future__ import annotations

import platform
import subprocess
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SCENES = ROOT / "scenes" / "sasayama_2018"


def commit() -> str:
    """Short hash of the tree, with + if it has changes."""
    run = ["git", "-C", str(ROOT)]
    try:
        head = subprocess.run(
            [*run, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
        ).stdout.strip()
        dirty = subprocess.run([*run, "diff", "--quiet", "HEAD"], check=False).returncode
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + ("+" if dirty else "")


def processor() -> str:
    """Name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor()


def copy_bandwidth(size: int, repeats: int = 9) -> float:
    """Bytes per second, read and written, of one core that copies `size` bytes again and again."""
    source = np.ones(max(1, size // 8))
    target = np.empty_like(source)
    inner = max(1, 20_000_000 // max(1, source.nbytes))
    best = float("inf")
    for _ in range(repeats):
        begin = time.perf_counter()
        for _ in range(inner):
            np.copyto(target, source)
        best = min(best, (time.perf_counter() - begin) / inner)
    return 2.0 * source.nbytes / best
