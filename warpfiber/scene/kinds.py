"""Kinds of values that a scene key can hold: each checks one raw TOML value and returns it clean.

A kind knows two things: the words that tell a person what is allowed, and how to read a value. A
value that it refuses raises `KindError` with "what is wrong; what to write instead".
Limits: looks at one value only; rules between keys are in `keys.py` and `crosschecks.py`.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from warpfiber.scene.faults import nearest, number_text
from warpfiber.scene.units import si_text


class KindError(ValueError):
    """What is wrong with one value and what to write instead."""


class Kind(ABC):
    """A kind of value; the subclasses are the whole list of kinds."""

    @abstractmethod
    def words(self) -> str:
        """Return what is allowed, fit for "give ..."."""

    @abstractmethod
    def fits(self, value: object) -> bool:
        """Tell whether the value looks meant for this kind, so that `Either` can choose."""

    @abstractmethod
    def read(self, value: object) -> Any:
        """Return the clean value; raises `KindError`."""


@dataclass(frozen=True)
class Number(Kind):
    """A finite number in SI, with limits; `whole` for integers. True and false are no numbers."""

    unit: str = ""
    above: float | None = None
    least: float | None = None
    below: float | None = None
    nonzero: bool = False
    whole: bool = False

    def words(self) -> str:
        """Return for example "a number > 0 in m"."""
        limits = [
            f"{sign} {number_text(limit)}"
            for sign, limit in ((">", self.above), (">=", self.least), ("<", self.below))
            if limit is not None
        ]
        text = "a whole number" if self.whole else "a number"
        text += " other than 0" if self.nonzero else ""
        text += (" " + " and ".join(limits)) if limits else ""
        return text + (f" in {self.unit}" if self.unit else "")

    def fits(self, value: object) -> bool:
        """Accept numbers and texts that begin like one."""
        if isinstance(value, str):
            return re.match(r"\s*[+-]?\.?\d", value) is not None
        return isinstance(value, int | float) and not isinstance(value, bool)

    def read(self, value: object) -> float | int:
        """Return a float, or an int if `whole`; raises `KindError`."""
        if isinstance(value, bool):
            raise KindError(f"true/false is not a number; give {self.words()}")
        if isinstance(value, str):
            number = si_text(value, self.unit)
            remedy = f"write {number}" if number else f"give {self.words()}"
            raise KindError(f"a text is not a number; {remedy} (SI, no quotes, no unit)")
        if not isinstance(value, int | float):
            raise KindError(f"{_type_word(value)} is not a number; give {self.words()}")
        try:
            number_value = float(value)
        except OverflowError:
            number_value = math.inf
        if not math.isfinite(number_value):
            raise KindError(f"the number must be finite; give {self.words()}")
        if self.whole and isinstance(value, float):
            remedy = f"write {int(value)}" if value.is_integer() else f"give {self.words()}"
            raise KindError(f"not a whole number; {remedy}")
        if (
            (self.above is not None and not number_value > self.above)
            or (self.least is not None and not number_value >= self.least)
            or (self.below is not None and not number_value < self.below)
            or (self.nonzero and number_value == 0.0)
        ):
            raise KindError(f"out of range; give {self.words()}")
        return value if self.whole else number_value


@dataclass(frozen=True)
class Switch(Kind):
    """true or false."""

    def words(self) -> str:
        """Return the two values."""
        return "true or false"

    def fits(self, value: object) -> bool:
        """Accept booleans."""
        return isinstance(value, bool)

    def read(self, value: object) -> bool:
        """Return the boolean; raises `KindError`."""
        if not isinstance(value, bool):
            raise KindError("neither true nor false; write true or false (no quotes)")
        return value


@dataclass(frozen=True)
class Text(Kind):
    """Any text that is not empty; `suffixes` for file names, `what` for the message."""

    what: str = "a text in quotes"
    suffixes: tuple[str, ...] = ()

    def words(self) -> str:
        """Return what the text is for."""
        return self.what

    def fits(self, value: object) -> bool:
        """Accept texts."""
        return isinstance(value, str)

    def read(self, value: object) -> str:
        """Return the text; raises `KindError`."""
        if not isinstance(value, str):
            raise KindError(f"{_type_word(value)} is not a text; give {self.what}")
        if not value.strip():
            raise KindError(f"the text is empty; give {self.what}")
        if self.suffixes and not value.lower().endswith(self.suffixes):
            raise KindError(f"unknown file type; give {self.what}")
        return value


@dataclass(frozen=True)
class Choice(Kind):
    """One word of a list."""

    options: tuple[str, ...]

    def words(self) -> str:
        """Return the list of words."""
        if len(self.options) == 1:
            return f'"{self.options[0]}"'
        return "one of " + ", ".join(f'"{option}"' for option in self.options)

    def fits(self, value: object) -> bool:
        """Accept texts."""
        return isinstance(value, str)

    def read(self, value: object) -> str:
        """Return the word; raises `KindError` with the nearest one."""
        if not isinstance(value, str):
            raise KindError(f"{_type_word(value)} is not a word; give {self.words()}")
        if value not in self.options:
            guess = nearest(value, self.options)
            meant = f', did you mean "{guess}"?' if guess else ";"
            raise KindError(f"unknown word{meant} allowed: {', '.join(self.options)}")
        return value


@dataclass(frozen=True)
class Device(Kind):
    """A device name: auto, cpu, cuda or cuda:N. Whether it is there is asked later."""

    def words(self) -> str:
        """Return the forms."""
        return '"auto", "cpu", "cuda" or "cuda:N" (N = 0, 1, ...)'

    def fits(self, value: object) -> bool:
        """Accept texts."""
        return isinstance(value, str)

    def read(self, value: object) -> str:
        """Return the name; raises `KindError`."""
        if not isinstance(value, str) or not re.fullmatch(r"auto|cpu|cuda|cuda:\d+", value):
            raise KindError(f"unknown device; give {self.words()}")
        return value


@dataclass(frozen=True)
class ListOf(Kind):
    """A list of values of one kind; `count` entries, or at least `least`. Read as a tuple."""

    item: Kind
    count: int | None = None
    least: int = 0
    what: str = ""
    unique: bool = False

    def words(self) -> str:
        """Return for example "a list of 3: each a number > 0 in m"."""
        size = f" of {self.count}" if self.count is not None else ""
        size = f" of {self.least} or more" if not size and self.least else size
        return f"{self.what or 'a list'}{size}, each {self.item.words()}"

    def fits(self, value: object) -> bool:
        """Accept lists whose first entry fits."""
        return isinstance(value, list | tuple) and (not value or self.item.fits(value[0]))

    def read(self, value: object) -> tuple[Any, ...]:
        """Return a tuple; raises `KindError` that names the entry."""
        if not isinstance(value, list | tuple):
            raise KindError(f"{_type_word(value)} is not a list; give {self.words()}")
        if self.count is not None and len(value) != self.count:
            raise KindError(f"{_entries(len(value))} instead of {self.count}; give {self.words()}")
        if len(value) < self.least:
            raise KindError(f"{_entries(len(value))}; give {self.words()}")
        clean = []
        for index, item in enumerate(value):
            try:
                clean.append(self.item.read(item))
            except KindError as problem:
                raise KindError(f"entry {index}: {problem}") from None
        if self.unique and len(set(clean)) < len(clean):
            raise KindError("the same entry twice; name each once")
        return tuple(clean)


@dataclass(frozen=True)
class Either(Kind):
    """A value of one of several kinds; the first that fits decides."""

    kinds: tuple[Kind, ...]

    def words(self) -> str:
        """Return the alternatives."""
        return ", or ".join(kind.words() for kind in self.kinds)

    def fits(self, value: object) -> bool:
        """Accept what any of the kinds accepts."""
        return any(kind.fits(value) for kind in self.kinds)

    def read(self, value: object) -> Any:
        """Return the value read by the kind it fits; raises `KindError`."""
        for kind in self.kinds:
            if isinstance(kind, Choice) and isinstance(value, str) and value not in kind.options:
                guess = nearest(value, kind.options)
                meant = f', did you mean "{guess}"?' if guess else ";"
                raise KindError(f"unknown word{meant} give {self.words()}")
            if kind.fits(value):
                return kind.read(value)
        raise KindError(f"{_type_word(value)} does not fit here; give {self.words()}")


@dataclass(frozen=True)
class Direction(Kind):
    """A vector that is not zero; read as a unit vector."""

    def words(self) -> str:
        """Return the form."""
        return "3 numbers, not all 0"

    def fits(self, value: object) -> bool:
        """Accept lists."""
        return isinstance(value, list | tuple)

    def read(self, value: object) -> tuple[float, ...]:
        """Return the unit vector (3,); raises `KindError`."""
        vector: tuple[float, ...] = ListOf(Number(), count=3).read(value)
        length = math.hypot(*vector)
        if length == 0.0 or not math.isfinite(length):
            raise KindError(f"the vector has no direction; give {self.words()}")
        return tuple(component / length for component in vector)


@dataclass(frozen=True)
class OrientationTensor(Kind):
    """Orientation tensor [a11, a22, a33, a12, a13, a23], trace 1, no negative eigenvalue."""

    def words(self) -> str:
        """Return the form."""
        return "[a11, a22, a33, a12, a13, a23] with a11 + a22 + a33 = 1"

    def fits(self, value: object) -> bool:
        """Accept lists."""
        return isinstance(value, list | tuple)

    def read(self, value: object) -> tuple[float, ...]:
        """Return the 6 components scaled to trace 1 exactly; raises `KindError`."""
        raw: tuple[float, ...] = ListOf(Number(), count=6).read(value)
        trace = raw[0] + raw[1] + raw[2]
        if abs(trace - 1.0) > 2e-3:  # printed tensors are rounded to three digits
            raise KindError(f"a11 + a22 + a33 = {number_text(trace)}; it must be 1")
        a11, a22, a33, a12, a13, a23 = (component / trace for component in raw)
        minors = (
            a11,
            a22,
            a33,
            a11 * a22 - a12 * a12,
            a11 * a33 - a13 * a13,
            a22 * a33 - a23 * a23,
        )
        determinant = (
            a11 * (a22 * a33 - a23 * a23)
            - a12 * (a12 * a33 - a23 * a13)
            + a13 * (a12 * a23 - a22 * a13)
        )
        if min(*minors, determinant) < -1e-6:
            raise KindError("no set of directions has this tensor; its eigenvalues must be >= 0")
        return (a11, a22, a33, a12, a13, a23)


def _entries(count: int) -> str:
    """Return "1 entry", "2 entries"."""
    return f"{count} entry" if count == 1 else f"{count} entries"


def _type_word(value: object) -> str:
    """Return the everyday name of a TOML type."""
    if isinstance(value, bool):
        return "true/false"
    if isinstance(value, int | float):
        return "a number"
    if isinstance(value, str):
        return "a text"
    if isinstance(value, list | tuple):
        return "a list"
    if isinstance(value, dict):
        return "a table"
    return "a date or time"
