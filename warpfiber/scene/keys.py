"""How a table of a scene is described, and the one mechanism that reads every table by it.

A `Table` lists `Key`s (kind, default, when it applies) and `OneOf` rules. `read_table` turns a raw
TOML table into clean values and reports unknown keys with the nearest known one, wrong values,
missing keys, keys that exclude each other, keys that this version cannot run, and ignored keys.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from warpfiber.scene.availability import unavailable
from warpfiber.scene.faults import FaultList, nearest
from warpfiber.scene.kinds import Kind, KindError

Values = dict[str, Any]
"""Clean values of one table by key; None = absent or at fault."""


@dataclass(frozen=True)
class Key:
    """One key of a table.

    `required`: always, or for the named methods. `when` = (other key, words): the key applies, and
    is required, only with these words. `methods`: those that use the key (empty: all).
    `method_default`: pairs (method, default) that replace `default`.
    """

    name: str
    kind: Kind
    default: object = None
    required: bool | tuple[str, ...] = False
    when: tuple[str, tuple[str, ...]] | None = None
    methods: tuple[str, ...] = ()
    method_default: tuple[tuple[str, object], ...] = ()


@dataclass(frozen=True)
class OneOf:
    """Keys of which exactly one is given; not `required`: at most one; `several`: at least one."""

    keys: tuple[str, ...]
    required: bool = True
    several: bool = False


@dataclass(frozen=True)
class Table:
    """Description of a table; `many` for lists of tables (`[[name]]`)."""

    name: str
    keys: tuple[Key, ...]
    one_of: tuple[OneOf, ...] = ()
    many: bool = False

    @property
    def key_names(self) -> tuple[str, ...]:
        """Names of the keys in their order."""
        return tuple(key.name for key in self.keys)

    @property
    def heading(self) -> str:
        """The heading in a file: [box] or [[fibers]]."""
        return f"[[{self.name}]]" if self.many else f"[{self.name}]"


@dataclass(frozen=True)
class Inline(Kind):
    """An inline table, or with `many` a list of them; read by `read_table`."""

    table: Table = field(default_factory=lambda: Table("", ()))
    many: bool = False

    def words(self) -> str:
        """Return the form with its keys."""
        form = "{" + ", ".join(f"{name} = ..." for name in self.table.key_names) + "}"
        return f"[{form}, ...]" if self.many else form

    def fits(self, value: object) -> bool:
        """Accept a table, or a list of tables."""
        if self.many:
            return isinstance(value, list | tuple) and all(isinstance(row, dict) for row in value)
        return isinstance(value, dict)

    def read(self, value: object) -> Any:
        """Refuse what is no table; `read_table` reads those that are."""
        raise KindError(f"not a table; give {self.words()}")


@dataclass(frozen=True)
class Reader:
    """What every table of one scene is read with: where faults go, the method, all tables known."""

    faults: FaultList
    method: str | None
    tables: tuple[Table, ...]


def read_table(reader: Reader, table: Table, raw: Mapping[str, object], path: str) -> Values:
    """Return the clean values of `raw`, every key of `table` present; faults go to the reader.

    `path` is the dotted place of the table, such as `fibers.0`; empty for the top level.
    """
    meant = _report_unknown(reader, table, raw, path)
    values: Values = {}
    for key in table.keys:
        values[key.name] = _read_key(reader, table, key, raw, path)
    for key in table.keys:
        _check_use(reader, key, raw, values, path, meant)
    for rule in table.one_of:
        _check_one_of(reader, rule, raw, path, meant)
    return values


def dotted(path: str, name: str) -> str:
    """Return the dotted key of `name` in the table at `path`."""
    return f"{path}.{name}" if path else name


def _report_unknown(
    reader: Reader, table: Table, raw: Mapping[str, object], path: str
) -> frozenset[str]:
    """Report unknown keys; return the known ones that they were probably meant to be."""
    meant: set[str] = set()
    for name, value in raw.items():
        if name in table.key_names:
            continue
        guess = nearest(name, table.key_names)
        homes = [
            other.heading
            for other in reader.tables
            if name in other.key_names and unavailable(other.name, "", None) is None
        ]
        if homes and name not in meant:
            remedy = f"unknown key here; it belongs to {' or '.join(homes)}"
        elif guess:
            remedy = f"unknown key, did you mean '{guess}'?"
            meant.add(guess)
        else:
            remedy = f"unknown key; known here: {', '.join(table.key_names)}"
        reader.faults.add(dotted(path, name), value, remedy)
    return frozenset(meant)


def _read_key(
    reader: Reader, table: Table, key: Key, raw: Mapping[str, object], path: str
) -> object:
    """Return the clean value of one key, its default if absent, None if at fault."""
    place = dotted(path, key.name)
    if key.name not in raw:
        return dict(key.method_default).get(reader.method or "", key.default)
    value = raw[key.name]
    inline = _inline_for(key.kind, value)
    if inline is not None:
        clean: object = _read_inline(reader, inline, value, place)
    else:
        try:
            clean = key.kind.read(value)
        except KindError as problem:
            reader.faults.add(place, value, str(problem))
            return None
    remedy = unavailable(table.name, key.name, clean)
    if remedy is not None:
        reader.faults.add(place, value, remedy)
    return clean


def _inline_for(kind: Kind, value: object) -> Inline | None:
    """Return the inline table that a value is to be read by, if it is one."""
    kinds: Sequence[Kind] = getattr(kind, "kinds", (kind,))
    for part in kinds:
        if isinstance(part, Inline) and part.fits(value):
            return part
    return None


def _read_inline(reader: Reader, inline: Inline, value: Any, place: str) -> object:
    """Return the values of an inline table, or a tuple of them."""
    if not inline.many:
        return read_table(reader, inline.table, value, place)
    return tuple(
        read_table(reader, inline.table, row, f"{place}.{index}") for index, row in enumerate(value)
    )


def _check_use(
    reader: Reader,
    key: Key,
    raw: Mapping[str, object],
    values: Values,
    path: str,
    meant: frozenset[str],
) -> None:
    """Report a key that is missing; note one that is given but has no effect."""
    place = dotted(path, key.name)
    given = key.name in raw
    if key.when is not None:
        other, words = key.when
        if values[other] is None:  # the other key is at fault itself
            return
        if values[other] not in words:
            if given:
                reader.faults.note(f"{place} has no effect with {other} = {values[other]}")
                values[key.name] = None
            return
    if given:
        if key.methods and reader.method is not None and reader.method not in key.methods:
            reader.faults.note(f"{place} has no effect in method {reader.method}")
        return
    required = key.required if isinstance(key.required, bool) else reader.method in key.required
    if required and key.name not in meant:
        because = f" with {key.when[0]} = {values[key.when[0]]}" if key.when else ""
        reader.faults.add(place, None, f"missing{because}; give {key.kind.words()}")


def _check_one_of(
    reader: Reader, rule: OneOf, raw: Mapping[str, object], path: str, meant: frozenset[str]
) -> None:
    """Report none given (if required) or more than one given (unless several may be)."""
    given = [name for name in rule.keys if name in raw]
    names = ", ".join(rule.keys)
    if not given and rule.required and not meant.intersection(rule.keys):
        amount = "at least one" if rule.several else "exactly one"
        reader.faults.add(path or rule.keys[0], None, f"missing; give {amount} of {names}")
    if len(given) > 1 and not rule.several:
        remedy = f"given together with {' and '.join(given[:-1])}; keep exactly one of {names}"
        reader.faults.add(dotted(path, given[-1]), raw[given[-1]], remedy)
