"""What is wrong with a scene: a fault, the list that collects faults, the error that has all.

Limits: stdlib only; a fault is one line of text for a person, never a stack trace.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePath

VALUE_WIDTH = 60
"""Longest printed value, characters; longer ones are cut in the middle of the line."""


@dataclass(frozen=True)
class Fault:
    """One thing to correct: where, which key, its value (None = no value), what is wrong, cure."""

    file: str
    key: str
    value: object
    remedy: str

    def __str__(self) -> str:
        """Return the line `FILE: key = value: what is wrong; remedy`, without its empty parts."""
        subject = self.key
        if self.value is not None:
            shown = value_text(self.value)
            subject = f"{self.key} = {shown}" if self.key else shown
        line = ": ".join(part for part in (self.file, subject, self.remedy) if part)
        return " ".join(line.split())


class SceneError(Exception):
    """All faults of a scene together; `faults` is never empty, `str` gives one line per fault."""

    exit_code = 2

    def __init__(self, faults: Iterable[Fault] | Fault) -> None:
        """Keep the faults in the order in which they were found."""
        self.faults: tuple[Fault, ...] = (faults,) if isinstance(faults, Fault) else tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))


class FaultList:
    """Faults and notes met while one scene is read; keys of the command line are blamed on it."""

    def __init__(self, file: str, overridden: Iterable[str] = ()) -> None:
        """Start empty for `file`; `overridden` are the dotted keys that came from `--set`."""
        self.file = file
        self.overridden = frozenset(overridden)
        self.faults: list[Fault] = []
        self.notes: list[str] = []

    def add(self, key: str, value: object, remedy: str) -> None:
        """Collect one fault; the same fault is kept once."""
        from_command = any(key == name or key.startswith(name + ".") for name in self.overridden)
        fault = Fault("--set" if from_command else self.file, key, value, remedy)
        if fault not in self.faults:
            self.faults.append(fault)

    def note(self, text: str) -> None:
        """Collect something the user should know that is not wrong; once."""
        if text not in self.notes:
            self.notes.append(text)

    def has(self, key: str) -> bool:
        """Tell whether `key` itself is already at fault."""
        return any(fault.key == key for fault in self.faults)

    def raise_if_any(self) -> None:
        """Raise `SceneError` with everything collected, if anything was."""
        if self.faults:
            raise SceneError(self.faults)


def value_text(value: object) -> str:
    """Return a value as it would stand in a scene file, cut to `VALUE_WIDTH` characters."""
    text = _toml_text(value)
    return text if len(text) <= VALUE_WIDTH else text[: VALUE_WIDTH - 4] + " ..."


def number_text(value: float) -> str:
    """Return a number in short form, as a person would write it: 5e-6, 0.001, 20."""
    text = f"{value:.12g}"
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if mark else text


def nearest(word: str, known: Sequence[str]) -> str | None:
    """Return the known word closest to a mistyped one, or None if nothing is close."""
    folded = {name.lower(): name for name in known}
    close = difflib.get_close_matches(word.lower(), list(folded), n=1, cutoff=0.6)
    return folded[close[0]] if close else None


def _toml_text(value: object) -> str:
    """Return a TOML-like text of any value that `tomllib` or a command line can give."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return number_text(value)
    if isinstance(value, str | PurePath):
        return json.dumps(str(value), ensure_ascii=False)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_text(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml_text(item)}" for key, item in value.items()) + "}"
    return str(value)
