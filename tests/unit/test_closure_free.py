"""Folgar-Tucker diffusion without a closure: steady states, limits, directions by random walks.

Tolerances: tabulated to 4 digits; five standard errors of random walks; the step's own 1e-5.
"""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("scipy")

from warpfiber.output.closure_free import DEGREE, Diffusion, harmonics  # noqa: E402
from warpfiber.placement.orientations import draw_directions, orientation_tensor  # noqa: E402
from warpfiber.placement.without_contact import population_tensors, split_gradient  # noqa: E402

SHEAR = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
ISOTROPIC = np.eye(3) / 3.0


@pytest.mark.parametrize(
    ("r_e", "expected"),
    [(np.inf, (0.7271, 0.1806, 0.0923, 0.0748)), (14.16, (0.7168, 0.1876, 0.0956, 0.0697))],
)
def test_steady_shear(r_e: float, expected: tuple[float, ...]) -> None:
    """C_I = 0.01: a11, a22, a33, a13 of an independent expansion up to degree 40."""
    factor = 1.0 if np.isinf(r_e) else (r_e**2 - 1.0) / (r_e**2 + 1.0)
    a = Diffusion(ISOTROPIC, SHEAR, factor).tensors(0.01, np.array([0.0, 150.0]))[-1]
    np.testing.assert_allclose([a[0, 0], a[1, 1], a[2, 2], a[0, 2]], expected, atol=6e-5)
    assert np.trace(a) == pytest.approx(1.0, abs=1e-10)


def test_diffusion_alone() -> None:
    """At rest A goes to I/3 as exp(-6 C_I strain), whatever the distribution."""
    start = np.array([[0.5, 0.1, 0.05], [0.1, 0.3, -0.02], [0.05, -0.02, 0.2]])
    strain = np.linspace(0.0, 20.0, 5)
    got = Diffusion(start, np.zeros((3, 3)), 1.0).tensors(0.02, strain)
    decay = np.exp(-6.0 * 0.02 * strain)[:, None, None]
    np.testing.assert_allclose(got, ISOTROPIC + (start - ISOTROPIC) * decay, atol=1e-4)


def test_flow_alone() -> None:
    """Without diffusion the exact tensor, in a flow of every direction, until peaks grow sharp."""
    gradient = np.random.default_rng(5).standard_normal((3, 3))
    gradient -= np.eye(3) * np.trace(gradient) / 3.0
    strain = np.linspace(0.0, 0.4, 5)
    got = Diffusion(ISOTROPIC, gradient, 0.9).tensors(0.0, strain)
    exact = population_tensors(ISOTROPIC, gradient, [0.9], [1.0], strain)
    assert np.max(np.abs(exact[-1] - ISOTROPIC)) > 0.1
    np.testing.assert_allclose(got, exact, atol=2e-4)


def test_against_random_walks() -> None:
    """20,000 directions in shear with random turns of variance 2 C_I per strain and axis.

    Euler steps of 0.01 are 0.01 / 2 of a rate below 1 off; five standard errors are 0.018.
    """
    start = np.diag([0.36, 0.54, 0.1])
    rng = np.random.default_rng(8)
    p, c_i, h = draw_directions(start, 20_000, rng), 0.02, 0.01
    spin, stretch = split_gradient(SHEAR)
    for _ in range(400):
        pulled = p @ stretch
        rate = p @ spin.T + pulled - np.sum(pulled * p, axis=1)[:, None] * p
        p = p + h * rate + np.sqrt(2.0 * c_i * h) * rng.standard_normal(p.shape)
        p /= np.linalg.norm(p, axis=1)[:, None]
    got = Diffusion(start, SHEAR, 1.0).tensors(c_i, np.array([0.0, 4.0]))[-1]
    np.testing.assert_allclose(orientation_tensor(p), got, atol=0.018)
    assert np.max(np.abs(got - start)) > 0.1


def test_harmonics_are_orthonormal_and_their_slopes_are_slopes() -> None:
    node, weight = np.polynomial.legendre.leggauss(DEGREE + 2)
    phi = 2.0 * np.pi * (np.arange(2 * DEGREE + 4) + 0.3) / (2 * DEGREE + 4)
    ring = np.sqrt(1.0 - node**2)[:, None]
    p = np.stack([ring * np.sin(phi), node[:, None] + 0 * phi, ring * np.cos(phi)], axis=-1)
    value, _, _ = harmonics(p.reshape(-1, 3))
    area = np.repeat(weight * 2.0 * np.pi / len(phi), len(phi))
    np.testing.assert_allclose((value * area[:, None]).T @ value, np.eye(861), atol=1e-11)
    theta, angle, h = np.array([0.4, 1.3, 2.8]), np.array([0.1, 2.0, -1.5]), 1e-5

    def at(t: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(t) * np.sin(a), np.cos(t), np.sin(t) * np.cos(a)], axis=1)

    _, slope, around = harmonics(at(theta, angle))
    numeric = (harmonics(at(theta + h, angle))[0] - harmonics(at(theta - h, angle))[0]) / (2 * h)
    # h^2 DEGREE^3 of the third derivative
    np.testing.assert_allclose(slope, numeric, atol=2e-5)
    numeric = (harmonics(at(theta, angle + h))[0] - harmonics(at(theta, angle - h))[0]) / (2 * h)
    np.testing.assert_allclose(around, numeric / np.sin(theta)[:, None], atol=5e-5)
