"""Stages that move a wall: what is read, and what is refused before anything is written."""

from __future__ import annotations

import tomllib

import pytest

from tests.scene_text import GONE, faults_of
from warpfiber.scene import Scene, SceneError, scene_from_dict
from warpfiber.scene.pressing import pressed_axis, wall_side

BED = """
[box]
size = [0.06, 0.06, 0.3]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 300
centerline_length = 0.06283
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
[[stage]]
name = "load"
kind = "compress"
wall = "z+"
speed = 0.1
end_volume_fraction = 0.41
[[stage]]
kind = "unload"
wall = "z+"
speed = 0.1
end_pressure = 0
repeat_from = "load"
repeat = 3
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
    """Three cycles; a wall bounds its stage by the time in which it passes the box."""
    scene = bed({})
    assert [stage.kind for stage in scene.stage_sequence] == ["compress", "unload"] * 3
    load, unload = scene.stages
    assert (load.wall, load.speed, load.control) == ("z+", 0.1, "displacement")
    assert load.time_limit == pytest.approx(0.3 / 0.1, rel=1e-15) == unload.time_limit
    assert (load.end_volume_fraction, unload.end_pressure) == (0.41, 0.0)
    assert pressed_axis(scene) == 2
    assert wall_side(load) == 1
    assert wall_side(bed({"stage.0.wall": "z-"}).stages[0]) == 0
    assert scene_from_dict(scene.as_dict()) == scene


def test_a_loaded_wall() -> None:
    """The limit is the time of the way and of the load; without an end of it that of all stages."""
    load: dict[str, object] = {"stage.0.control": "load", "stage.0.pressure_rate": 100.0}
    pressed = {"stage.0.end_pressure": 500.0, "stage.0.end_volume_fraction": GONE}
    stage = bed(load | pressed).stages[0]
    assert (stage.control, stage.pressure_rate) == ("load", 100.0)
    assert stage.time_limit == pytest.approx(0.3 / 0.1 + 5.0, rel=1e-12)
    assert bed(load).stages[0].time_limit == 100.0
    long = bed(load | {"stage.0.end_time": 4.0})  # a led wall would leave the box
    assert long.stages[0].end_time == 4.0


SETTLE = {"kind": "settle", "end_time": 1.0}


def test_what_is_metered() -> None:
    """Without a moving wall `stress` meters the last axis with walls, else nothing is metered."""
    assert pressed_axis(bed({"stage": [SETTLE]})) == 2
    assert pressed_axis(bed({"stage": [SETTLE], "record.quantities": ["overlap"]})) == -1
    sides = {"stage": [SETTLE], "box.boundary": ["wall", "open", "open"]}
    assert pressed_axis(bed(sides)) == 0


REFUSED: list[tuple[dict[str, object], str, str]] = [
    ({"stage.0.wall": "y+"}, "stage.0.wall", 'the box has "z-", "z+"'),
    ({"stage.0.wall": "top"}, "stage.0.wall", "no such wall"),
    ({"stage.0.wall": GONE}, "stage.0.wall", "missing"),
    ({"stage.0.speed": GONE}, "stage.0.speed", "missing"),
    ({"stage.0.speed": 0}, "stage.0.speed", "> 0"),
    ({"stage.0.control": "load"}, "stage.0.pressure_rate", "missing with control = load"),
    ({"stage.0.control": "force"}, "stage.0.control", "displacement"),
    ({"stage.0.pressure_rate": 10.0}, "stage.0.pressure_rate", 'add control = "load"'),
    ({"stage.0.end_volume_fraction": 0.05}, "stage.0.end_volume_fraction", "already"),
    ({"stage.1.end_volume_fraction": 0.05}, "stage.1.end_volume_fraction", "never reached"),
    ({"stage.0.end_pressure": 0}, "stage.0.end_pressure", "met from the start"),
    ({"stage.0.end_speed": 1e-3}, "stage.0.end_speed", "end_pressure or end_time"),
    ({"stage": [SETTLE | {"end_pressure": 9}]}, "stage.0.end_pressure", "never end"),
    (
        {"stage": [{"kind": "compress", "wall": "z+", "speed": 0.1, "end_time": 3.1}]},
        "stage.0.end_time",
        "leave the box; end within 3 s",
    ),
    (
        {"stage": [{"kind": "compress", "wall": "z+", "speed": 0.1}]},
        "stage.0",
        "end_volume_fraction",
    ),
    (
        {"box.boundary": ["periodic", "wall", "wall"], "stage.1.wall": "y+"},
        "stage.1.wall",
        "one axis",
    ),
    (
        {"box.boundary": ["periodic"] * 3, "stage": [SETTLE]},
        "record.quantities",
        'make an axis "wall"',
    ),
]


@pytest.mark.parametrize(("changes", "key", "advice"), REFUSED)
def test_what_is_refused(changes: dict[str, object], key: str, advice: str) -> None:
    """One fault, of the key that is wrong, with a remedy."""
    faults = faults_of(tables(changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert advice in str(faults[0])


def test_other_methods_know_no_pressure() -> None:
    """Chains in a flow refuse the ends of pressing stages and the pressure on walls."""
    flow = {"kind": "rest", "viscosity": 1.0}
    made = tables({"stage": [{"kind": "flow", "end_time": 1.0, "end_pressure": 1.0}]})
    made |= {"flow": flow, "numerics": {"method": "bead_chain", "segments": 3}}
    with pytest.raises(SceneError) as caught:
        scene_from_dict(made)
    keys = {fault.key for fault in caught.value.faults}
    assert {"stage.0.end_pressure", "record.quantities"} <= keys
