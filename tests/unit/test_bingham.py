"""Bingham directions: moments by another quadrature, exponents, exact draws, what is refused.

Tolerances: quadratures to rounding of their sums; five standard errors of draws; the acceptance of
moments in placement, 0.01, as for the other law.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.scene_text import GONE, changed, faults_of
from tests.unit.test_layers import small_cell
from warpfiber.placement import place_fibers, scene_cell, split_tables
from warpfiber.placement.bingham import bingham_exponents, bingham_moments, draw_bingham
from warpfiber.placement.orientations import draw_directions, orientation_tensor
from warpfiber.placement.populations import populations
from warpfiber.scene import scene_from_dict
from warpfiber.scene.statistics import FLATTEST, smallest_eigenvalue

TARGETS = [
    (0.36, 0.59, 0.05),
    (0.36, 0.62, 0.02),
    (1 / 3, 1 / 3, 1 / 3),
    (0.98, 0.0199, 0.0001),
    (0.4999, 0.5, 0.0001),
    (0.0001, 0.0001, 0.9998),
]


def sphere_moments(b: np.ndarray) -> np.ndarray:
    """<p_i^2> by midpoints in angle and height over the whole sphere, finer than any peak here."""
    angle = (np.arange(2000) + 0.5) * 2 * np.pi / 2000
    height = (np.arange(20_000) + 0.5) / 10_000 - 1.0
    total, weight = np.zeros(3), 0.0
    for z in np.array_split(height, 40):
        ring = np.sqrt(1.0 - z**2)[:, None]
        square = np.stack(
            [(ring * np.cos(angle)) ** 2, (ring * np.sin(angle)) ** 2, z[:, None] ** 2 + 0 * angle]
        )
        density = np.exp(np.tensordot(b, square, 1))
        total += np.sum(square * density, axis=(1, 2))
        weight += density.sum()
    return total / weight


def test_concentrated_moments() -> None:
    """Around an axis a_1 = a_2 -> 1 / (2 alpha): the next term is 1 / (2 alpha) of it."""
    for axis in range(3):
        b = np.full(3, -5000.0)
        b[axis] = 0.0
        got, _ = bingham_moments(b)
        np.testing.assert_allclose(np.delete(got, axis), 1e-4, rtol=2e-4)


@pytest.mark.parametrize("b", [(-1.0, 0.0, -20.0), (0.0, -3.0, -0.5)])
def test_moments_against_midpoints(b: tuple[float, float, float]) -> None:
    """The midpoints are (2e-4)^2 off in height."""
    got, fourth = bingham_moments(np.array(b))
    np.testing.assert_allclose(got, sphere_moments(np.array(b)), atol=1e-6)
    np.testing.assert_allclose(fourth.sum(axis=1), got, atol=1e-12)
    np.testing.assert_allclose(fourth, fourth.T, atol=1e-14)


@pytest.mark.parametrize("eigen", TARGETS)
def test_exponents_have_the_moments_asked(eigen: tuple[float, float, float]) -> None:
    b = bingham_exponents(np.array(eigen))
    np.testing.assert_allclose(bingham_moments(b)[0], eigen, atol=1e-12)
    assert b.max() == 0.0


def test_isotropic_fourth_moments() -> None:
    _, fourth = bingham_moments(np.zeros(3))
    np.testing.assert_allclose(fourth, (np.ones((3, 3)) + 2 * np.eye(3)) / 15.0, atol=1e-12)


def test_directions_in_a_plane_against_bessel_functions() -> None:
    """a1 - a2 = I_1(k) / I_0(k) with k = (b1 - b2) / 2, here by their series."""
    b = bingham_exponents(np.array([0.8, 0.2]))
    k = 0.5 * (b[0] - b[1])
    order0 = order1 = 0.0
    term = 1.0
    for n in range(60):
        order0 += term
        order1 += term * (0.5 * k) / (n + 1)
        term *= (0.5 * k) ** 2 / (n + 1) ** 2
    assert order1 / order0 == pytest.approx(0.6, rel=1e-10)


@pytest.mark.parametrize("eigen", TARGETS)
def test_draws_have_second_and_fourth_moments(eigen: tuple[float, float, float]) -> None:
    """The fourth ones tell it from the other law: for (.36, .62, .02) they differ by 0.02."""
    count = 40_000
    p = draw_bingham(np.array(eigen), count, np.random.default_rng(7))
    assert p.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), 1.0, rtol=1e-14)
    second, fourth = bingham_moments(bingham_exponents(np.array(eigen)))
    for i in range(3):
        for got, wanted in ((p[:, i] ** 2, second[i]), (p[:, i] ** 4, fourth[i, i])):
            assert abs(np.mean(got) - wanted) < 5 * np.std(got) / np.sqrt(count)
    assert np.max(np.abs(p.mean(axis=0))) < 5 / np.sqrt(count)


def test_what_is_flatter_than_resolved_is_as_flat_as_that() -> None:
    """Targets may be corrected below the least eigenvalue that a scene may ask for."""
    asked = np.array([1e-9, 0.4, 0.6])
    nearest = np.array([FLATTEST, 0.4, 0.6])
    np.testing.assert_array_equal(bingham_exponents(asked), bingham_exponents(nearest))


class Doubting:
    """Draws that take a direction only where its chance is more than one."""

    def __init__(self) -> None:
        self.rng, self.left = np.random.default_rng(5), 20

    def standard_normal(self, shape: tuple[int, ...]) -> np.ndarray:
        self.left -= 1
        if not self.left:
            raise TimeoutError
        return self.rng.standard_normal(shape)

    def random(self, count: int) -> np.ndarray:
        return np.full(count, 1.0 + 1e-9)


@pytest.mark.parametrize("eigen", [*TARGETS, (0.4, 0.6)])
def test_no_direction_has_a_chance_above_one(eigen: tuple[float, ...]) -> None:
    with pytest.raises(TimeoutError):
        draw_bingham(np.array(eigen), 1000, Doubting())  # type: ignore[arg-type]


def test_laws_differ_and_turn_with_the_tensor() -> None:
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    tensor = turn @ np.diag([0.36, 0.62, 0.02]) @ turn.T
    both = [draw_directions(tensor, 40_000, np.random.default_rng(2), law) @ turn
            for law in ("acg", "bingham")]  # fmt: skip
    for p in both:
        np.testing.assert_allclose(orientation_tensor(p), np.diag([0.36, 0.62, 0.02]), atol=0.013)
    tails = [float(np.mean(p[:, 2] ** 4)) for p in both]
    assert tails[0] > 2.0 * tails[1]


def test_planar_and_aligned_draws() -> None:
    rng = np.random.default_rng(3)
    flat = draw_directions(np.diag([0.7, 0.3, 0.0]), 20_000, rng, "bingham")
    assert np.max(np.abs(flat[:, 2])) == 0.0
    assert np.mean(flat[:, 0] ** 2) == pytest.approx(0.7, abs=5 * 0.5 / np.sqrt(20_000))
    line = draw_directions(np.diag([0.0, 1.0, 0.0]), 10, rng, "bingham")
    np.testing.assert_allclose(np.abs(line[:, 1]), 1.0)


# -- in a scene --------


def test_placed_fibers_have_the_law() -> None:
    """A plain group and a table of lengths: tensors, and a fourth moment half of the other law."""
    plain = changed({"fibers.0.count": 600}) | {"contact": {"law": "none", "strength": 1e-9}}
    plain["box"]["boundary"] = ["periodic"] * 3
    plain["fibers"][0] |= {"orientation": [0.36, 0.62, 0.02, 0, 0, 0], "orientation_law": "bingham"}
    placed = place_fibers(scene_from_dict(plain))
    first = placed.node_pos[placed.fiber_node_start[:-1]]
    last = placed.node_pos[placed.fiber_node_start[1:] - 1]
    p = (last - first) / np.linalg.norm(last - first, axis=1)[:, None]
    np.testing.assert_allclose(np.diag(orientation_tensor(p)), [0.36, 0.62, 0.02], atol=1e-6)
    _, fourth = bingham_moments(bingham_exponents(np.array([0.36, 0.62, 0.02])))
    assert np.mean(p[:, 2] ** 4) == pytest.approx(fourth[2, 2], rel=0.3)

    cell = small_cell(0.2)
    cell["fibers"][0]["orientation_law"] = "bingham"
    scene = split_tables(scene_from_dict(cell))
    [table] = populations(scene, scene_cell(scene), np.random.default_rng(1))
    drawn = table.drawn.direction
    np.testing.assert_allclose(np.diag(orientation_tensor(drawn)), [0.36, 0.62, 0.02], atol=0.006)
    assert np.mean(drawn[:, 2] ** 4) == pytest.approx(fourth[2, 2], rel=0.3)


def bad(**keys: Any) -> dict[str, Any]:
    tables = small_cell(0.02)
    tables["fibers"][0] |= {"orientation_law": "bingham"} | keys
    for name in [name for name, value in tables["fibers"][0].items() if value is GONE]:
        del tables["fibers"][0][name]
    return tables


@pytest.mark.parametrize(
    ("keys", "key", "remedy"),
    [
        ({"orientation_law": "binghm"}, "orientation_law", 'did you mean "bingham"'),
        (
            {"orientation": [0.5, 0.49999, 1e-5, 0, 0, 0]},
            "orientation",
            "smallest eigenvalue 1e-5",
        ),
        ({"orientation": [0.5, 0.6, -0.1, 0, 0, 0]}, "orientation", "eigenvalues must be >= 0"),
        ({"orientation": [0.5, 0.6, 0.1, 0, 0, 0]}, "orientation", "it must be 1"),
        (
            {
                "orientation": GONE,
                "volume_fraction": GONE,
                "layers": [
                    {
                        "thickness": 6e-4,
                        "volume_fraction": 0.02,
                        "orientation": [0.59999, 0.4, 1e-5, 0, 0, 0],
                    }
                ],
            },
            "layers",
            "law bingham takes 0",
        ),
    ],
)
def test_bad_targets(keys: dict[str, Any], key: str, remedy: str) -> None:
    faults = faults_of(bad(**keys))
    assert [fault.key for fault in faults] == [f"fibers.0.{key}"]
    assert remedy in faults[0].remedy
    flat = {"orientation": [0.5, 0.5, 0.0, 0, 0, 0]}
    assert scene_from_dict(bad(**flat)).fibers[0].orientation_law == "bingham"


def test_smallest_eigenvalue() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        a = rng.standard_normal((3, 3))
        a = a @ a.T / np.trace(a @ a.T)
        six = (a[0, 0], a[1, 1], a[2, 2], a[0, 1], a[0, 2], a[1, 2])
        assert smallest_eigenvalue(six) == pytest.approx(np.linalg.eigvalsh(a)[0], abs=1e-7)
    assert smallest_eigenvalue((1 / 3, 1 / 3, 1 / 3, 0, 0, 0)) == pytest.approx(1 / 3)
