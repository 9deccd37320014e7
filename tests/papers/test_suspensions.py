"""Figs. 6-9 of Sasayama & Inagaki 2018: reduced against full chains in the same sheared cells.

Run with `tools/test -m slow` (an hour and a half); `tools/bench.py suspensions` writes such runs of
all cells to the benchmark record, with their curves.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "sasayama_2018"
pytestmark = pytest.mark.slow


def late_orientation(name: str, seed: int, **numerics: object) -> tuple[float, float]:
    """Mean A_xx and interactions per fiber over strain 30-60 by the published scheme."""
    overrides = {f"numerics.{key}": value for key, value in numerics.items()}
    overrides |= {"seed": seed, "numerics.method": "bead_chain"}
    simulation = wf.Simulation(wf.load_scene(SCENES / f"{name}.toml", overrides))
    rows = []
    for strain in np.arange(30.0, 60.1, 0.5):
        simulation.run(until=float(strain))
        rows.append(simulation.measure())
    simulation.close()
    return (
        float(np.mean([row["a11"] for row in rows])),
        float(np.mean([row["interactions_per_fiber"] for row in rows])),
    )


@pytest.mark.parametrize(
    ("name", "segments"),
    [
        ("flexible_rf30_vf037", 10),
        ("flexible_rf20_vf056", 7),
        ("shear_cell", 3),
        ("rigid_rf10_vf122", 3),
        ("rigid_rf10_vf201", 3),
    ],
)
def test_reduced_suspension_agrees_with_the_full_chain(name: str, segments: int) -> None:
    """V_f r_f > 1: means of three seeds differ by less than their scatter.

    Bound: twice the standard error of the difference, with the scatter of both sets of seeds, but
    not less than 0.01, which is what a paper's figure can show.
    """
    seeds = (1, 2, 3)
    reduced, reduced_count = np.array(
        [late_orientation(name, seed, segments=segments) for seed in seeds]
    ).T
    full, full_count = np.array([late_orientation(name, seed, reduced_beads=0) for seed in seeds]).T
    # interactions are counted per pair of segments: a full chain, of more segments, has more
    assert 1.0 < reduced_count.mean() < full_count.mean()
    scatter = np.sqrt((reduced.var(ddof=1) + full.var(ddof=1)) / len(seeds))
    assert abs(reduced.mean() - full.mean()) < max(2.0 * scatter, 0.01)
