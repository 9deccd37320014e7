"""The tabled factor of elliptic contacts against its formula, also where the table ends."""

import numpy as np
import pytest
import warp as wp

from tests.reference.capsule_contact import rounding
from warpfiber.laws.capsule_contact import make_capsule_contact
from warpfiber.laws.hertz_table import BITS, LEAST, OCTAVES
from warpfiber.model import precision


def factors(name: str, x: np.ndarray) -> np.ndarray:
    """T and d ln f / d ln P as the device has them."""
    p = precision(name)
    _, hertz_factor = make_capsule_contact(name)

    @wp.kernel(module="unique", enable_backward=False)
    def of_each(x: wp.array(dtype=p.real), out: wp.array(dtype=p.vec2)):  # type: ignore
        k = wp.tid()
        out[k] = hertz_factor(x[k])

    out = wp.zeros(len(x), dtype=p.vec2, device="cpu")
    wp.launch(
        of_each,
        len(x),
        [wp.array(x.astype(p.numpy), dtype=p.real, device="cpu"), out],
        device="cpu",
    )
    return out.numpy().astype(float)


def exact(x: float) -> tuple[float, float]:
    """The same from the restatement, for curvatures whose sum is 2; the slope by a complex step."""
    step = 1e-20
    product = x * (1.0 + 1j * step)
    large = 1.0 + np.sqrt(1.0 - product)
    f = rounding(product / large, large)
    return f.real * np.sqrt(x), f.imag / f.real / step


# Chebyshev's error next to the pole of F_2^-1.5 at x = 1.6e-4 is 40^-terms, elsewhere 66^-terms; as
# much as that float32 rounds
@pytest.mark.parametrize(("name", "tolerance"), [("float64", 1e-12), ("float32", 1e-6)])
def test_table(name: str, tolerance: float) -> None:
    """Anywhere in every piece."""
    rng = np.random.default_rng(5)
    pieces = [
        2.0**-octave * (1.0 + (rng.random(3) + n) / 2**BITS)
        for octave in range(1, max(OCTAVES) + 1)
        for n in range(2**BITS)
    ]
    z = np.concatenate([*pieces, [0.5]])
    x = np.concatenate([z[(z >= LEAST) & (z <= 0.5)], 1.0 - z[z > 2.0 ** -OCTAVES[1]], [LEAST]])
    x = x.astype(precision(name).numpy).astype(float)
    x = x[(x < 1.0)]
    expected = np.array([exact(value) for value in x])
    assert factors(name, x) == pytest.approx(expected, rel=tolerance)


def test_beyond_the_table() -> None:
    """Where powers are taken, on both sides of its borders, and where both curvatures are equal."""
    low, high = LEAST, 1.0 - 2.0 ** -OCTAVES[1]
    x = np.array([1.7e-4, 2.5e-4, low * (1 - 1e-12), low * (1 + 1e-12)])
    x = np.concatenate([x, [high - 1e-12, high + 1e-12, 1.0 - 2.0**-18, 1.0 - 2.0**-21]])
    # beyond it 1 - x and the slope of a power are differences of what is nearly equal
    expected = np.array([exact(value) for value in x])
    assert factors("float64", x) == pytest.approx(expected, rel=1e-10)
    assert factors("float64", np.array([1.0]))[0] == pytest.approx([1.0, -0.25])
