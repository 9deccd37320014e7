"""The whole scene: what is simulated, what is recorded and how it is solved; its dict and its hash.

`Scene.as_dict` gives JSON-ready tables with every default resolved, so that a result file tells
exactly what was run; `scene_from_resolved` makes the same `Scene` from it again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from warpfiber.scene.faults import Fault, SceneError
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


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One `[[stage]]`: what happens until its first end condition, counted from its start."""

    kind: str
    """flow, settle, pour, compress, unload, pull, shear"""
    name: str
    """the kind, if none was given"""
    save: bool = False
    end_strain: float | None = None
    end_time: float | None = None
    """s"""
    end_speed: float | None = None
    """m/s"""
    end_volume_fraction: float | None = None
    end_pressure: float | None = None
    """Pa"""
    time_limit: float | None = None
    """s; None where end_strain or end_time ends the stage"""
    wall: str | None = None
    """of the box, that moves in compress and unload: z+ and the like"""
    speed: float | None = None
    """m/s, of that wall (under a load at most), or of the upper grip"""
    control: str | None = None
    """displacement; load: the pressure on the wall changes at `pressure_rate`"""
    pressure_rate: float | None = None
    """Pa/s"""
    damping: float = 0.0
    """1/s on the velocities of the nodes, of `settle` and `pour`"""
    interval: float = 0.0
    """s from batch to batch that is poured"""
    batch: int = 1
    """fibers that are poured at a time"""
    freeze_below: float | None = None
    """m, height up to which the bed is held still in pull and shear"""
    freeze_above: float | None = None
    """m, height from which it moves at `speed`"""
    freeze: str | None = None
    """fibers, nodes"""
    repeat_from: str | None = None
    """name of an earlier stage (or this one)"""
    repeat: int = 1
    """times in all"""


@dataclass(frozen=True, kw_only=True)
class Record:
    """`[record]`: what is written and how often."""

    frames: int | None = None
    """evenly over the run"""
    every_strain: float | None = None
    every_time: float | None = None
    """s"""
    scalars: int
    """rows over the run"""
    quantities: tuple[str, ...]
    node_fields: tuple[str, ...]
    layers: int = 0
    trajectory: bool
    usd: bool
    figures: bool
    checkpoint_every: float
    """s of wall time"""


@dataclass(frozen=True, kw_only=True)
class Numerics:
    """`[numerics]`: how it is solved. `segments` or a sibling as asked, a tuple if per group."""

    method: str
    segments: int | tuple[int, ...] | None = None
    segment_length: float | tuple[float, ...] | None = None
    """m"""
    reduced_beads: float | tuple[float, ...] | None = None
    closure: str
    """none, paper, consistent"""
    torque_weights: str
    """end_weighted, plain"""
    integrator: str | None = None
    contact: str
    """penalty, unilateral"""
    contact_tolerance: float | None = None
    """radii of the thinnest fiber, of the gaps of unilateral and implicit contact"""
    linearizations: int | None = None
    """of contact in a step: 1, or 2 to push against what the first left"""
    dt: float | None = None
    """s; None = auto. `strain_step` is already turned into it."""
    strain_step: float | None = None
    tolerance: float | None = None
    dt_fraction: float
    """of the smallest limit, where dt is auto"""
    allow_unstable_dt: bool
    precision: str
    """float32, float64"""
    bond_shear: str | None = None
    device: str
    """auto, cpu, cuda, cuda:N"""
    workers: int | None = None
    """None = auto"""
    skin: float | None = None
    """m; None = auto"""
    lubrication_step: str
    """limited, explicit"""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scene file, read, completed and checked."""

    title: str
    seed: int
    box: Box | None = None
    flow: Flow | None = None
    fibers: tuple[FiberGroup, ...]
    contact: Contact
    walls: tuple[Wall, ...] = ()
    gravity: Gravity | None = None
    loads: tuple[Load, ...] = ()
    start: Start | None = None
    stages: tuple[Stage, ...]
    record: Record
    numerics: Numerics
    path: str
    """file name as given"""
    notes: tuple[str, ...] = ()
    """what the user should know that is not wrong, e.g. keys without effect"""
    method_reason: str | None = None
    """why `auto` chose numerics.method; None where the file names it"""
    rod_trial: RodTrial | None = None
    """the scene of rods, where a trial of `auto` has to tell whether contact bends them"""

    @property
    def name(self) -> str:
        """Name of the scene: its file name without folder and ending."""
        return self.path.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(".toml") or "scene"

    @property
    def stage_sequence(self) -> tuple[Stage, ...]:
        """The stages in the order in which they run, repeats written out."""
        sequence: list[Stage] = []
        begin: dict[str, int] = {}
        for stage in self.stages:
            begin[stage.name] = len(sequence)
            sequence.append(stage)
            if stage.repeat_from is not None:
                block = sequence[begin[stage.repeat_from] :]
                sequence += block * (stage.repeat - 1)
        return tuple(sequence)

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-ready tables named as in a file, all defaults resolved, no absent keys."""
        tables: dict[str, Any] = {"resolved": True}
        for field in dataclasses.fields(self):
            if field.name == "rod_trial":  # an open question, no part of what is simulated
                continue
            value = _plain(getattr(self, field.name))
            if value is not None:
                tables[_TABLE_NAMES.get(field.name, field.name)] = value
        return tables

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of what is simulated, wherever its file lies."""
        beside = ("path", "notes", "title", "method_reason")
        tables = {k: v for k, v in self.as_dict().items() if k not in beside}
        text = json.dumps(tables, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class RodTrial:
    """A scene with `rigid_rod`, and the bending by contact up to which it stands for fibers."""

    scene: Scene
    tolerance: float
    """lengths of a fiber"""


_TABLE_NAMES = {"walls": "wall", "loads": "load", "stages": "stage"}
"""Fields of `Scene` whose table has another name."""

_TABLE_CLASSES: dict[str, type] = {
    "box": Box,
    "flow": Flow,
    "fibers": FiberGroup,
    "shape": Shape,
    "length_distribution": LengthDistribution,
    "layers": Layer,
    "contact": Contact,
    "wall": Wall,
    "gravity": Gravity,
    "load": Load,
    "start": Start,
    "stage": Stage,
    "record": Record,
    "numerics": Numerics,
}


def scene_from_resolved(tables: Mapping[str, Any]) -> Scene:
    """Return the scene that `Scene.as_dict` came from; raises `SceneError` if it does not fit."""
    values = {key: value for key, value in tables.items() if key != "resolved"}
    attributes = {table: field for field, table in _TABLE_NAMES.items()}
    scene: Scene = _made(
        Scene,
        {
            attributes.get(name, name): _table_value(name, value, str(tables.get("path", "")))
            for name, value in values.items()
        },
        str(tables.get("path", "")),
    )
    return scene


def _table_value(name: str, value: Any, path: str) -> Any:
    """Return the dataclass, the tuple of them, or the plain value of one recorded table."""
    cls = _TABLE_CLASSES.get(name)
    if cls is None or not isinstance(value, dict | list | tuple):
        return _frozen(value)
    if not isinstance(value, dict):
        return tuple(_table_value(name, row, path) for row in value)
    fields = {
        "from_" if key == "from" else key: (
            _table_value(key, item, path) if _is_table(item) else _frozen(item)
        )
        for key, item in value.items()
    }
    return _made(cls, fields, path)


def _made(cls: type, fields: dict[str, Any], path: str) -> Any:
    """Return `cls(**fields)`; a field that is missing or too much raises `SceneError`."""
    try:
        return cls(**fields)
    except TypeError as error:
        what = str(error).partition("() ")[2] or str(error)
        remedy = f"recorded by another version of warpfiber ({what}); use the scene file itself"
        raise SceneError(Fault(path, cls.__name__, None, remedy)) from None


def _plain(value: Any) -> Any:
    """Return dataclasses as dicts without absent fields, tuples as lists."""
    if dataclasses.is_dataclass(value):
        pairs = ((f.name.rstrip("_"), getattr(value, f.name)) for f in dataclasses.fields(value))
        return {name: _plain(item) for name, item in pairs if item is not None}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def _is_table(value: Any) -> bool:
    """Tell whether a recorded value is a table or a list of tables."""
    first = value[0] if isinstance(value, list | tuple) and value else value
    return isinstance(first, dict)


def _frozen(value: Any) -> Any:
    """Return lists as tuples, at any depth."""
    if isinstance(value, list | tuple):
        return tuple(_frozen(item) for item in value)
    return value
