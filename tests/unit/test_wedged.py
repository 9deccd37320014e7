"""Straight fibers too long to turn between plates: found as by their orbits, mirrored, told.

Tolerances: orbits on 4000 strains to a height of 1e-5, fibers nearer to the gap than that are left
out; tensors to 0.01, asked of the placement.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from tests.cell import isotropic
from tests.scene_text import GONE
from tests.unit.test_layers import GAP, RADIUS, plate_halves, small_cell, stack
from warpfiber.placement import place_fibers
from warpfiber.placement.layers import draw_fibers, measured
from warpfiber.placement.wedged import are_wedged
from warpfiber.scene import load_scene, scene_from_dict

FLAT_GAP = {"box__size": [1.2e-3, 1.2e-3, 3e-4]}


def rising_height(direction: np.ndarray, half: np.ndarray, rate: float) -> np.ndarray:
    """Most that each fiber stands up on the way down the flow, by its slender orbit itself."""
    tall = 2.0 * half * np.abs(direction[:, 2])
    for strain in np.geomspace(1e-4, 1e4, 4000):
        ahead = direction.copy()
        ahead[:, 0] += rate * strain * direction[:, 2]
        ahead /= np.linalg.norm(ahead, axis=1)[:, None]
        tall = np.maximum(tall, 2.0 * half * np.abs(ahead[:, 2]))
    return tall


@pytest.mark.parametrize("rate", [1.0, -1.0])
def test_wedged_are_those_whose_orbits_do_not_fit(rate: float) -> None:
    rng = np.random.default_rng(4)
    direction, gap = isotropic(rng, 3000), 1.0
    half = rng.uniform(0.2, 1.5, len(direction))
    tall = rising_height(direction, half, rate)
    fits_now = 2.0 * half * np.abs(direction[:, 2]) < gap
    clear = fits_now & (np.abs(tall - gap) > 1e-5)
    found = are_wedged(direction, half, gap, rate)
    np.testing.assert_array_equal(found[clear], tall[clear] > gap)
    assert 100 < np.count_nonzero(found[clear]) < 2000


def test_no_fiber_is_wedged_without_a_shear() -> None:
    direction = isotropic(np.random.default_rng(4), 100)
    assert not are_wedged(direction, np.full(100, 5.0), 1.0, 0.0).any()


@pytest.mark.parametrize("inside", [False, True])
def test_mirrored_fibers_keep_the_tensors(inside: bool) -> None:
    """The plate of long fibers: some are wedged as drawn, none where the shear is known."""
    half, gap = plate_halves(), GAP.size[2] - 2.0 * RADIUS  # type: ignore[index]
    asked = stack([(0.36, 0.62, 0.02)] * 10, inside)
    plain = draw_fibers(asked, half, RADIUS, GAP, 3)
    assert plain.mirrored == 0 and are_wedged(plain.direction, half, gap, 1.0).any()
    turned = draw_fibers(dataclasses.replace(asked, mirror=1.0), half, RADIUS, GAP, 3)
    assert turned.mirrored > 0
    assert not are_wedged(turned.direction, half, gap, 1.0).any()
    tensor, _ = measured(asked, turned, half)
    assert np.max(np.abs(tensor - asked.tensor)) < 0.01


def rod_cell(**keys: Any) -> dict[str, Any]:
    """Rods up to 1.1 mm long between planes 0.3 mm apart."""
    asked = {"numerics__method": "rigid_rod", "numerics__segment_length": GONE, **FLAT_GAP}
    return small_cell(0.03, **(asked | keys))


def test_wedged_rods_are_counted_and_told() -> None:
    with pytest.warns(RuntimeWarning, match="too long to turn between the walls"):
        report = place_fibers(scene_from_dict(rod_cell())).report["tables"][0]
    assert report["wedged"] > 0 and report["directions_mirrored"] == 0
    assert any("fibers.wedged" in line for line in report["missed"])


def test_no_rod_is_wedged_where_they_are_mirrored() -> None:
    report = place_fibers(scene_from_dict(rod_cell(fibers__0__wedged="mirror"))).report["tables"][0]
    assert report["wedged"] == 0 and report["directions_mirrored"] > 0
    assert not any("fibers.wedged" in line for line in report["missed"])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_chains_that_bend_are_counted_but_not_told() -> None:
    report = place_fibers(scene_from_dict(small_cell(0.03, **FLAT_GAP))).report["tables"][0]
    assert report["wedged"] > 0
    assert not any("fibers.wedged" in line for line in report["missed"])


def test_key_is_read_and_of_use_only_where_fibers_are_drawn() -> None:
    scene = scene_from_dict(rod_cell(fibers__0__wedged="mirror"))
    assert scene.fibers[0].wedged == "mirror"
    assert scene_from_dict(scene.as_dict()) == scene
    tables = small_cell(0.03)
    plain = {"diameter": 19e-6, "density": 4e9, "youngs_modulus": 3e10, "aspect_ratio": 10}
    tables["fibers"] = [plain | {"count": 60, "wedged": "mirror"}]
    notes = scene_from_dict(tables).notes
    assert any("wedged has no effect" in note for note in notes)


def test_long_rods_of_the_sliding_plate_are_mirrored() -> None:
    scene = load_scene("scenes/sliding_plate/half.toml")
    assert scene.numerics.method == "rigid_rod" and scene.fibers[0].wedged == "mirror"
