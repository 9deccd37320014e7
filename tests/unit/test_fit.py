"""Fits of orientation models: constants found again, false minima left, scatter, which rows.

Tolerances: the confidence intervals that the fit itself gives, and the standard deviations of an
earlier fit of the same synthetic data (C_I 2e-4, kappa 3e-3; C_I 3e-4, C_M 8e-3), five of each.
"""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("fiberoripy")
pytest.importorskip("scipy")

from warpfiber.output.fit import (  # noqa: E402
    CLOSURE_FREE,
    CLOSURES,
    MODELS,
    correlated_rows,
    fit_model,
    integrator,
    selected,
)
from warpfiber.output.orientation_curve import OrientationCurve  # noqa: E402
from warpfiber.scene import SceneError  # noqa: E402

SHEAR = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
START = np.diag([0.36, 0.62, 0.02])
NOISE = 0.005


def curve_of(strain: np.ndarray, tensor: np.ndarray | None = None) -> OrientationCurve:
    made = np.tile(START, (len(strain), 1, 1)) if tensor is None else tensor
    return OrientationCurve(strain, made, "length", SHEAR, 44.0, (44**2 - 1) / (44**2 + 3))


def synthetic(
    model: str, *values: float, closure: str = "IBOF", end: float = 60.0, seed: int = 1
) -> OrientationCurve:
    """A model at 8 strains with symmetric noise; the start is exact."""
    strain = np.linspace(0.0, end, 9)
    clean = integrator(curve_of(strain), model, closure)(np.array([values]))[0]
    scatter = np.random.default_rng(seed).normal(0.0, NOISE, clean.shape)
    low = np.tril_indices(3, -1)
    scatter[:, low[0], low[1]] = scatter[:, low[1], low[0]]
    scatter[0] = 0.0
    return curve_of(strain, clean + scatter)


@pytest.mark.slow
def test_rsc_is_found_again() -> None:
    fit = fit_model(synthetic("rsc", 0.008, 0.15), "rsc", "IBOF", NOISE)
    assert fit.estimates["C_I"].value == pytest.approx(0.008, abs=5 * 2e-4)
    assert fit.estimates["kappa"].value == pytest.approx(0.15, abs=5 * 3e-3)
    # chi2 of 48 values has the standard deviation 0.2
    assert 0.2 < fit.chi2 < 1.8
    assert len(fit.starts) == 4 and fit.agreeing >= 2


def test_a_false_minimum_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """From (0.03, 0.08) the search ends where it began: the model is not smooth there."""
    starts = [np.array([0.03, 0.08]), np.array([0.01, 0.2])]
    monkeypatch.setattr("warpfiber.output.fit._starts", lambda *_: starts)
    fit = fit_model(synthetic("rsc", 0.008, 0.15), "rsc", "IBOF", NOISE)
    assert fit.estimates["kappa"].value == pytest.approx(0.15, abs=5 * 3e-3)
    worst = max(chi2 for _, chi2 in fit.starts)
    assert (fit.agreeing == 1) == (worst > 10.0)
    assert fit.chi2 < 1.8


def test_iard_is_found_again() -> None:
    fit = fit_model(synthetic("iard", 0.01, 0.8), "iard", "IBOF", NOISE)
    assert fit.estimates["C_I"].value == pytest.approx(0.01, abs=5 * 3e-4)
    assert fit.estimates["C_M"].value == pytest.approx(0.8, abs=5 * 8e-3)
    for name, true in (("C_I", 0.01), ("C_M", 0.8)):
        estimate = fit.estimates[name]
        assert estimate.low < true < estimate.high and not estimate.at_bound
    assert fit.agreeing == len(fit.starts) == 4


@pytest.mark.parametrize(
    ("model", "values"),
    [
        ("folgar_tucker", (0.02,)),
        ("rsc", (0.02, 0.3)),
        ("iard", (0.02, 0.5)),
        ("pard", (0.02, 0.8)),
        pytest.param("mrd", (0.02, 0.6, 0.3), marks=pytest.mark.slow),
    ],
)
def test_every_model_fits_its_own_clean_curve(model: str, values: tuple[float, ...]) -> None:
    """To 1e-3, a hundred times the error of the integration over how steep a curve is."""
    strain = np.linspace(0.0, 20.0, 9)
    clean = integrator(curve_of(strain), model, "QUADRATIC")(np.array([values]))[0]
    fit = fit_model(curve_of(strain, clean), model, "QUADRATIC", NOISE)
    got = [estimate.value for estimate in fit.estimates.values()]
    np.testing.assert_allclose(got, values, rtol=1e-2, atol=1e-3)
    assert fit.rms < 1e-4
    np.testing.assert_allclose(fit.tensor, clean, atol=1e-3)
    assert [p.name for p in MODELS[model].parameters] == list(fit.estimates)


def test_no_closure_finds_the_diffusion_of_its_own_curve() -> None:
    """And IBOF, fitted to the same curve, tells another one: the error of the closure."""
    strain = np.linspace(0.0, 10.0, 9)
    clean = integrator(curve_of(strain), "folgar_tucker", CLOSURE_FREE)(np.array([[0.01]]))[0]
    curve = curve_of(strain, clean)
    free = fit_model(curve, "folgar_tucker", CLOSURE_FREE, NOISE)
    assert free.estimates["C_I"].value == pytest.approx(0.01, rel=1e-3)
    assert free.rms < 1e-5 and free.agreeing == 4
    closed = fit_model(curve, "folgar_tucker", "IBOF", NOISE)
    assert abs(closed.estimates["C_I"].value - 0.01) > 5e-4


def test_intervals_hold_the_truth_as_often_as_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """20 noises: 95 % of intervals, at least 15 (the binomial tail below is 0.03 %)."""
    monkeypatch.setattr("warpfiber.output.fit._starts", lambda *_: [np.array([0.015])])
    inside = 0
    for seed in range(20):
        curve = synthetic("folgar_tucker", 0.02, closure="QUADRATIC", end=8.0, seed=seed)
        estimate = fit_model(curve, "folgar_tucker", "QUADRATIC", NOISE).estimates["C_I"]
        inside += estimate.low < 0.02 < estimate.high
        assert estimate.high - estimate.low < 0.01
    assert inside >= 15


@pytest.mark.parametrize("closure", [name for name in CLOSURES if name != CLOSURE_FREE])
def test_every_closure_runs(closure: str) -> None:
    """Together and one by one: two sets of constants do not see each other."""
    strain = np.linspace(0.0, 2.0, 3)
    both = integrator(curve_of(strain), "rsc", closure)(np.array([[0.01, 0.5], [0.03, 1.0]]))
    one = integrator(curve_of(strain), "rsc", closure)(np.array([[0.03, 1.0]]))
    np.testing.assert_allclose(both[1], one[0], atol=1e-4)
    assert np.max(np.abs(both[0] - both[1])) > 1e-3
    np.testing.assert_allclose(np.trace(both, axis1=-2, axis2=-1), 1.0, atol=1e-5)


def test_a_constant_at_its_bound_is_told() -> None:
    """Thin fibers without diffusion: C_I goes to the least that is sought."""
    strain = np.linspace(0.0, 6.0, 9)
    clean = integrator(curve_of(strain), "folgar_tucker", "QUADRATIC")(np.array([[1e-5]]))[0]
    fit = fit_model(curve_of(strain, clean), "folgar_tucker", "QUADRATIC", NOISE)
    assert fit.estimates["C_I"].at_bound and fit.estimates["C_I"].low >= 0.0


def test_noise_changes_chi2_alone() -> None:
    curve = synthetic("folgar_tucker", 0.02, closure="QUADRATIC", end=15.0)
    fine = fit_model(curve, "folgar_tucker", "QUADRATIC", NOISE)
    coarse = fit_model(curve, "folgar_tucker", "QUADRATIC", 2.0 * NOISE)
    assert coarse.chi2 == pytest.approx(fine.chi2 / 4.0, rel=1e-6)
    for a, b in zip(fine.estimates.values(), coarse.estimates.values(), strict=True):
        assert [a.value, a.low, a.high] == pytest.approx([b.value, b.low, b.high], rel=1e-5)


def test_rows_that_are_alike_count_as_one() -> None:
    """White noise: 1. x_t = 0.8 x_(t-1) + noise: (1 + 0.8) / (1 - 0.8) = 9, to 20 %."""
    rng = np.random.default_rng(0)
    assert correlated_rows(rng.standard_normal((4000, 6))) == pytest.approx(1.0, abs=0.1)
    x = np.zeros((4000, 6))
    for k in range(1, 4000):
        x[k] = 0.8 * x[k - 1] + rng.standard_normal(6)
    assert correlated_rows(x) == pytest.approx(9.0, rel=0.2)
    assert correlated_rows(np.zeros((5, 6))) == 1.0


def test_selected_rows() -> None:
    strain = np.linspace(0.0, 60.0, 1001)
    whole = selected(curve_of(strain), None, None)
    assert len(whole.strain) == 61
    np.testing.assert_allclose(np.diff(whole.strain), 1.0, atol=0.07)
    assert whole.strain[0] == 0.0 and whole.strain[-1] == 60.0
    part = selected(curve_of(strain), 6.0, 12.0)
    assert part.strain[0] == pytest.approx(6.0) and part.strain[-1] == pytest.approx(12.0)
    assert len(part.strain) == len(part.tensor) == 61
    with pytest.raises(SceneError, match="5 rows of orientation there, at least 8"):
        selected(curve_of(strain), 6.0, 6.25)
