"""The figure of error against run time: which recorded rows it takes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))
from plot_plate import draw, plate_parts, varied  # noqa: E402


def written(folder: Path) -> Path:
    """Rows of two parts; one setting was measured twice, another bench is beside them."""
    rows = [
        {"bench": "plate rods", "strain_step": 0.1, "error": 0.5, "seconds_cpu": 9.0},
        {"bench": "plate rods", "strain_step": 0.05, "error": 0.0, "seconds_cpu": 4.0},
        {"bench": "plate rods", "strain_step": 0.1, "error": 0.02, "seconds_cpu": 2.0},
        {"bench": "plate rods", "strain_step": 0.2, "error": 0.04, "seconds_cpu": 1.0},
        {"bench": "engine", "error": 3.0, "seconds_cpu": 1.0},
        {
            "bench": "plate packed_segments",
            "strain_step": 0.05,
            "segment_length": 4e-4,
            "error": 0.03,
            "seconds_cpu": 6.0,
        },
    ]
    path = folder / "rows.jsonl"
    path.write_text("\n".join(map(json.dumps, rows)))
    return path


def test_newest_rows_of_each_part(tmp_path: Path) -> None:
    parts = plate_parts(written(tmp_path))
    assert sorted(parts) == ["packed_segments", "rods"]
    assert [row["strain_step"] for row in parts["rods"]] == [0.2, 0.1]
    assert [row["error"] for row in parts["rods"]] == [0.04, 0.02]


def test_what_a_part_varies() -> None:
    assert varied("tolerance") == varied("packed_tolerance") == "contact_tolerance"
    assert varied("packed_segments") == "segment_length"
    assert varied("chains") == varied("packed") == "strain_step"


def test_figure_is_drawn(tmp_path: Path) -> None:
    draw(written(tmp_path), tmp_path / "error.png")
    assert (tmp_path / "error.png").read_bytes().startswith(b"\x89PNG")
