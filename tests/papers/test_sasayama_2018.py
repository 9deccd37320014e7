"""Shipped scenes against the numbers of Sasayama & Inagaki 2018 and of the float64 restatement.

Run with `tools/test -m papers` (a few minutes). The curves of the paper's figures are not in
tables, so its statements are tested; the restatement (tests/reference, RK4) stands for its curves.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf
from tests.reference.flexible import flexible_chain, run_flexible
from tests.turning import half_turn, tips

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "sasayama_2018"
pytestmark = pytest.mark.papers

# Error of the period without correction in percent (rigid chain of touching beads, exact).
UNCORRECTED = {1: -75.63, 3: -74.32, 9: -65.31, 11: -62.64, 33: -40.51}


def period(segments: int, closure: str) -> float:
    """Period by the published scheme in strain, 2 t_1."""
    overrides = {
        "numerics.method": "bead_chain",
        "numerics.segments": segments,
        "numerics.closure": closure,
    }
    simulation = wf.Simulation(wf.load_scene(SCENES / "period.toml", overrides))
    value = 2.0 * half_turn(simulation)
    simulation.close()
    return value


@pytest.fixture(scope="module")
def full_period() -> float:
    """Period of the full chain, 99 segments (about a minute)."""
    return period(99, "paper")


def test_period_of_the_full_chain(full_period: float) -> None:
    """Against the rigid chain with inertia, 444.4378; 1e-4 allows for the finite stiffness."""
    assert full_period == pytest.approx(444.4378, rel=1e-4)


@pytest.mark.parametrize("closure", ["paper", "consistent"])
@pytest.mark.parametrize("segments", [1, 3, 9, 11, 33])
def test_corrected_period_is_that_of_the_full_chain(
    segments: int, closure: str, full_period: float
) -> None:
    """Fig. 3: errors "mostly eliminated"; here within 0.01 %."""
    assert period(segments, closure) == pytest.approx(full_period, rel=1e-4)


@pytest.mark.parametrize("segments", sorted(UNCORRECTED))
def test_uncorrected_period(segments: int, full_period: float) -> None:
    """Fig. 3, open symbols: within 0.1 percentage points of the exact chain."""
    error = 100.0 * (period(segments, "none") / full_period - 1.0)
    assert error == pytest.approx(UNCORRECTED[segments], abs=0.1)


def tip_curve(segments: int, closure: str, fraction: float, strains: np.ndarray) -> np.ndarray:
    """x/L, z/L of the last node at the given strains by the published scheme, (K, 2)."""
    overrides = {
        "numerics.method": "bead_chain",
        "numerics.segments": segments,
        "numerics.closure": closure,
        "numerics.dt_fraction": fraction,
    }
    return tips(wf.load_scene(SCENES / "flexible.toml", overrides), strains)


@pytest.mark.parametrize(
    ("segments", "closure"), [(49, "consistent"), (25, "consistent"), (25, "paper")]
)
def test_flexible_fiber_at_half_the_stable_step(segments: int, closure: str) -> None:
    """Fig. 5a: tip within 1e-3 L of the restatement (RK4, dt 2e-3) to strain 60."""
    chain = flexible_chain(50, segments, 5e4, closure)
    run = run_flexible(chain, dt=2e-3, strain_end=60.0)
    strains = np.arange(1.0, 60.5, 1.0)
    expected = np.array([[run.at(run.tip[:, k], s) for k in (0, 2)] for s in strains])
    found = tip_curve(segments, closure, 0.5, strains)
    assert np.abs(found - expected).max() < 1e-3


def test_reduced_flexible_fibers_agree_with_the_full_chain() -> None:
    """Fig. 5: 49, 25 and 15 segments "match well": worst tip difference as tabulated, + 20 %."""
    strains = np.arange(0.5, 160.0, 0.5)
    full = tip_curve(49, "consistent", 0.5, strains)[:, 1]
    for segments, closure, bound in (
        (25, "consistent", 0.0046),
        (15, "consistent", 0.0156),
        (25, "paper", 0.0097),
        (15, "paper", 0.030),
    ):
        worst = np.abs(tip_curve(segments, closure, 0.5, strains)[:, 1] - full).max()
        assert worst < 1.2 * bound, (segments, closure, worst)
        assert worst > 0.2 * bound, (segments, closure, worst)
    uncorrected = np.abs(tip_curve(15, "none", 0.5, strains)[:, 1] - full).max()
    assert uncorrected == pytest.approx(0.24, rel=0.2)
