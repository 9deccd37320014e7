"""Values set on the command line: `fibers.0.count=500` read as TOML and put into the raw tables.

Lists of tables are addressed by index, -1 is the last. A key that excludes another, such as
`count` and `volume_fraction`, replaces it.
"""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping
from typing import Any

from warpfiber.scene.faults import Fault, FaultList, SceneError, nearest
from warpfiber.scene.keys import Table
from warpfiber.scene.schema import TABLES, TOP

COMMAND = "--set"
"""What faults of overrides name instead of a file."""


def parse_override(text: str) -> tuple[str, object]:
    """Return (dotted key, value) of `key=value`; a value that is no TOML is taken as a text.

    Raises `SceneError` if there is no key or no value.
    """
    key, mark, value = text.partition("=")
    key, value = key.strip(), value.strip()
    if not mark or not all(part.strip() for part in key.split(".")) or not value:
        raise SceneError(Fault(COMMAND, "", text, "not KEY=VALUE; write e.g. fibers.0.count=500"))
    try:
        parsed = tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return key, value
    return key, parsed["value"] if len(parsed) == 1 else value


def apply_overrides(
    raw: Mapping[str, Any], overrides: Mapping[str, object], file: str
) -> tuple[dict[str, Any], FaultList]:
    """Return a copy of `raw` with the overrides in it, and the fault list of this scene."""
    tables = copy.deepcopy(dict(raw))
    places: list[tuple[str, dict[str, Any], Table | None, str]] = []
    failed: list[tuple[str, object, str]] = []
    created: list[str] = []
    for key, value in overrides.items():
        try:
            path, table, schema = _place(tables, key, created)
        except KeyError as error:
            failed.append((key, value, str(error.args[0])))
            continue
        name = key.rpartition(".")[2]
        table[name] = value
        places.append((f"{path}.{name}" if path else name, table, schema, name))
    dotted_keys = [place[0] for place in places]
    faults = FaultList(file, [*dotted_keys, *created])
    faults.faults += [Fault(COMMAND, key, value, remedy) for key, value, remedy in failed]
    for dotted_key, table, schema, name in places:
        path = dotted_key.rpartition(".")[0]
        for rule in schema.one_of if schema else ():
            if name not in rule.keys or rule.several:
                continue
            for other in rule.keys:
                if other in table and f"{path}.{other}" not in dotted_keys:
                    del table[other]
                    faults.note(f"{path}.{other} is replaced by {COMMAND} {dotted_key}")
    return tables, faults


def _place(
    tables: dict[str, Any], key: str, created: list[str]
) -> tuple[str, dict[str, Any], Table | None]:
    """Return (path, raw table, its schema) that the last part of `key` belongs into.

    Raises `KeyError` with a remedy if there is no such table.
    """
    parts = key.split(".")
    schemas = {table.name: table for table in TABLES}
    schema: Table | None = TOP if len(parts) == 1 else schemas.get(parts[0])
    if len(parts) > 1 and schema is None:
        guess = nearest(parts[0], tuple(schemas))
        meant = f"did you mean '{guess}'?" if guess else f"known: {', '.join(schemas)}"
        raise KeyError(f"unknown table, {meant}")
    if len(parts) == 1 and key in schemas:
        raise KeyError(f"a whole table cannot be set; set one of its keys, e.g. {key}.KEY=VALUE")
    node: Any = tables
    path: list[str] = []
    for depth, part in enumerate(parts[:-1]):
        if isinstance(node, list):
            index = _index(part, len(node), ".".join(path))
            path.append(str(index))
            node = node[index]
        else:
            missing_list = depth == 0 and schema is not None and schema.many
            if part not in node and missing_list:
                raise KeyError(f"the file has no [[{part}]]; add one there")
            path.append(part)
            if part not in node:
                node[part] = {}
                created.append(".".join(path))
            node = node[part]
        if not isinstance(node, dict | list):
            raise KeyError(f"{'.'.join(path)} is a single value; set it as a whole")
    if isinstance(node, list):
        _index(parts[-1], len(node), ".".join(path))  # says how many tables there are
        raise KeyError(f"set {'.'.join(path)} as a whole, or one key of a table in it")
    return ".".join(path), node, schema if len(path) <= 2 else None


def _index(part: str, length: int, path: str) -> int:
    """Return a list index from 0; raises `KeyError` that names the valid ones."""
    if not part.removeprefix("-").isdecimal():
        raise KeyError(f"there can be several tables; write {path}.0.{part}")
    index = int(part)
    if not -length <= index < length:
        valid = f"{path}.0" if length == 1 else f"{path}.0 to {path}.{length - 1}"
        raise KeyError(f"'{part}' is not one of the tables in the file; use {valid}")
    return index % length
