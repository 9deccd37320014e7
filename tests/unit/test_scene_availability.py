"""Scenes of later versions: every key of the schema is known, what cannot run yet says so."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from warpfiber.scene import Fault, SceneError, scene_from_dict

GONE = object()
"""Marks a key that a case removes."""

BONDED_SPHERES = """
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
bond_damping = 0.0335
shape = { kind = "s", curvature = 100 }
[contact]
friction = 1.4
wall_friction = 0.6
damping = 0.113
[[stage]]
kind = "settle"
damping = 8
end_speed = 1e-3
save = true
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
[numerics]
method = "bonded_spheres"
segments = 26
"""


def cell() -> dict[str, Any]:
    """Return the tables of a shear cell that loads."""
    return {
        "box": {"size": [5e-4, 5e-4, 5e-4], "boundary": ["periodic", "periodic", "wall"]},
        "flow": {"kind": "simple_shear", "shear_rate": 100, "viscosity": 100},
        "fibers": [
            {
                "aspect_ratio": 20,
                "diameter": 1e-5,
                "count": 10,
                "density": 4e9,
                "youngs_modulus": 3e10,
            }
        ],
        "contact": {"lubrication": "paper"},
        "stage": [{"kind": "flow", "end_strain": 60}],
        "numerics": {"method": "bead_chain", "segments": 3},
    }


def changed(changes: dict[str, object]) -> dict[str, Any]:
    """Return the tables of the cell with dotted keys changed or removed."""
    tables = cell()
    for key, value in changes.items():
        *path, name = key.split(".")
        node: Any = tables
        for part in path:
            node = node[int(part)] if isinstance(node, list) else node.setdefault(part, {})
        if value is GONE:
            del node[name]
        else:
            node[name] = value
    return tables


def faults_of(tables: dict[str, Any], **overrides: object) -> tuple[Fault, ...]:
    """Return the faults of tables; fails if they load."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    with pytest.raises(SceneError) as caught:
        scene_from_dict(tables, "cell.toml", keys)
    return caught.value.faults


NOT_YET: list[tuple[dict[str, object], str]] = [
    ({"numerics.method": "overdamped"}, "numerics.method"),
    ({"numerics.method": "auto"}, "numerics.method"),
    ({"numerics.contact": "unilateral"}, "numerics.contact"),
    ({"flow.kind": "field", "flow.file": "a.npz"}, "flow.kind"),
    ({"fibers.0.count": GONE, "fibers.0.layers": "layers.csv"}, "fibers.0.layers"),
    ({"fibers.0.frozen": True}, "fibers.0.frozen"),
    ({"fibers.0.inextensible": True}, "fibers.0.inextensible"),
    ({"fibers.0.shape": {"kind": "ring"}}, "fibers.0.shape.kind"),
    ({"contact.law": "linear", "contact.stiffness": 1}, "contact.law"),
    ({"contact.friction": 0.3}, "contact.friction"),
    ({"contact.wall_friction": 0.3}, "contact.wall_friction"),
    ({"wall": [{"name": "z+", "velocity": [1, 0, 0]}]}, "wall"),
    ({"load": [{"force": [1, 0, 0]}]}, "load"),
    ({"stage.0.save": True}, "stage.0.save"),
    ({"stage.0.kind": "settle"}, "stage.0.kind"),
    ({"record.quantities": ["stress"]}, "record.quantities"),
    ({"record.layers": 5}, "record.layers"),
]


@pytest.mark.parametrize(("changes", "key"), NOT_YET)
def test_known_but_not_in_this_version(changes: dict[str, object], key: str) -> None:
    """Keys of later versions are known, and told to be not available with an alternative."""
    faults = faults_of(changed(changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert "not available in this version; " in faults[0].remedy


def test_start_is_known() -> None:
    """[start] is not available, and does not go with [[fibers]] and [box]."""
    faults = faults_of(changed({"start": {"from": "results/a", "stage": "load"}}))
    assert [fault.key for fault in faults] == ["start", "fibers", "box"]


def test_length_distribution_is_known() -> None:
    """A length distribution is read whole and told to be not available."""
    weibull = {"kind": "weibull", "number_average": 1e-3, "weight_average": 2e-3}
    changes: dict[str, object] = {"fibers.0.aspect_ratio": GONE}
    faults = faults_of(changed(changes | {"fibers.0.length_distribution": weibull}))
    assert [fault.key for fault in faults] == ["fibers.0.length_distribution"]


def test_bonded_spheres_scene_has_only_known_keys() -> None:
    """A scene of a later version is refused for that reason alone."""
    faults = faults_of(tomllib.loads(BONDED_SPHERES))
    assert len(faults) == 11
    assert all("not available in this version" in fault.remedy for fault in faults)
