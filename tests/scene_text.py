"""Scenes that several tests start from: as TOML text, and as tables with keys to change."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from warpfiber.scene import Fault, Scene, SceneError, scene_from_dict

SHEAR_CELL = """
[box]
size = [5e-4, 5e-4, 5e-4]
boundary = ["periodic", "periodic", "wall"]
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
aspect_ratio = 20
diameter = 1e-5
volume_fraction = 0.056
density = 4e9
youngs_modulus = 3.26e10
[contact]
lubrication = "paper"
[[stage]]
kind = "flow"
end_strain = 60
[record]
quantities = ["orientation", "interactions"]
[numerics]
method = "bead_chain"
segments = 3
"""

ONE_FIBER = """
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
count = 1
aspect_ratio = 50
diameter = 1e-5
density = 4e9
youngs_modulus = 5e8
orientation = "aligned"
[contact]
law = "none"
[[stage]]
kind = "flow"
end_strain = 160
[numerics]
method = "bead_chain"
segments = 49
"""


def read(text: str, **overrides: object) -> Scene:
    """Return the scene of a TOML text; `a__b=1` overrides the key a.b."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return scene_from_dict(tomllib.loads(text), "scene.toml", keys)


def cell(**overrides: object) -> Scene:
    """Return the shear cell with overrides."""
    return read(SHEAR_CELL, **overrides)


def fiber(**overrides: object) -> Scene:
    """Return the single fiber with overrides."""
    return read(ONE_FIBER, **overrides)


GONE = object()
"""Marks a key that a case removes."""


def cell_tables() -> dict[str, Any]:
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
    tables = cell_tables()
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
