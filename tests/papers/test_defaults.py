"""Shipped scenes as they are, with the method that `auto` takes, against the published scheme.

Run with `tools/test -m papers`. Period and flexible turn have exact or converged values; cells are
compared with bead_chain from the same start. A_xx is that of Figs. 8 and 9, its mean over strain
30-60; contacts make single trajectories chaotic.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf
from tests.turning import half_turn, tips
from warpfiber.trial import after_trial

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "sasayama_2018"
pytestmark = pytest.mark.papers

# Last node of the flexible fiber without inertia: SDIRK2 with three Newton iterations at steps of
# 0.0025, whose halving changes 1.2e-7 L; strain: x/L, z/L.
TURN = {
    20: (0.49901462, -0.01589661),
    30: (0.49493013, -0.03944748),
    35: (0.4208568, -0.1278601),
    40: (-0.0624327, -0.1408430),
    45: (-0.4902699, -0.1237738),
    60: (-0.50070480, -0.02325492),
}
FLEXIBLE_HALF_TURN = 90.1247
# A_xx of 200 fibers (r_f = 20, V_f = 0.056) is 0.805 to 0.827 from four random starts, a standard
# deviation of about 0.01; of n fibers sqrt(200 / n) of it.
SCATTER = 0.01


def test_period_is_that_of_a_rigid_rod() -> None:
    """Jeffery's period for r_e^2 = (r_f^2 + 1)/2; the cubic between samples errs by 1e-9."""
    simulation = wf.Simulation(wf.load_scene(SCENES / "period.toml"))
    period = 2.0 * half_turn(simulation)
    assert simulation.scene.numerics.method == "rigid_rod"
    simulation.close()
    r_e = np.sqrt(0.5 * (100.0**2 + 1.0))
    assert period == pytest.approx(2.0 * np.pi * (r_e + 1.0 / r_e), rel=1e-8)


@pytest.mark.parametrize("segments", [1, 9, 33])
def test_period_of_the_chain_without_inertia(segments: int) -> None:
    """Bending shortens it by 1.65e-5 / S_eff = 5.6e-5, and dt = 0.05 errs by 2.2e-6."""
    overrides = {"numerics.method": "overdamped", "numerics.segments": segments}
    simulation = wf.Simulation(wf.load_scene(SCENES / "period.toml", overrides))
    period = 2.0 * half_turn(simulation)
    simulation.close()
    assert period == pytest.approx(444.3993608914, rel=6.0e-5)


def test_flexible_turn() -> None:
    """Tip at six strains, and the half turn; steps of 0.05 err by 2e-5 L."""
    scene = wf.load_scene(SCENES / "flexible.toml")
    assert scene.numerics.method == "overdamped"
    found = tips(scene, np.array(list(TURN), dtype=float))
    assert np.abs(found - np.array(list(TURN.values()))).max() < 4e-5
    simulation = wf.Simulation(scene)
    assert half_turn(simulation) == pytest.approx(FLEXIBLE_HALF_TURN, abs=1e-3)
    simulation.close()


def late_a11(scene: wf.Scene) -> float:
    """Mean A_xx over strain 30-60."""
    simulation = wf.Simulation(scene)
    found = []
    for strain in np.arange(30.0, 60.1, 0.5):
        simulation.run(until=float(strain))
        found.append(simulation.measure()["a11"])
    simulation.close()
    return float(np.mean(found))


@pytest.mark.parametrize(
    ("name", "method"), [("shear_cell", "rigid_rod"), ("flexible_rf30_vf037", "overdamped")]
)
def test_cell_agrees_with_the_published_scheme(name: str, method: str) -> None:
    """Two runs from one start differ by less than two runs from two starts: two deviations."""
    shipped = after_trial(wf.load_scene(SCENES / f"{name}.toml"))
    assert shipped.numerics.method == method
    explicit = wf.load_scene(SCENES / f"{name}.toml", {"numerics.method": "bead_chain"})
    fibers = shipped.fibers[0].count
    bound = 2.0 * SCATTER * np.sqrt(200.0 / fibers)
    assert late_a11(shipped) == pytest.approx(late_a11(explicit), abs=bound)
