"""Stages that grip a bed: what is read, and what is refused before anything is written."""

from __future__ import annotations

import tomllib

import pytest

from tests.scene_text import GONE, faults_of
from warpfiber.scene import Scene, scene_from_dict
from warpfiber.scene.gripping import drawn_axis, free_height, grips

BED = """
[box]
size = [0.06, 0.06, 0.3]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 500
centerline_length = 0.06283
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
[[stage]]
kind = "settle"
end_time = 1
[[stage]]
kind = "pull"
freeze_below = 0.04
freeze_above = 0.05
speed = 0.1
end_strain = 2
[[stage]]
kind = "shear"
freeze_below = 0.03
freeze_above = 0.08
freeze = "nodes"
speed = 0.1
end_time = 1
[record]
quantities = ["stress"]
[numerics]
method = "bonded_spheres"
segments = 26
"""


def bed(changes: dict[str, object]) -> Scene:
    """The scene with dotted keys changed or removed."""
    return scene_from_dict(tables(changes), "cell.toml")


def tables(changes: dict[str, object]) -> dict[str, object]:
    """Its tables."""
    made = tomllib.loads(BED)
    for key, value in changes.items():
        *path, name = key.split(".")
        node = made
        for part in path:
            node = node[int(part)] if isinstance(node, list) else node[part]
        if value is GONE:
            del node[name]
        else:
            node[name] = value
    return made


def test_what_is_read() -> None:
    """Whole fibers by default; a strain is a time; the first of the two ends the stage."""
    scene = bed({})
    _, pull, shear = scene.stages
    assert (pull.freeze, shear.freeze) == ("fibers", "nodes")
    assert (drawn_axis(pull), drawn_axis(shear)) == (2, 0)
    assert free_height(pull) == pytest.approx(0.01, rel=1e-12)
    assert pull.end_time == pytest.approx(2 * 0.01 / 0.1, rel=1e-12)
    assert pull.time_limit is None is shear.time_limit
    assert grips(scene) and not grips(bed({"stage": [{"kind": "settle", "end_time": 1}]}))
    assert bed({"stage.1.end_time": 0.1}).stages[1].end_time == 0.1
    assert bed({"stage.1.end_time": 1}).stages[1].end_time == pull.end_time
    assert scene_from_dict(scene.as_dict()) == scene


def test_open_above() -> None:
    """Without walls the stress is that of the grips."""
    scene = bed({"box.boundary": ["periodic", "periodic", "open"], "gravity": GONE})
    assert scene.record.quantities == ("stress",)


REFUSED: list[tuple[dict[str, object], str, str]] = [
    ({"stage.1.freeze_below": GONE}, "stage.1.freeze_below", "missing with kind = pull"),
    ({"stage.2.freeze_above": GONE}, "stage.2.freeze_above", "missing with kind = shear"),
    ({"stage.1.speed": GONE}, "stage.1.speed", "missing"),
    ({"stage.1.speed": 0}, "stage.1.speed", "> 0"),
    ({"stage.1.freeze_above": 0.04}, "stage.1.freeze_above", "no free height"),
    ({"stage.1.freeze": "all"}, "stage.1.freeze", "nodes"),
    ({"stage.1.end_speed": 0.1}, "stage.1.end_speed", "end_strain or end_time"),
    ({"stage.1.end_pressure": 1}, "stage.1.end_pressure", "end_strain or end_time"),
    ({"stage.2.end_volume_fraction": 0.3}, "stage.2.end_volume_fraction", "end_strain or"),
    ({"stage.1.end_strain": GONE}, "stage.1", "at least one"),
]


@pytest.mark.parametrize(("changes", "key", "advice"), REFUSED)
def test_what_is_refused(changes: dict[str, object], key: str, advice: str) -> None:
    """One fault, of the key that is wrong, with a remedy."""
    faults = faults_of(tables(changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert advice in str(faults[0])


def test_a_bed_has_an_end() -> None:
    """Both stages are told that z must not be periodic, or that there is no box."""
    faults = faults_of(tables({"box.boundary": ["periodic"] * 3}))
    assert [fault.key for fault in faults] == ["stage.1.kind", "stage.2.kind"]
    assert 'make z "wall" or "open"' in str(faults[0])
    faults = faults_of(tables({"box": GONE, "fibers.0.count": 1}))
    assert {"stage.1.kind", "stage.2.kind"} <= {fault.key for fault in faults}
    assert "needs the area" in str(faults)
