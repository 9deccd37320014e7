"""Figure of error against run time from the rows of `bench.py plate`.

    python tools/plot_plate.py FIGURE [ROWS]

Of every part the last rows that were recorded; the reference of a part, whose error is 0, is not
drawn. ROWS: tools/results/bench.jsonl.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results" / "bench.jsonl"
VARIED = {"tolerance": "contact_tolerance", "segments": "segment_length"}


def plate_parts(rows: Path) -> dict[str, list[dict[str, Any]]]:
    """Part -> its newest rows by setting, coarsest first; only those that are no reference."""
    newest: dict[tuple[str, float], dict[str, Any]] = {}
    for line in rows.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        if str(row.get("bench", "")).startswith("plate "):
            part = row["bench"].removeprefix("plate ")
            newest[part, row[varied(part)]] = row
    parts: dict[str, list[dict[str, Any]]] = {}
    for (part, _), row in sorted(newest.items(), reverse=True):
        if row["error"] > 0.0:
            parts.setdefault(part, []).append(row)
    return parts


def varied(part: str) -> str:
    """Setting that differs between the rows of a part."""
    return VARIED.get(part.removeprefix("packed_"), "strain_step")


def draw(rows: Path, figure: Path) -> None:
    """One line per part, its points named by what was set."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    canvas, axes = pyplot.subplots(figsize=(7.0, 4.5))
    for part, found in plate_parts(rows).items():
        seconds = [row["seconds_cpu"] for row in found]
        axes.loglog(seconds, [row["error"] for row in found], "o-", label=f"{part}: {varied(part)}")
        for row in found:
            name = f"{row[varied(part)]:g}"
            axes.annotate(name, (row["seconds_cpu"], row["error"]), fontsize=7)
    axes.set_xlabel("CPU time of stepping, s")
    axes.set_ylabel("largest error of a11, a22, a33, a13")
    axes.legend(fontsize=7)
    canvas.tight_layout()
    canvas.savefig(figure, dpi=150)
    pyplot.close(canvas)


if __name__ == "__main__":
    draw(Path(sys.argv[2]) if len(sys.argv) > 2 else RESULTS, Path(sys.argv[1]))
