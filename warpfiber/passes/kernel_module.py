"""Names of the Warp modules that hold several kernels.

A module costs a start of the compiler with all of Warp's headers, 0.15 s whatever is in it. Kernels
that a run always needs together share one. Its name stands for everything that their factories
depend on, so that no second variant is ever added to it, which would make Warp build it again.
"""

import hashlib
from typing import Any

import warp as wp

# Module options of sweeps whose multiplications and additions are fused, as CUDA does anyway;
# without them Warp's CPU code takes up to a third longer. Inlining as Warp sets it.
_FLAGS = wp.config.cpu_compiler_flags or "-march=native"
FUSED = {"cpu_compiler_flags": f"{_FLAGS} -ffp-contract=fast"}


def kernel_module(noun: str, *key: Any) -> str:
    """Name of the module of the kernels that are made for this key."""
    return f"warpfiber_{noun}_{hashlib.sha256(repr(key).encode()).hexdigest()[:12]}"
