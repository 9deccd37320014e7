"""Warp's headers, compiled once per process for all threads that compile kernels for the CPU.

To read them takes as long as to compile some thousand lines of kernels. Warp keeps them
precompiled, but for every thread apart: two threads would both begin by reading them, and so would
every later one. Here they are read once per set of compiler flags, if need be while fibers are
being placed, and each thread gets a copy.

Limits: only saves time. A thread without a copy that fits makes its own, as Warp does.
"""

from __future__ import annotations

import shutil
import tempfile
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

BLOCK = 1  # threads per block of kernels for the CPU
# what Warp writes above every kernel
SOURCE = f"""
#define WP_TILE_BLOCK_DIM {BLOCK}
#define WP_NO_CRT
#include "builtin.h"
"""
# A third of the headers is about a kind of numbers that no kernel here has. Warp leaves it out of
# every module without them, but not of what it precompiles.
LEAN = "-DWP_NO_BFLOAT16="


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="warpfiber_headers_")


def lean_flags(own: str | None = None) -> str:
    """Compiler flags of a module that has these of its own, else Warp's, with fewer headers."""
    flags = wp.config.cpu_compiler_flags if own is None else own
    flags = "-march=native" if flags is None else flags
    return flags if LEAN in flags else f"{flags} {LEAN}"


@cache
def precompiled(flags: str) -> Future[Path | None]:
    """The folder of the headers for these flags, None if they failed; begun by the first call.

    To be called from one thread.
    """
    compiler = ThreadPoolExecutor(max_workers=1)
    found = compiler.submit(_precompile, Path(_folder().name), flags)
    compiler.shutdown(wait=False)
    return found


def _precompile(above: Path, flags: str) -> Path | None:
    folder = Path(tempfile.mkdtemp(dir=above))
    source = folder / "headers.cpp"
    source.write_text(SOURCE)
    try:
        wp._src.build.build_cpu(
            str(folder / "headers.o"),
            str(source),
            mode=wp.config.mode,
            verify_fp=wp.config.verify_fp,
            extra_flags=flags,
            use_precompiled_headers=True,
            pch_dir=str(folder),
            block_dim=BLOCK,
        )
    except Exception:  # the compiler of the kernels will say what is wrong
        return None
    return folder


def take_headers(headers: Future[Path | None]) -> None:
    """Give this thread the headers, once they are ready, unless it has them."""
    folder, own = headers.result(), wp._src.context.runtime.get_clang_pch_dir()
    if folder is None or own is None:
        return
    for header in folder.glob("*.pch"):
        if not (Path(own) / header.name).exists():
            shutil.copyfile(header, Path(own) / header.name)


def is_cached(module: Any) -> bool:
    """Whether Warp's cache has this module, for the CPU or another device."""
    return (Path(wp.config.kernel_cache_dir) / module.get_module_identifier(BLOCK)).is_dir()


def is_first_run() -> bool:
    """Whether Warp's cache has no module of this package: headers will be needed."""
    return not any(Path(wp.config.kernel_cache_dir).glob("wp_warpfiber_*"))
