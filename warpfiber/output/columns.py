"""What the columns of `scalars.csv` and `layers.csv` are: unit and meaning of every name.

Names have no room for a weighting, so `columns.csv` beside both says by what each is averaged.
Symbols: p direction; L length tip to tip; a fiber radius.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from warpfiber.output.record_error import record_errors

BY_LENGTH = "segments weighted by length"
BY_NUMBER = "end-to-end vectors, one vote per fiber"

_MEANINGS: dict[str, tuple[str, str]] = {
    "step": ("", "number of the step"),
    "time": ("s", "time since the start"),
    "strain": ("", "time integral of the rate of the flow"),
    "layer": ("", "number of the layer from the floor of the box, from 0"),
    "z_low": ("m", "lower plane of the layer above the floor of the box"),
    "z_high": ("m", "upper plane of the layer above the floor of the box"),
    "length": ("m", "centerline of all pieces cut at the planes of the layer"),
    "volume_fraction": ("", "volume of fibers in the layer, or between the walls, over its volume"),
    "fibers": ("", "fibers with their middle in the layer"),
    "number_average_length": ("m", "L of the fibers with their middle in the layer, mean"),
    "weight_average_length": ("m", "L of these fibers weighted by L"),
    "angle": ("rad", "mean unwrapped angle of end-to-end vectors in the x-z plane"),
    "interactions_per_fiber": ("", "pairs of segments that act on each other, for both fibers"),
    "contacts_per_fiber": ("", "pairs of segments that touch, counted for both fibers"),
    "coordination_number": ("", "mean number of distinct fibers that a fiber touches"),
    "contact_force_mean": ("N", "mean size of the force of a contact between two fibers"),
    "contact_force_pair_mean": ("N", "mean size of the force between two fibers that touch"),
    "inclination_mean": ("degrees", "angle of end-to-end vectors with the horizontal, mean"),
    "overlap_max": ("radii", "largest overlap of two fibers"),
    "overlap_mean": ("radii", "mean overlap of the pairs that touch"),
    "axial_strain_max": ("", "largest axial strain of a segment, without sign"),
    "curvature_mean": ("1/m", "angle of joints over segment length, weighted by length"),
    "curvature_max": ("1/m", "largest curvature of a joint"),
    "bending_strain_mean": ("", "strain of the surface by bending, a times curvature, mean"),
    "bending_strain_max": ("", "largest strain of the surface by bending"),
    "pressure_low": ("Pa", "pressure on the lower wall"),
    "pressure_high": ("Pa", "pressure on the upper wall"),
    "wall_work": ("J", "work of moving walls"),
    "normal_difference_1": ("Pa", "N_1 = stress_11 - stress_33"),
    "normal_difference_2": ("Pa", "N_2 = stress_33 - stress_22"),
    "relative_viscosity": ("", "1 + stress of the fibers over that of the fluid, by dissipation"),
}
_PATTERNS: tuple[tuple[str, str, str], ...] = (
    (r"a[123]{2}", "", f"orientation tensor, {BY_LENGTH}"),
    (r"a[123]{2}_fiber", "", f"orientation tensor, {BY_NUMBER}"),
    (r"a[123]{4}", "", f"fourth-order orientation tensor, {BY_LENGTH}"),
    (r"a[123]{4}_fiber", "", f"fourth-order orientation tensor, {BY_NUMBER}"),
    (r"energy_\w+", "J", "energy of this kind, all fibers"),
    (r"inclination_\d\d_\d\d", "", "share of fibers inclined by this many degrees"),
    (r"dissipated_\w+", "J", "energy lost in this way since the start"),
    (r"stress_[123]{2}", "Pa", "what the fibers add to the stress of the box, tension positive"),
    (
        r"stress_contact_[123]{2}",
        "Pa",
        "of it, what contacts with fibers and walls pass on",
    ),
)


def column_meaning(name: str) -> tuple[str, str]:
    """Unit and meaning of a column; both empty for a name that is not known."""
    if name in _MEANINGS:
        return _MEANINGS[name]
    for pattern, unit, meaning in _PATTERNS:
        if re.fullmatch(pattern, name):
            return unit, meaning
    return "", ""


def write_columns(path: Path, tables: Mapping[str, Iterable[str]]) -> None:
    """Write file, column, unit and meaning of each column of `tables`. Raises RecordError."""
    with record_errors(path, "write"), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["file", "column", "unit", "meaning"])
        for table, names in tables.items():
            writer.writerows([table, name, *column_meaning(name)] for name in names)
