"""Items of arrays without strides: what is read and written, in every type that sweeps use."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from warpfiber.model import precision
from warpfiber.passes.array_items import make_items

P = precision("float64")
SINGLE = precision("float32")
TYPES = [wp.int32, wp.uint8, P.real, P.vec3, P.vec4, P.mat33, SINGLE.vec3, wp.vec3d]


@pytest.mark.parametrize("kind", TYPES)
def test_items(kind: Any) -> None:
    """An item of one array becomes another item of a second one; the rest is left as it was."""
    read, write = make_items(kind)

    @wp.kernel(module="unique", enable_backward=False)
    def reverse(last: wp.int32, from_array: wp.array(dtype=kind), to_array: wp.array(dtype=kind)):  # type: ignore[valid-type]
        i = wp.tid()
        write(to_array, last - i, read(from_array, i))

    shape = (7, *np.shape(wp.zeros(1, dtype=kind, device="cpu").numpy())[1:])
    values = np.random.default_rng(3).integers(0, 200, shape).astype(float)
    given = wp.array(values, dtype=kind, device="cpu")
    found = wp.zeros(7, dtype=kind, device="cpu")
    wp.launch(reverse, 5, inputs=[5, given, found], device="cpu")
    expected = np.zeros(shape)
    expected[1:6] = values[:5][::-1]
    np.testing.assert_array_equal(found.numpy().astype(float), expected)
