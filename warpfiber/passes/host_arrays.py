"""Small arrays that the host reads and writes between steps.

On the CPU they are looked at where they are, by a view that is made once: another one, or an array
to copy from, costs 0.005 to 0.05 ms, which a list built anew every few steps pays many times.
"""

from __future__ import annotations

from typing import Any


def host_view(array: Any) -> Any:
    """What a Warp array holds now; on the CPU the memory itself."""
    if not array.device.is_cpu:
        return array.numpy()
    view = getattr(array, "host_view", None)
    if view is None:
        view = array.host_view = array.numpy()
    return view


def write_array(array: Any, values: Any) -> None:
    """`values` (NumPy, or one number for all) into a Warp array, on any device."""
    if array.device.is_cpu:
        host_view(array)[...] = values
    elif isinstance(values, int | float):
        array.fill_(values)
    else:
        array.assign(values)
