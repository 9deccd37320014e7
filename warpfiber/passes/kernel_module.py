"""Warp modules that hold kernels: their names, and compiling several for the CPU at a time.

A module costs a start of the compiler, 0.1 s whatever is in it. Kernels that a run always needs
together share one. Its name stands for everything that their factories depend on, so that no second
variant is ever added to it, which would make Warp build it again.
"""

import hashlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import warp as wp

from warpfiber.passes.headers import (
    BLOCK,
    is_cached,
    is_first_run,
    lean_flags,
    precompiled,
    take_headers,
)

# Module options of sweeps whose multiplications and additions are fused, as CUDA does anyway;
# without them Warp's CPU code takes up to a third longer. Inlining as Warp sets it: with the
# compiler's own, which takes a third less time, steps with contact take up to a fifth longer.
_FLAGS = wp.config.cpu_compiler_flags or "-march=native"
FUSED = {"cpu_compiler_flags": f"{_FLAGS} -ffp-contract=fast"}


def kernel_module(noun: str, *key: Any) -> str:
    """Name of the module of the kernels that are made for this key."""
    return f"warpfiber_{noun}_{hashlib.sha256(repr(key).encode()).hexdigest()[:12]}"


def foresee_modules(*options: dict[str, str]) -> None:
    """Begin what every module for the CPU needs, in the background, where none was ever compiled.

    `options` of modules that have flags of their own.
    """
    if is_first_run():
        for flags in (None, *(own["cpu_compiler_flags"] for own in options)):
            precompiled(lean_flags(flags))


def load_modules(modules: Sequence[Any], device: Any, compilers: int) -> None:
    """Compile or load modules for the CPU, so many at a time, what takes longest first."""
    for module in modules:
        if not module.execs:  # of one that is in use nothing may change
            flags = lean_flags(module.options["cpu_compiler_flags"])
            if module.options["cpu_compiler_flags"] != flags:
                wp.set_module_options({"cpu_compiler_flags": flags}, module)
    missing = [module for module in modules if not is_cached(module)]
    missing.sort(key=_length, reverse=True)

    def compiled(module: Any, headers: Future[Path | None]) -> None:
        take_headers(headers)
        module.load(device, block_dim=BLOCK)

    if missing:
        flags = [module.options["cpu_compiler_flags"] or lean_flags() for module in missing]
        headers = [precompiled(own) for own in flags]
        with ThreadPoolExecutor(max_workers=compilers) as threads:
            for done in list(map(partial(threads.submit, compiled), missing, headers)):
                done.result()
    for module in modules:  # what is loaded already returns at once
        module.load(device, block_dim=BLOCK)


def _length(module: Any) -> int:
    """Characters of the kernels of a module and of all functions that they call."""
    functions: set[Any] = set()

    def length(source: Any) -> int:
        called = [f for f in source.get_references()[2] if not f.is_builtin()]
        added = [f for f in called if f not in functions]
        functions.update(added)
        texts = [len(f.native_snippet) if f.native_snippet else length(f.adj) for f in added]
        return len(source.source) + sum(texts)

    return sum(length(kernel.adj) for kernel in module.kernels.values())
