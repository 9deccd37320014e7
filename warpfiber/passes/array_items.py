"""Items of whole arrays where they are: no strides, and no indices that count from the end.

Warp multiplies an index by a stride that it loads, and compares it with zero: eight instructions
for every item, and its address is known late. The text is C++ of both devices.
Limits: arrays as they were allocated, no slices; an index outside is not noticed.
"""

from functools import cache
from typing import Any

import warp as wp


@cache
def make_items(dtype: Any):
    """`read(array, i)` and `write(array, i, value)` of arrays of a type."""

    @wp.func_native("return array.data[i];")
    def read(array: wp.array(dtype=dtype), i: wp.int32) -> dtype: ...

    @wp.func_native("array.data[i] = value;")
    def write(array: wp.array(dtype=dtype), i: wp.int32, value: dtype): ...

    return read, write


# The lines that items begin and end in.
FETCH = """
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(array.data + i);
    __builtin_prefetch((const char*)(array.data + i + COUNT) - 1);
#endif
"""


@cache
def make_fetch(dtype: Any, count: int = 1):
    """`fetch(array, i)`: on the CPU, asks for items that are needed soon, into the near cache."""
    text = FETCH.replace("COUNT", str(count))

    @wp.func_native(text)
    def fetch(array: wp.array(dtype=dtype), i: wp.int32): ...

    return fetch
