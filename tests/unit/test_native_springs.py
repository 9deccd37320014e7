"""Constants of contacts in vectors: factor of Hertz by series, groups alike and unlike.

Bounds: the factor to 32 eps, its slope to as much of what it is the difference of; loads as of the
pair sweeps in `test_native_bonds`.
"""

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.bonded_crowd import COUNTS, RADIUS, SEGMENTS, STEP, crowd
from tests.reference.capsule_contact import rounding
from tests.unit.test_native_bonds import PAIR_BOUND, check_pairs
from tests.unit.test_native_kinks import plain_loads, vector_loads
from warpfiber.model import precision as numbers_of
from warpfiber.passes.executor import load_kernels
from warpfiber.passes.native import lane_types
from warpfiber.passes.native_capsule_powers import POWERS, power_constants

LANES = 16


def hertz_factors(precision: str, total: np.ndarray, root_product: np.ndarray) -> Any:
    """Factors and their slopes (n,) by vectors; n a multiple of LANES."""
    real = numbers_of(precision).real
    source = f"""
    auto work = [=]() __attribute__((noinline)) {{
    {lane_types(precision, LANES)}
    {power_constants(precision)}
    {POWERS}
    for (int at = 0; at < total.shape[0]; at += W) {{
        V sum, product, slope;
        __builtin_memcpy(&sum, total.data + at, sizeof(V));
        __builtin_memcpy(&product, root_product.data + at, sizeof(V));
        const V factor = hertz_factor(sum, product, slope);
        __builtin_memcpy(factors.data + at, &factor, sizeof(V));
        __builtin_memcpy(slopes.data + at, &slope, sizeof(V));
    }}
    }};
    work();
    """

    @wp.func_native(source)
    def factors_of(
        total: wp.array(dtype=real),
        root_product: wp.array(dtype=real),
        factors: wp.array(dtype=real),
        slopes: wp.array(dtype=real),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def find(
        total: wp.array(dtype=real),
        root_product: wp.array(dtype=real),
        factors: wp.array(dtype=real),
        slopes: wp.array(dtype=real),
    ):
        factors_of(total, root_product, factors, slopes)

    given = [wp.array(values, dtype=real, device="cpu") for values in (total, root_product)]
    found = [wp.zeros(len(total), dtype=real, device="cpu") for _ in range(2)]
    wp.launch(find, 1, [*given, *found], device="cpu")
    return [array.numpy().astype(float) for array in found]


@pytest.mark.parametrize("precision", PAIR_BOUND)
def test_hertz_factor(precision: str) -> None:
    """Curvatures from nearly equal ones to those of nearly parallel cylinders."""
    rng = np.random.default_rng(7)
    kind = numbers_of(precision).numpy
    sine = 10.0 ** rng.uniform(np.log10(0.02), 0.0, size=4096)
    other = rng.uniform(0.3, 1.0, size=len(sine))  # curvature, the first one is 1
    total = (1.0 + other).astype(kind).astype(float)
    root_product = np.minimum(np.sqrt(other) * sine, 0.499 * total).astype(kind).astype(float)
    difference = np.sqrt((total - 2.0 * root_product) * (total + 2.0 * root_product))
    small, large = 0.5 * (total - difference), 0.5 * (total + difference)
    small = root_product**2 / large  # not as a difference
    expected = rounding(small, large)
    factors, slopes = hertz_factors(precision, total, root_product)
    eps = numbers_of(precision).eps
    assert np.abs(factors / expected - 1.0).max() < 32.0 * eps
    change = 1e-5  # central differences of the restatement: change^2 and 1e-16 / change
    sides = []
    for side in (-1.0, 1.0):
        product = root_product**2 * np.exp(side * change)
        split = np.sqrt(np.maximum(total**2 - 4.0 * product, 0.0))
        upper = 0.5 * (total + split)
        sides.append(np.log(rounding(product / upper, upper)))
    expected_slopes = (sides[1] - sides[0]) / (2.0 * change)
    away = difference > 0.1 * total
    error = np.abs(slopes - expected_slopes)[away] / np.abs(expected_slopes)[away]
    assert error.max() < max(1e-7, 4096.0 * eps)


def unlike(precision: str) -> Any:
    """A kinked crowd of two groups with springs, masses and radii of their own."""
    rows = [
        {
            "count": count,
            "centerline_length": STEP * segments,
            "bond_damping": 0.0335,
            "diameter": diameter,
            "density": density,
            "youngs_modulus": modulus,
        }
        for segments, count, diameter, density, modulus in zip(
            SEGMENTS, COUNTS, (2.0 * RADIUS, 1.6 * RADIUS), (1340, 900), (7.5e5, 4e5), strict=True
        )
    ]
    return crowd(precision, fibers=rows)


@pytest.mark.parametrize("precision", PAIR_BOUND)
def test_unlike_groups(precision: str) -> None:
    """What pairs do, friction and dashpots with it, and loads of nodes: as pair by pair."""
    sim = unlike(precision)
    sim.prepare()
    method: Any = sim.method
    radii = method.groups.numpy()["radius"]
    assert radii[0] != radii[1]
    method.contacts.allocate_scratch()
    expected, marks = plain_loads(sim)
    assert (marks != 0).sum() > 20
    found = vector_loads(sim)
    assert np.abs(found - expected).max() < PAIR_BOUND[precision] * np.abs(expected).max()
    check_pairs(sim, precision)
    sim.close()


@pytest.mark.parametrize("precision", PAIR_BOUND)
def test_groups_alike(precision: str) -> None:
    """Two groups with the same constants or one: the same bits."""
    sim = crowd(precision)
    sim.prepare()
    method: Any = sim.method
    groups = method.groups.numpy()
    for name in ("radius", "compliance", "shear_compliance", "mass", "end_mass"):
        assert groups[name][0] == groups[name][1], name
    native = method.native
    found = []
    for kept in (method.groups, method.groups[:1]):
        native.contact_touch.zero_()
        launch = native.pair_launch(method.dt, keeps=True)
        place = next(n for n, given in enumerate(launch.inputs) if given is method.groups)
        launch.inputs[place] = kept
        load_kernels([launch.kernel], "cpu")
        launch.run("cpu")
        touched = native.contact_touch.numpy().copy()
        acts = method.contacts.acts.numpy().astype(bool)
        found.append((touched, acts, method.contacts.force.numpy()[acts]))
    assert found[0][1].sum() > 10
    for two, one in zip(*found, strict=True):
        np.testing.assert_array_equal(one, two)
    sim.close()
