"""Items in portions: each once, and each half of the launch indices has every other portion."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpfiber.passes.portions import portioned


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def number_items(items: wp.int32, size: wp.int32, item_out: wp.array(dtype=wp.int32)):
    index = wp.tid()
    item_out[index] = portioned(index, items, size)


@pytest.mark.parametrize("size", [1, 8, 64])
@pytest.mark.parametrize("items", [1, 7, 64, 127, 640, 1000])
def test_every_item_once(items: int, size: int) -> None:
    found = wp.zeros(items, dtype=wp.int32, device="cpu")
    wp.launch(number_items, dim=items, inputs=[items, size, found], device="cpu")
    values = found.numpy()
    assert (np.sort(values) == np.arange(items)).all()
    whole = items // size * size
    runs = values[:whole].reshape(-1, size)
    assert (np.diff(runs, axis=1) == 1).all()
    assert (runs[:, 0] % size == 0).all()
    even = runs[: (len(runs) + 1) // 2, 0] // size
    assert (even % 2 == 0).all()
