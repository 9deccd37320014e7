"""The scene: what a scene file says, read, completed and checked. Standard library only."""

from __future__ import annotations

from warpfiber.scene.faults import Fault, SceneError
from warpfiber.scene.overrides import parse_override
from warpfiber.scene.reading import load_scene, scene_from_dict
from warpfiber.scene.scene import Numerics, Record, Scene, Stage
from warpfiber.scene.tables import (
    Box,
    Contact,
    FiberGroup,
    Flow,
    Gravity,
    Layer,
    LengthDistribution,
    Load,
    Shape,
    Start,
    Wall,
)

__all__ = [
    "Scene",
    "load_scene",
    "scene_from_dict",
    "parse_override",
    "Box",
    "Flow",
    "FiberGroup",
    "Shape",
    "LengthDistribution",
    "Layer",
    "Contact",
    "Wall",
    "Gravity",
    "Load",
    "Start",
    "Stage",
    "Record",
    "Numerics",
    "Fault",
    "SceneError",
]
