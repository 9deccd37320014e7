"""Small arrays written by the host between steps.

On the CPU they are written where they are: making an array to copy from costs 0.05 ms, which a list
that is built anew every few steps would pay each time.
"""

from __future__ import annotations

from typing import Any


def write_array(array: Any, values: Any) -> None:
    """`values` (NumPy, or one number for all) into a Warp array, on any device."""
    if array.device.is_cpu:
        array.numpy()[...] = values
    elif isinstance(values, int | float):
        array.fill_(values)
    else:
        array.assign(values)
