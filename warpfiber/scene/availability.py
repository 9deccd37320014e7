"""What the scene schema knows but this version cannot run yet: one table, one row per key.

The keys are read and checked like all others, so that a scene of a later version gets an honest
answer instead of "unknown key". A version that adds a feature removes its row or adds its word.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """The values of `table.key` that run now (none: the key itself does not), and advice."""

    table: str
    key: str
    available: tuple[object, ...]
    advice: str


NOT_IN_THIS_VERSION: tuple[Row, ...] = (
    Row("flow", "kind", ("simple_shear", "planar_extension", "uniaxial_extension", "gradient",
                         "rest"), 'use one of the linear flows, e.g. kind = "gradient"'),
    Row("record", "quantities", ("orientation", "orientation4", "contacts", "overlap",
                                 "interactions", "axial_strain", "energy", "rotation",
                                 "curvature", "stress", "inclination"),
        "remove the others from the list"),
    Row("record", "node_fields", ("velocity", "bond_stress", "contact_count"),
        "remove the others from the list"),
)  # fmt: skip


STRAIGHT = Row("shape", "kind", ("straight",),
               'fibers of this method are straight at rest; use kind = "straight", '
               "or node_file to start from another form")  # fmt: skip
IN_FLOW = ("orientation", "orientation4", "contacts", "overlap", "interactions", "axial_strain",
           "energy", "rotation", "curvature")  # fmt: skip
FLOWING = (
    STRAIGHT,
    Row("stage", "kind", ("flow",), 'use kind = "flow"; "settle" is of method bonded_spheres'),
    Row("stage", "end_speed", (), "end the stage by end_strain or end_time"),
    Row("stage", "end_volume_fraction", (), "end the stage by end_strain or end_time"),
    Row("stage", "end_pressure", (), "end the stage by end_strain or end_time"),
    Row("stage", "save", (False,), "remove it; a run can be resumed from its checkpoints"),
    Row("record", "node_fields", ("velocity",), "remove it; it is of method bonded_spheres"),
)
SOFT = Row("contact", "law", ("none", "exponential", "linear"),
           'use law = "exponential", "linear" or "none"')  # fmt: skip

NOT_IN_METHOD: dict[str, tuple[Row, ...]] = {
    "bead_chain": (
        *FLOWING,
        Row("contact", "friction", (0.0,),
            'remove it; repulsion is frictionless, use method = "overdamped" or "rigid_rod"'),
        Row("contact", "wall_friction", (0.0,),
            'remove it; walls are frictionless, use method = "overdamped" or "rigid_rod"'),
        Row("fibers", "inextensible", (False,),
            'use method = "overdamped"; or remove it: axial_modulus sets the stretch'),
        Row("contact", "law", ("none", "exponential"),
            'use law = "exponential", or method = "overdamped"'),
        Row("numerics", "contact", ("penalty",),
            'use contact = "penalty", or method = "overdamped"'),
        Row("record", "quantities", IN_FLOW, 'remove it, or use method = "overdamped" for stress'),
    ),
    "overdamped": (
        *FLOWING,
        SOFT,
        Row("record", "quantities", (*IN_FLOW, "stress"),
            "remove it from the list; it is of method bonded_spheres"),
        Row("numerics", "closure", ("consistent",), 'use closure = "consistent"'),
    ),
    "rigid_rod": (
        *FLOWING,
        SOFT,
        Row("record", "quantities", (*IN_FLOW, "stress"),
            "remove it from the list; it is of method bonded_spheres"),
        Row("numerics", "closure", ("consistent",), 'use closure = "consistent"'),
    ),
    "bonded_spheres": (
        Row("stage", "kind", ("settle", "pour", "compress", "unload", "pull", "shear"),
            'there is no fluid; use kind = "settle", "compress" or another one'),
        Row("contact", "law", ("none", "hertz"), 'use law = "hertz", or "none"'),
        Row("contact", "lubrication", ("none",), "remove it; there is no fluid"),
        Row("numerics", "contact", ("penalty",), 'use contact = "penalty"'),
        Row("fibers", "inextensible", (False,), "remove it; axial_modulus sets the stretch"),
    ),
}  # fmt: skip
"""Values that run with one method only, defaults included."""


def unavailable_in(method: str | None, table: str, key: str, value: object) -> str | None:
    """Return what to do instead if `method` cannot run `table.key = value`, else None."""
    rows = NOT_IN_METHOD.get(method or "", ())
    return next(
        (
            _refusal(row, value, f"method {method}")
            for row in rows
            if (row.table, row.key) == (table, key)
        ),
        None,
    )


def unavailable(table: str, key: str, value: object) -> str | None:
    """Return what to do instead if this version cannot run `table.key = value`, else None.

    An empty `key` asks for the table as a whole; of a list every entry must be available.
    """
    for row in NOT_IN_THIS_VERSION:
        if (row.table, row.key) != (table, key):
            continue
        return _refusal(row, value, "this version")
    return None


def _refusal(row: Row, value: object, where: str) -> str | None:
    """Return what is wrong with a value of a row, None if it is available."""
    entries = value if isinstance(value, tuple) else (value,)
    missing = [entry for entry in entries if entry not in row.available]
    if row.available and not missing:
        return None
    names = ", ".join(dict.fromkeys(str(entry) for entry in missing)) if row.available else ""
    subject = f"{names} is " if isinstance(value, tuple) and names else ""
    return f"{subject}not available in {where}; {row.advice}"
