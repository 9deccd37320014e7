"""Texts with units, such as "5 um": what they would be as a plain SI number.

A scene holds plain SI numbers only. This table serves the error message that tells the number to
write; it never converts silently.
Limits: the units a fiber scene meets; anything else gets a message without a proposal.
"""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation

from warpfiber.scene.faults import number_text

SI_FACTORS: dict[str, dict[str, str]] = {
    "m": {"m": "1", "km": "1e3", "cm": "1e-2", "mm": "1e-3", "um": "1e-6", "nm": "1e-9"},
    "s": {"s": "1", "ms": "1e-3", "us": "1e-6", "min": "60", "h": "3600"},
    "Pa": {"Pa": "1", "kPa": "1e3", "MPa": "1e6", "GPa": "1e9", "bar": "1e5", "N/m2": "1"},
    "Pa s": {"Pas": "1", "mPas": "1e-3", "kPas": "1e3", "P": "0.1", "cP": "1e-3"},
    "kg/m3": {"kg/m3": "1", "g/cm3": "1e3", "g/cc": "1e3", "kg/l": "1e3"},
    "1/s": {"1/s": "1", "/s": "1", "s-1": "1", "Hz": "1"},
    "N": {"N": "1", "mN": "1e-3", "uN": "1e-6", "kN": "1e3"},
    "m/s": {"m/s": "1", "cm/s": "1e-2", "mm/s": "1e-3", "um/s": "1e-6"},
    "m/s2": {"m/s2": "1"},
    "N/m": {"N/m": "1", "kN/m": "1e3", "mN/m": "1e-3"},
    "1/m": {"1/m": "1", "1/cm": "1e2", "1/mm": "1e3"},
    "degrees": {"deg": "1", "degrees": "1", "°": "1", "rad": "57.29577951308232"},
    "": {"%": "0.01"},
}
"""Factor to SI for each unit of a scene key; spellings without blanks, `^`, `*`, `.`."""

_NUMBER_AND_UNIT = re.compile(r"\s*([+-]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "²": "2", "³": "3", "·": None, " ": None})


def si_text(text: str, unit: str) -> str | None:
    """Return `text` ("5 um", "5e-6", "30 GPa") as the SI number to write, None if it is no number.

    `unit` is the SI unit of the key; a unit of another kind gives None.
    """
    match = _NUMBER_AND_UNIT.fullmatch(text)
    if match is None:
        return None
    spelling = match[2].translate(_SPELLINGS)
    for mark in "^*.":
        spelling = spelling.replace(mark, "")
    factor = "1" if spelling == "" else SI_FACTORS.get(unit, {}).get(spelling)
    if factor is None:
        return None
    try:
        return number_text(float(Decimal(match[1]) * Decimal(factor)))
    except (InvalidOperation, OverflowError):
        return None
