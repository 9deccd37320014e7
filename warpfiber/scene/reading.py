"""From a scene file to a `Scene`: TOML, overrides, tables, defaults, checks; all faults at once."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from warpfiber.scene.availability import unavailable
from warpfiber.scene.choice import choose_method, is_auto, with_method
from warpfiber.scene.crosschecks import cross_check
from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import Fault, FaultList, SceneError, nearest
from warpfiber.scene.keys import Reader, Table, Values, dotted, read_table
from warpfiber.scene.overrides import COMMAND, apply_overrides
from warpfiber.scene.resolving import resolve
from warpfiber.scene.scene import Numerics, Record, RodTrial, Scene, Stage, scene_from_resolved
from warpfiber.scene.schema import (
    BOX,
    CONTACT,
    FIBERS,
    FLOW,
    GRAVITY,
    LOAD,
    NUMERICS,
    RECORD,
    STAGE,
    START,
    TABLES,
    TOP,
    WALL,
)
from warpfiber.scene.starting import take_start
from warpfiber.scene.tables import Box, Contact, FiberGroup, Gravity, Load, Shape, Start, Wall

T = TypeVar("T")
TOML_PLACE = re.compile(r"(.*?) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)


def load_scene(path: str | Path, overrides: Mapping[str, object] | None = None) -> Scene:
    """Read, complete and check a scene file; raises `SceneError` with all faults.

    `overrides`: values by dotted key (`fibers.0.count`), as of `parse_override`.
    """
    file = Path(path)
    return _scene(_tables_of(file), str(path), file.parent, overrides or {})


def scene_from_dict(
    tables: Mapping[str, Any],
    path: str = "scene",
    overrides: Mapping[str, object] | None = None,
) -> Scene:
    """Return the scene of tables like those of a file, or of `Scene.as_dict()`.

    `path` names the scene in faults, and the folder of its files. Raises `SceneError`. Overrides
    need the tables of a file: those of `as_dict` are taken as they are.
    """
    if tables.get("resolved") is True:
        if overrides:
            faults = [
                Fault(COMMAND, k, v, "a recorded scene is fixed") for k, v in overrides.items()
            ]
            raise SceneError(faults)
        return scene_from_resolved(tables)
    return _scene(tables, path, Path(path).parent, overrides or {})


def _tables_of(file: Path) -> dict[str, Any]:
    """Return the raw tables of a TOML file; raises `SceneError` if it cannot be read."""
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        close = _neighbor(file)
        raise SceneError(Fault(str(file), "", None, f"no such file{close}")) from None
    except IsADirectoryError:
        raise SceneError(Fault(str(file), "", None, "is a folder; name the .toml file")) from None
    except UnicodeDecodeError:
        raise SceneError(Fault(str(file), "", None, "not a text; save it as UTF-8")) from None
    except OSError as error:
        raise SceneError(Fault(str(file), "", None, f"cannot be read: {error.strerror}")) from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(_toml_fault(str(file), text, str(error))) from None


def _neighbor(file: Path) -> str:
    """Return ", did you mean ...?" if a scene of a similar name lies in the same folder."""
    try:
        names = [other.name for other in sorted(file.parent.glob("*.toml"))]
    except OSError:
        names = []
    guess = nearest(file.name, names)
    return f", did you mean {file.parent / guess}?" if guess else "; check the path"


def _toml_fault(file: str, text: str, message: str) -> Fault:
    """Return the fault of a TOML error with its line, column and the line's text."""
    match = TOML_PLACE.fullmatch(message)
    if match is None:
        return Fault(file, "", None, f"not TOML: {message}")
    what = match[1][:1].lower() + match[1][1:]
    if match[2] is None:
        return Fault(file, "end of file", None, f"{what}; a quote or bracket is not closed")
    line = text.splitlines()[int(match[2]) - 1].strip()
    advice = "check quotes, brackets, commas and double keys"
    place = f"line {match[2]}, column {match[3]}"
    return Fault(file, place, None, f"{what} in `{line[:60]}`; {advice}")


def _scene(
    raw: Mapping[str, Any], path: str, folder: Path, overrides: Mapping[str, object]
) -> Scene:
    """Return the checked scene of raw tables."""
    tables, faults = apply_overrides(_mended(raw), overrides, path)
    _check_headings({**tables, **raw}, faults)
    reason, rods = None, None
    if is_auto(tables):

        def read(method: str) -> Draft:
            return _checked(with_method(tables, method), FaultList(path), folder)

        method, reason, trial = choose_method(read)
        if trial is not None:
            rods = RodTrial(_finished(read("rigid_rod"), path, reason), trial)
        tables = with_method(tables, method)
    draft = _checked(tables, faults, folder)
    faults.raise_if_any()
    return _finished(draft, path, reason, rods)


def _checked(tables: dict[str, Any], faults: FaultList, folder: Path) -> Draft:
    """Read, complete and check the tables."""
    draft = _draft(tables, faults, folder)
    if draft.start is not None and draft.saved is None:
        return draft  # without fibers and box all else would be at fault, too
    resolve(draft)
    cross_check(draft)
    return draft


def _draft(raw: dict[str, Any], faults: FaultList, folder: Path) -> Draft:
    """Read every table of the file by its schema."""
    numerics = raw.get("numerics")
    asked = numerics.get("method") if isinstance(numerics, dict) else None
    methods = ("bead_chain", "overdamped", "rigid_rod", "bonded_spheres")
    method = asked if asked in methods else None
    reader = Reader(faults, method, TABLES)
    draft = Draft(faults=faults, raw=raw, folder=folder, method=method)
    top = {name: value for name, value in raw.items() if name in TOP.key_names}
    draft.top = read_table(reader, TOP, top, "")
    draft.numerics = _one(reader, NUMERICS, raw) or {}
    draft.box = _one(reader, BOX, raw, optional=True)
    draft.flow = _one(reader, FLOW, raw, optional=True)
    draft.fibers = _many(reader, FIBERS, raw)
    draft.contact = _one(reader, CONTACT, raw) or {}
    draft.walls = _many(reader, WALL, raw)
    draft.gravity = _one(reader, GRAVITY, raw, optional=True)
    draft.loads = _many(reader, LOAD, raw)
    draft.start = _one(reader, START, raw, optional=True)
    draft.stages = _many(reader, STAGE, raw)
    draft.record = _one(reader, RECORD, raw) or {}
    take_start(draft)
    return draft


def _mended(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables with single and double brackets as they should be, to read on."""
    tables = dict(raw)
    for table in TABLES:
        value = raw.get(table.name)
        if table.many and isinstance(value, dict):
            tables[table.name] = [value]
        elif not table.many and value and _is_list_of_tables(value):
            tables[table.name] = value[0]
    return tables


def _check_headings(raw: Mapping[str, Any], faults: FaultList) -> None:
    """Report unknown tables, keys outside their table, and wrong brackets."""
    tables = {table.name: table for table in TABLES}
    for name, value in raw.items():
        if name in TOP.key_names:
            continue
        table = tables.get(name)
        if table is None:
            homes = [other.heading for other in TABLES if name in other.key_names]
            guess = nearest(name, (*tables, *TOP.key_names))
            is_table = isinstance(value, dict | list)
            if homes:
                remedy = f"stands outside its table; move it below {' or '.join(homes)}"
            elif guess:
                heading = tables[guess].heading if guess in tables else guess
                remedy = f"unknown {'table' if is_table else 'key'}, did you mean {heading}?"
            else:
                headings = " ".join(other.heading for other in TABLES)
                remedy = f"unknown {'table' if is_table else 'key'}; known: title seed {headings}"
            faults.add(name, None if is_table else value, remedy)
        elif table.many and not _is_list_of_tables(value):
            faults.add(name, None, f"there can be several; write the heading {table.heading}")
        elif not table.many and not isinstance(value, dict):
            faults.add(name, None, f"there is only one; write the heading {table.heading}")


def _is_list_of_tables(value: object) -> bool:
    """Tell whether a raw value is a list of tables."""
    return isinstance(value, list | tuple) and all(isinstance(row, dict) for row in value)


def _one(
    reader: Reader, table: Table, raw: Mapping[str, Any], optional: bool = False
) -> Values | None:
    """Return the values of a table that stands once; all defaults, or None, if it is absent."""
    value = raw.get(table.name)
    if optional and not isinstance(value, dict):
        return None
    if not isinstance(value, dict):
        value = {}
    _check_available(reader, table, table.name, raw)
    return read_table(reader, table, value, table.name)


def _many(reader: Reader, table: Table, raw: Mapping[str, Any]) -> list[Values]:
    """Return the values of each table of a list; empty if it is absent."""
    value = raw.get(table.name)
    if not _is_list_of_tables(value):
        return []
    _check_available(reader, table, table.name, raw)
    rows = enumerate(value or ())
    return [read_table(reader, table, row, dotted(table.name, str(i))) for i, row in rows]


def _check_available(reader: Reader, table: Table, path: str, raw: Mapping[str, Any]) -> None:
    """Report a table that this version cannot run as a whole."""
    remedy = unavailable(table.name, "", None) if table.name in raw else None
    if remedy is not None:
        reader.faults.add(path, None, remedy)


def _finished(
    draft: Draft, path: str, method_reason: str | None, rods: RodTrial | None = None
) -> Scene:
    """Return the scene of a draft without faults."""
    assert draft.flow is None or draft.flow_object is not None
    saved, start = draft.saved, draft.start
    return Scene(
        title=draft.top["title"],
        seed=draft.top["seed"],
        box=_made(Box, draft.box) if draft.box is not None else None,
        start=_made(Start, start | {"from_": start["from"]}) if start is not None else None,
        flow=draft.flow_object,
        fibers=saved.fibers
        if saved is not None
        else tuple(
            _made(FiberGroup, group | {"shape": _made(Shape, group["shape"])})
            for group in draft.fibers
        ),
        contact=_made(Contact, draft.contact),
        walls=saved.walls if saved is not None else tuple(_made(Wall, w) for w in draft.walls),
        gravity=_made(Gravity, draft.gravity) if draft.gravity is not None else None,
        loads=tuple(_made(Load, load) for load in draft.loads),
        stages=tuple(_made(Stage, stage) for stage in draft.stages),
        record=_made(Record, draft.record),
        numerics=_made(Numerics, draft.numerics),
        path=path,
        notes=tuple(draft.faults.notes),
        method_reason=method_reason,
        rod_trial=rods,
    )


def _made(cls: type[T], values: Values) -> T:
    """Return a table class filled from the values of its fields."""
    names = cls.__dataclass_fields__  # type: ignore[attr-defined]
    return cls(**{name: value for name, value in values.items() if name in names})
