"""[[wall]] with kind = "fiber_array": what is asked for, what is told, what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from tests.scene_text import changed, faults_of
from warpfiber.build import build
from warpfiber.scene import scene_from_dict
from warpfiber.scene.arrays import wall_arrays

ARRAY = {"name": "z-", "kind": "fiber_array", "diameter": 1e-5}


def tables(*walls: dict[str, Any], **changes: object) -> dict[str, Any]:
    """A cell of rods, 0.5 mm wide, walls across z."""
    keys: dict[str, object] = {
        "numerics.method": "rigid_rod",
        "numerics.segments": 1,
        "contact.lubrication": "none",
        "wall": list(walls),
    }
    return changed(keys | {key.replace("__", "."): value for key, value in changes.items()})


def test_arrays_of_a_whole_number_of_fibers() -> None:
    """50 of 10 um in 0.5 mm; on the device in radii of the first fibers (5 um)."""
    scene = scene_from_dict(tables(ARRAY, {**ARRAY, "name": "z+", "diameter": 2e-5}))
    assert not any("whole number" in note for note in scene.notes)
    shapes = wall_arrays(scene)
    assert shapes[:4] == ((0.0, 0.0),) * 4
    assert shapes[4] == pytest.approx((1e-5, 5e-6)) and shapes[5] == pytest.approx((2e-5, 1e-5))
    model, _, _ = build(scene, "cpu")
    assert model.domain.arrays[4] == pytest.approx((2.0, 1.0))
    again = scene_from_dict(scene.as_dict())
    assert wall_arrays(again) == shapes


def test_no_whole_number_is_told() -> None:
    """231 fibers of 19 um in 4.4 mm, 0.25 % apart, as in the sliding plate."""
    wall = {**ARRAY, "diameter": 1.9e-5}
    scene = scene_from_dict(tables(wall, box__size=[4.4e-3, 4.4e-3, 5e-4]))
    told = [note for note in scene.notes if "whole number" in note]
    assert len(told) == 1 and "231 stand 1.90476e-5 m apart, gaps of 0.25 %" in told[0]
    assert wall_arrays(scene)[4] == pytest.approx((4.4e-3 / 231, 9.5e-6))
    assert wall_arrays(scene_from_dict(tables())) == ()


@pytest.mark.parametrize(
    ("walls", "changes", "key", "words"),
    [
        ([{**ARRAY, "name": "top"}], {}, "wall.0.name", "z- z+"),
        ([{**ARRAY, "name": "x-"}], {"box.boundary": ["wall"] * 3}, "wall.0.name", "y- y+ z- z+"),
        ([ARRAY], {"box.boundary": ["periodic"] * 3}, "wall.0.name", "box.boundary"),
        ([ARRAY, ARRAY], {}, "wall.1.name", "wall.0"),
        ([{**ARRAY, "diameter": 1e-3}], {}, "wall.0.diameter", "wider than the box along y"),
        ([{**ARRAY, "velocity": [1, 0, 0]}], {}, "wall.0.velocity", '"flow"'),
        ([{**ARRAY, "friction": 0.3}], {}, "wall.0.friction", "contact.wall_friction"),
        ([{"name": "z-"}], {}, "wall.0.kind", "box.boundary"),
        (
            [ARRAY],
            {"numerics.method": "bead_chain"},
            "wall.0.kind",
            "overdamped or rigid_rod",
        ),
    ],
)
def test_refused(
    walls: list[dict[str, Any]], changes: dict[str, object], key: str, words: str
) -> None:
    """One clear fault with what to do."""
    given = tables(*walls, **{name.replace(".", "__"): value for name, value in changes.items()})
    faults = faults_of(given)
    assert key in [fault.key for fault in faults]
    assert any(words in fault.remedy for fault in faults if fault.key == key)
