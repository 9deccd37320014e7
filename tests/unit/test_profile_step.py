"""tools/profile_step.py on a small cell of every method: each pass once, and its list."""

from __future__ import annotations

import importlib
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest

from warpfiber.methods import pair_search

ROOT = Path(__file__).parents[2]
EDGE = 4e-4
SMALL = {
    "box.size": [EDGE] * 3,
    "fibers.0.count": 24,
    "fibers.0.aspect_ratio": 20,
    "numerics.strain_step": 0.02,
}


@pytest.mark.parametrize("method", ["bead_chain", "overdamped", "rigid_rod"])
def test_every_pass_has_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    """Names in the order of the step, shares that add up, what the list holds."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    monkeypatch.setattr(pair_search, "PRUNED_FROM", 0)
    tool: Any = importlib.import_module("profile_step")
    given = SMALL | {"numerics.method": method, "numerics.segments": 1 + 2 * (method[0] != "r")}
    if method == "bead_chain":
        del given["numerics.strain_step"]
    scene = ROOT / "scenes" / "sasayama_2018" / "shear_cell.toml"
    args = Namespace(
        scene=scene, set=list(given.items()), device="cpu", steps=16, warm=8, workers=2
    )
    seen: list[Any] = []
    begin = tool.wf.Simulation
    monkeypatch.setattr(
        tool.wf, "Simulation", lambda *a, **k: seen.append(begin(*a, **k)) or seen[-1]
    )
    names: list[str] = []
    launches = tool.bytes_moved
    monkeypatch.setattr(
        tool,
        "bytes_moved",
        lambda launch, pairs: names.append(launch.name) or launches(launch, pairs),
    )
    tool.profile(args)
    text = capsys.readouterr().out
    rows = text.splitlines()
    shown = [row[:16].strip() for row in rows[3:]]
    passes = list(dict.fromkeys(names))
    assert shown[: len(passes)] == passes
    end = shown.index("step")
    assert shown[len(passes) : end + 1] == ["list", "overhead", "step"]
    share = sum(float(row[35:43].rstrip("%")) for row in rows[3 : 3 + end])
    assert share == pytest.approx(100.0, abs=0.06 * end)  # each is rounded to 0.1
    pairs = seen[0].method.list
    assert f"{pairs.pair_count / seen[0].model.segment_count:.3f} per segment" in text
    assert ("wide list" in text) == (method == "bead_chain")
    assert ("contact rows" in text) == (method != "bead_chain")
    workers = [row for row in rows if row.startswith("worker")]
    assert len(workers) == 2
    assert all(f"{name} " in row for name in passes for row in workers)
