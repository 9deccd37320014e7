"""Names of the Warp modules that hold several kernels.

A module costs a start of the compiler with all of Warp's headers, 0.15 s whatever is in it. Kernels
that a run always needs together share one. Its name stands for everything that their factories
depend on, so that no second variant is ever added to it, which would make Warp build it again.
"""

import hashlib
from typing import Any


def kernel_module(noun: str, *key: Any) -> str:
    """Name of the module of the kernels that are made for this key."""
    return f"warpfiber_{noun}_{hashlib.sha256(repr(key).encode()).hexdigest()[:12]}"
