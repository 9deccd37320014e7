"""The scene while it is read: clean values per table, the raw file for blame, the faults so far."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warpfiber.scene.faults import FaultList
from warpfiber.scene.keys import Values, dotted
from warpfiber.scene.scene import Scene
from warpfiber.scene.tables import Flow


@dataclass
class Draft:
    """Values by table; None is absent or already reported, so checks pass over it."""

    faults: FaultList
    raw: Mapping[str, Any]
    folder: Path
    method: str | None
    top: Values = field(default_factory=dict)
    box: Values | None = None
    flow: Values | None = None
    fibers: list[Values] = field(default_factory=list)
    contact: Values = field(default_factory=dict)
    walls: list[Values] = field(default_factory=list)
    gravity: Values | None = None
    loads: list[Values] = field(default_factory=list)
    start: Values | None = None
    stages: list[Values] = field(default_factory=list)
    record: Values = field(default_factory=dict)
    numerics: Values = field(default_factory=dict)
    flow_object: Flow | None = None
    saved: Scene | None = None
    """of the run that [start] names"""

    def raw_value(self, key: str) -> Any:
        """Return what the file says at a dotted key, None if nothing."""
        value: Any = self.raw
        for part in key.split("."):
            if isinstance(value, Mapping):
                value = value.get(part)
            elif isinstance(value, Sequence) and part.isdigit() and int(part) < len(value):
                value = value[int(part)]
            else:
                return None
        return value

    def given(self, path: str, names: Iterable[str]) -> str:
        """Return the dotted key of the first of `names` that the file gives, else of the first."""
        keys = [dotted(path, name) for name in names]
        return next((key for key in keys if self.raw_value(key) is not None), keys[0])

    def is_given(self, key: str) -> bool:
        """Tell whether the file gives a dotted key."""
        return self.raw_value(key) is not None

    def blame(self, key: str, remedy: str) -> None:
        """Add a fault to a dotted key, with the value that the file gives."""
        value = self.raw_value(key)
        self.faults.add(key, None if isinstance(value, dict) else value, remedy)

    def note(self, text: str) -> None:
        """Add a note."""
        self.faults.note(text)

    def faulty(self, path: str) -> bool:
        """Tell whether the table at `path`, or anything in it, is at fault."""
        return any(f.key == path or f.key.startswith(path + ".") for f in self.faults.faults)

    def axes(self, boundary: str) -> list[tuple[int, float]]:
        """Return (axis, edge in m) of the axes with a boundary; empty while the box is unknown."""
        if self.box is None or self.box["size"] is None or self.box["boundary"] is None:
            return []
        pairs = zip(self.box["size"], self.box["boundary"], strict=True)
        return [(axis, size) for axis, (size, kind) in enumerate(pairs) if kind == boundary]
