"""Directions of fibers: Carlson's integral, moments of the distribution, draws, matched samples.

Tolerances: published digits; rounding of the fixed point; five standard errors of random draws.
"""

from __future__ import annotations

import numpy as np
import pytest

from warpfiber.placement.orientations import (
    acg_covariance,
    acg_moments,
    carlson_rd,
    draw_directions,
    match_moments,
    orientation_tensor,
    tensor_from_values,
)


def test_carlson_integral_against_its_closed_forms() -> None:
    assert carlson_rd(2.0, 2.0, 2.0) == pytest.approx(2.0**-1.5, rel=1e-15)
    # R_D(0, 2, 1) is a published check value.
    assert carlson_rd(0.0, 2.0, 1.0) == pytest.approx(1.7972103521033883, rel=1e-14)
    assert carlson_rd(2.0, 3.0, 4.0) == pytest.approx(0.16510527294261053, rel=1e-14)


@pytest.mark.parametrize(
    "eigen",
    [
        (0.36, 0.59, 0.05),
        (0.86, 0.11, 0.03),
        (1 / 3, 1 / 3, 1 / 3),
        (0.999, 0.0009, 0.0001),
        (0.5, 0.5 - 1e-7, 1e-7),
        (0.98, 0.02, 0.0),
        (1.0, 0.0, 0.0),
    ],
)
def test_covariance_has_the_moments_asked(eigen: tuple[float, float, float]) -> None:
    moments = acg_moments(acg_covariance(np.array(eigen)))
    np.testing.assert_allclose(moments, eigen, atol=1e-12)


@pytest.mark.parametrize(
    "values",
    [
        (1 / 3, 1 / 3, 1 / 3, 0, 0, 0),
        (0.36, 0.62, 0.02, 0, 0, 0),
        (0.4, 0.4, 0.2, 0.1, 0.05, -0.1),
        (0.5, 0.5, 0, 0.2, 0, 0),
    ],
)
def test_drawn_and_matched_moments(values: tuple[float, ...]) -> None:
    asked = tensor_from_values(values)
    drawn = draw_directions(asked, 20000, np.random.default_rng(5))
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0, rtol=1e-14)
    # Each component of p p is at most 1, its standard deviation at most 1/2.
    assert np.max(np.abs(orientation_tensor(drawn) - asked)) < 5 * 0.5 / np.sqrt(20000)
    for count in (20, 500):
        matched = match_moments(drawn[:count], asked)
        np.testing.assert_allclose(orientation_tensor(matched), asked, atol=1e-10)
        assert np.mean(np.sum(matched * drawn[:count], axis=1)) > 0.9


def test_isotropic_fourth_moments() -> None:
    p = draw_directions(np.eye(3) / 3.0, 20000, np.random.default_rng(6))
    assert np.mean(p[:, 2] ** 4) == pytest.approx(0.2, abs=5 * 0.27 / np.sqrt(20000))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((0.5, 0.5, 0.1, 0, 0, 0), "must be 1"),
        ((0.5, 0.5, 0.0, 0.6, 0, 0), "negative"),
        ((1.0, np.nan, 0.0, 0, 0, 0), "six numbers"),
        ((1.0, 0.0, 0.0), "six numbers"),
    ],
)
def test_impossible_tensors(values: tuple[float, ...], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        tensor_from_values(values)
