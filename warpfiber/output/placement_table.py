"""What was asked of the start and what was reached: `placement.csv`, one number per row.

Columns: table ([[fibers]] of the scene), layer (empty: the whole table), quantity, weighting (by
length or number; empty: none), asked (empty: nothing was), achieved, largest (the most that a33 can
be of straight fibers that fit there). SI.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from warpfiber.output.record_error import record_errors

COLUMNS = ("table", "layer", "quantity", "weighting", "asked", "achieved", "largest")
TENSOR = ("a11", "a22", "a33", "a12", "a13", "a23")
WEIGHTINGS = ("length", "number")


def write_placement(path: Path, report: Mapping[str, Any]) -> None:
    """Write the table of a placement report; nothing if no fibers were drawn from statistics."""
    tables = report.get("tables") or []
    if not tables:
        return
    with record_errors(path, "write"), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for table in tables:
            for row in _rows(table):
                writer.writerow([table["table"], *row])


def _rows(table: Mapping[str, Any]) -> Iterator[list[Any]]:
    """Rows of one table, without its number: those of the whole, then layer by layer."""
    for name in ("volume_fraction", "number_average_length", "weight_average_length"):
        yield ["", name, "", table[name]["asked"], table[name]["achieved"], ""]
    yield from _tensor_rows("", table["orientation"], table.get("largest_a33") or {})
    for k, layer in enumerate(table.get("layers") or []):
        fraction = layer["volume_fraction"]
        yield [k, "volume_fraction", "", fraction["asked"], fraction["achieved"], ""]
        for name in ("number_average_length", "weight_average_length"):
            yield [k, name, "", "", layer[name], ""]
        yield from _tensor_rows(k, layer["orientation"], layer["largest_a33"])


def _tensor_rows(
    layer: int | str, tensor: Mapping[str, Any], largest: Mapping[str, float]
) -> Iterator[list[Any]]:
    """Components by both weightings beside the one number that was asked for."""
    for way in WEIGHTINGS:
        for name, asked, got in zip(TENSOR, tensor["asked"], tensor[f"by_{way}"], strict=True):
            most = largest.get(f"by_{way}", "") if name == "a33" else ""
            yield [layer, name, way, asked, got, most]
