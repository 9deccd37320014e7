"""Exact orientation of rigid fibers without contact: closed forms, directions, tabulated curves.

Tolerances: rounding of the exponential times the strain; five standard errors of 1e5 directions;
half a unit of the last printed digit of the table and as much for its 326 length classes.
"""

from __future__ import annotations

import numpy as np
import pytest

from warpfiber.placement.lengths import length_law
from warpfiber.placement.orientations import draw_directions, orientation_tensor
from warpfiber.placement.without_contact import (
    deformations,
    direction_tensors,
    population_tensors,
    shape_factor,
)
from warpfiber.scene import LengthDistribution

SHEAR = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
START = np.diag([0.36, 0.62, 0.02])


def lambda_of(aspect_ratio: float | np.ndarray) -> np.ndarray:
    """Of a rigid line of touching beads."""
    return shape_factor(np.sqrt(0.5 * (np.asarray(aspect_ratio) ** 2 + 1.0)))


def test_shape_factor_of_beads() -> None:
    n = np.array([2.0, 44.0, 210.0])
    np.testing.assert_allclose(lambda_of(n), (n**2 - 1) / (n**2 + 3), rtol=1e-14)


def test_deformation_against_closed_forms() -> None:
    """Thin rods deform with the fluid; ellipsoids turn by Jeffery's harmonic motion."""
    strain = np.array([0.0, 0.3, 7.0, 60.0])
    thin = deformations(SHEAR, [1.0], strain)[:, 0]
    np.testing.assert_allclose(thin, np.eye(3) + strain[:, None, None] * SHEAR, atol=1e-12)
    r_e = 5.0
    rate = r_e / (r_e**2 + 1.0)
    f = deformations(SHEAR, shape_factor([r_e]), strain)[:, 0]
    cos, sin = np.cos(rate * strain), np.sin(rate * strain)
    # eps of each of the 8 squarings, times the largest entry
    np.testing.assert_allclose(f[:, 0, 0], cos, atol=1e-12)
    np.testing.assert_allclose(f[:, 0, 2], r_e * sin, atol=1e-12)
    np.testing.assert_allclose(f[:, 2, 0], -sin / r_e, atol=1e-12)


def test_directions_follow_jefferys_equation() -> None:
    """Runge-Kutta of p' in a flow without symmetry; its error at 4000 steps is (1.5e-3)^4."""
    rng = np.random.default_rng(3)
    gradient = rng.standard_normal((3, 3))
    gradient -= np.eye(3) * np.trace(gradient) / 3.0
    p = draw_directions(START, 40, rng)
    factor = rng.uniform(0.5, 1.0, 40)
    spin, stretch = 0.5 * (gradient - gradient.T), 0.5 * (gradient + gradient.T)

    def rate(p: np.ndarray) -> np.ndarray:
        pulled = p @ stretch
        along = np.sum(pulled * p, axis=1)[:, None]
        return p @ spin.T + factor[:, None] * (pulled - along * p)

    moved, h = p.copy(), 6.0 / 4000
    for _ in range(4000):
        k1 = rate(moved)
        k2 = rate(moved + 0.5 * h * k1)
        k3 = rate(moved + 0.5 * h * k2)
        moved = moved + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + rate(moved + h * k3))
    weight = rng.uniform(0.5, 2.0, 40)
    got = direction_tensors(p, gradient, factor, weight, [0.0, 6.0])
    for exact, directions in zip(got, (p, moved), strict=True):
        expected = np.einsum("n,ni,nj->ij", weight, directions, directions) / weight.sum()
        np.testing.assert_allclose(exact, expected, atol=1e-9)


def test_population_comes_back_after_a_period() -> None:
    r_e = 14.16
    period = 2.0 * np.pi * (r_e + 1.0 / r_e)
    got = population_tensors(START, SHEAR, shape_factor([r_e]), [1.0], [0.5 * period, period])
    np.testing.assert_allclose(got, [START, START], atol=1e-9)


@pytest.mark.parametrize("strain", [2.0, 20.0, 60.0])
def test_population_against_directions(strain: float) -> None:
    """1e5 directions; a component of p p has a standard deviation of at most 1/2."""
    tensor = np.array([[0.4, 0.1, 0.05], [0.1, 0.5, -0.05], [0.05, -0.05, 0.1]])
    drawn = draw_directions(tensor, 100_000, np.random.default_rng(1))
    factor = np.where(np.arange(100_000) % 4 < 3, lambda_of(20.0), lambda_of(80.0))
    weight = np.ones(100_000)
    moved = direction_tensors(drawn, SHEAR, factor, weight, [strain])[0]
    classes = lambda_of(np.array([20.0, 80.0]))
    exact = population_tensors(tensor, SHEAR, classes, [3.0, 1.0], [strain])[0]
    assert np.max(np.abs(moved - exact)) < 5 * 0.5 / np.sqrt(100_000)
    assert abs(exact[0, 0] - tensor[0, 0]) > 0.05


def test_directions_need_no_distribution() -> None:
    """The start is that of the sample to rounding, whatever it is; halves of one sample add up."""
    p = draw_directions(START, 1000, np.random.default_rng(2))
    factor, weight = np.full(1000, 0.99), np.linspace(1.0, 2.0, 1000)
    got = direction_tensors(p, SHEAR, factor, np.ones(1000), [0.0])[0]
    np.testing.assert_allclose(got, orientation_tensor(p), atol=1e-14)
    whole = direction_tensors(p, SHEAR, factor, weight, [9.0])[0]
    parts = [
        direction_tensors(p[k], SHEAR, factor[k], weight[k], [9.0])[0] * weight[k].sum()
        for k in (slice(0, 300), slice(300, 1000))
    ]
    np.testing.assert_allclose(whole, sum(parts) / weight.sum(), atol=1e-14)


STRAINS = (0.0, 5.0, 10.0, 12.5, 20.0, 30.0, 40.0, 50.0, 60.0)
BY_LENGTH = (0.360, 0.399, 0.473, 0.507, 0.587, 0.646, 0.676, 0.690, 0.695)
BY_LENGTH_33 = (0.020, 0.016, 0.009, 0.007, 0.004, 0.003, 0.003, 0.003, 0.004)
BY_NUMBER = (0.360, 0.378, 0.440, 0.466, 0.520, 0.548, 0.556, 0.555, 0.552)


def test_curves_of_the_sliding_plate() -> None:
    """Mixed over the length law of the paper (L_N 0.83, L_W 1.53, at most 4 mm; d 19 um)."""
    asked = LengthDistribution(
        kind="lognormal",
        number_average=0.83e-3,
        weight_average=1.53e-3,
        maximum=4e-3,
        minimum=5e-5,
    )
    length = length_law(asked, 5e-5, 4e-3).sample(2000)
    factor = lambda_of(length / 19e-6)
    by_length = population_tensors(START, SHEAR, factor, length, STRAINS)
    np.testing.assert_allclose(by_length[:, 0, 0], BY_LENGTH, atol=1.1e-3)
    np.testing.assert_allclose(by_length[:, 2, 2], BY_LENGTH_33, atol=1.1e-3)
    by_number = population_tensors(START, SHEAR, factor, np.ones(2000), STRAINS)
    np.testing.assert_allclose(by_number[:, 0, 0], BY_NUMBER, atol=1.1e-3)


@pytest.mark.parametrize(
    ("aspect_ratio", "a11"),
    [(44.0, (0.360, 0.479, 0.599, 0.664, 0.696, 0.704, 0.691)), (80.0, (0.360, 0.484, 0.613, 0.691,
      0.740, 0.771, 0.791))],
)  # fmt: skip
def test_curves_of_one_length(aspect_ratio: float, a11: tuple[float, ...]) -> None:
    strains = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
    got = population_tensors(START, SHEAR, [lambda_of(aspect_ratio)], [1.0], strains)
    np.testing.assert_allclose(got[:, 0, 0], a11, atol=6e-4)


def test_start_in_a_plane_and_along_a_line() -> None:
    """Zero eigenvalues: planar fibers stay exact, aligned ones are one direction."""
    planar = population_tensors(np.diag([0.5, 0.5, 0.0]), SHEAR, [0.99], [1.0], [0.0, 30.0])
    np.testing.assert_allclose(planar[0], np.diag([0.5, 0.5, 0.0]), atol=1e-9)
    p = np.array([[np.cos(t), np.sin(t), 0.0] for t in (np.arange(20_000) + 0.5) * np.pi / 20_000])
    moved = direction_tensors(p, SHEAR, np.full(20_000, 0.99), np.ones(20_000), [30.0])
    np.testing.assert_allclose(planar[1], moved[0], atol=1e-7)
    line = population_tensors(np.diag([0.0, 0.0, 1.0]), SHEAR, [1.0], [1.0], [2.0])
    np.testing.assert_allclose(line[0], np.outer([2, 0, 1], [2, 0, 1]) / 5.0, atol=1e-7)
