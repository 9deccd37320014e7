"""Where the fibers are at the start: from statistics or a file, without overlap. Host, NumPy."""

from __future__ import annotations

from warpfiber.placement.packing import Placement, overlap_of, place_fibers, scene_cell
from warpfiber.placement.parts import split_tables
from warpfiber.placement.shaped import shape_feret
from warpfiber.placement.space import Cell

__all__ = [
    "Placement",
    "place_fibers",
    "Cell",
    "scene_cell",
    "overlap_of",
    "split_tables",
    "shape_feret",
]
