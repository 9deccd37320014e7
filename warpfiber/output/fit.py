"""Fits of orientation models to the curve of a run: constants, their errors, how well they do.

Least squares of all six components of A over the rows of a run, from several starts: the bounds are
scanned on a grid, and the best node of every block of it is refined. The models and closures are
those of fiberoripy; the first row is the start of their integration. Folgar-Tucker also goes
without a closure (`closure_free`).

Source: confidence from (J^T J)^-1 s^2 with Student's t; residuals of neighboring rows of one run
    are alike, so s^2 is multiplied, and the degrees of freedom divided, by 1 + 2 sum of their
    autocorrelations up to the first negative one.
Symbols: A orientation tensor, lambda shape factor, C_I, C_M, kappa, Omega, D_2, D_3 as in the
    models' papers (see `fiberoripy.orientation`), chi^2 sum of squared residuals over the noise.
Limits: lambda is one number, of the length-weighted aspect ratio; the closure's error ends up in
    the constants, so it is named beside them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpfiber.output.closure_free import LEAST_DIFFUSION, Diffusion
from warpfiber.output.orientation_curve import INDEX, OrientationCurve
from warpfiber.placement.without_contact import split_gradient
from warpfiber.scene import Fault, SceneError

Floats = NDArray[np.float64]
Rate = Callable[..., Floats]

NODES = 4
"""Values of a parameter in the scan of its bounds."""
ALIKE = 0.01
"""Difference of chi^2, relative or of one value, below which starts found the same minimum."""
FEWEST_ROWS = 8
MOST_ROWS = 61
"""Rows of a curve that are fitted, evenly spaced in strain; more would only be more alike."""
DIFFERENCE = 1e-3
"""Relative step of the finite differences of a model: far above the error of its integration."""
ACCURACY = 1e-5
"""Relative error of an integration."""
NEAR = 1e-3
"""Relative change of chi^2 or of the constants at which the search from a start ends."""
SETTLED = 1e-5
"""The same of the best of them: below what is printed."""
MOST_UPDATES = 40
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Parameter:
    """One constant of a model: its name here and in fiberoripy, and where it is looked for."""

    name: str
    keyword: str
    low: float
    high: float
    logarithmic: bool = False

    def nodes(self) -> Floats:
        """Values inside the bounds that a scan takes, (NODES,)."""
        part = (np.arange(NODES) + 0.5) / NODES
        if self.logarithmic:
            return np.asarray(self.low * (self.high / self.low) ** part)
        return np.asarray(self.low + (self.high - self.low) * part)


DIFFUSION = Parameter("C_I", "Ci", 1e-5, 0.1, logarithmic=True)


@dataclass(frozen=True)
class OrientationModel:
    """A model of fiberoripy and its free constants."""

    title: str
    ode: str
    parameters: tuple[Parameter, ...]


MODELS: Mapping[str, OrientationModel] = {
    "folgar_tucker": OrientationModel("Folgar-Tucker", "folgar_tucker_ode", (DIFFUSION,)),
    "rsc": OrientationModel("RSC", "rsc_ode", (DIFFUSION, Parameter("kappa", "kappa", 0.01, 1.0))),
    "iard": OrientationModel("iARD", "iard_ode", (DIFFUSION, Parameter("C_M", "Cm", 0.0, 1.0))),
    "pard": OrientationModel(
        "pARD", "pard_ode", (DIFFUSION, Parameter("Omega", "Omega", 0.5, 1.0))
    ),
    "mrd": OrientationModel(
        "MRD",
        "mrd_ode",
        (DIFFUSION, Parameter("D_2", "D2", 0.0, 1.5), Parameter("D_3", "D3", 0.0, 1.5)),
    ),
}
CLOSURE_FREE = "NONE"
"""Folgar-Tucker alone, from the distribution of directions itself."""
CLOSURES = (CLOSURE_FREE, "IBOF", "ORF", "ORW", "ORW3", "HYBRID", "QUADRATIC", "LINEAR")


@dataclass(frozen=True)
class Estimate:
    """A fitted constant."""

    value: float
    low: float
    """lower end of the 95 % confidence interval, at least 0"""
    high: float
    at_bound: bool
    """whether it stands at an end of the range it was looked for in"""


@dataclass(frozen=True)
class Fitted:
    """One model fitted to a curve."""

    model: str
    closure: str
    estimates: dict[str, Estimate]
    chi2: float
    """sum of squared residuals over noise^2, per value that is fitted"""
    rms: float
    """root mean square residual of a component"""
    alike: float
    """rows of residuals that count as one"""
    starts: tuple[tuple[dict[str, float], float], ...]
    """constants and chi2 that each start ended at"""
    tensor: Floats
    """A of the model, (T, 3, 3)"""

    @property
    def agreeing(self) -> int:
        """Number of starts that ended at the best minimum."""
        return sum(chi2 <= self.chi2 * (1.0 + ALIKE) + ALIKE for _, chi2 in self.starts)


def selected(curve: OrientationCurve, low: float | None, high: float | None) -> OrientationCurve:
    """The part of a curve between two strains, at most MOST_ROWS rows of it."""
    inside = np.ones(len(curve.strain), dtype=bool)
    slack = 1e-9 * float(np.max(np.abs(curve.strain), initial=1.0))
    if low is not None:
        inside &= curve.strain >= low - slack
    if high is not None:
        inside &= curve.strain <= high + slack
    strain, tensor = curve.strain[inside], curve.tensor[inside]
    if len(strain) < FEWEST_ROWS:
        remedy = f"{len(strain)} rows of orientation there, at least {FEWEST_ROWS} are needed"
        remedy += "; widen --from and --to, or run with more record.scalars"
        raise SceneError([Fault("command line", "--from, --to", f"{low}, {high}", remedy)])
    if len(strain) > MOST_ROWS:
        marks = np.linspace(strain[0], strain[-1], MOST_ROWS)
        after = np.clip(np.searchsorted(strain, marks), 1, len(strain) - 1)
        nearer = after - (marks - strain[after - 1] < strain[after] - marks)
        kept = np.unique(nearer)
        strain, tensor = strain[kept], tensor[kept]
    return OrientationCurve(
        strain, tensor, curve.weighting, curve.gradient, curve.aspect_ratio, curve.shape_factor
    )


def fit_model(curve: OrientationCurve, model: str, closure: str, noise: float) -> Fitted:
    """The constants of one model; `noise` is the standard deviation of a component of A."""
    from scipy.optimize import least_squares

    parameters = MODELS[model].parameters
    if closure == CLOSURE_FREE:
        parameters = (replace(DIFFUSION, low=LEAST_DIFFUSION),)
    low, high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
    tensors = integrator(curve, model, closure)

    def residuals(values: Floats) -> Floats:
        """Of sets of constants (P, p), (P, 6 (T - 1))."""
        tensor = tensors(values)
        return _components(tensor[:, 1:] - curve.tensor[1:]) / noise

    def slope(values: Floats) -> Floats:
        """Derivatives (6 (T - 1), p), central where the bounds leave room."""
        step = DIFFERENCE * np.maximum(np.abs(values), DIFFERENCE * high)
        ends = [np.clip(values + step * row, low, high) for row in np.eye(len(step))]
        ends += [np.clip(values - step * row, low, high) for row in np.eye(len(step))]
        above, below = np.split(residuals(np.array(ends)), 2)
        width = np.sum(np.array(ends[: len(step)]) - np.array(ends[len(step) :]), axis=1)
        return np.asarray(((above - below) / width[:, None]).T)

    def refined(start: Floats, settled: float) -> Any:
        return least_squares(
            lambda values: residuals(values[None])[0],
            start,
            jac=slope,
            bounds=(low, high),
            x_scale=high,
            ftol=settled,
            xtol=settled,
            gtol=None,
            max_nfev=MOST_UPDATES,
        )

    found = [refined(start, NEAR) for start in _starts(parameters, residuals)]
    found.sort(key=lambda result: float(result.cost))
    found[0] = best = refined(found[0].x, SETTLED)
    count = len(best.fun)
    alike = correlated_rows(best.fun.reshape(len(curve.strain) - 1, -1))
    names = [p.name for p in parameters]
    return Fitted(
        model,
        closure,
        _estimates(parameters, best.x, best.jac, best.fun, alike),
        2.0 * float(best.cost) / count,
        noise * math.sqrt(2.0 * float(best.cost) / count),
        alike,
        tuple(
            (dict(zip(names, map(float, r.x), strict=True)), 2.0 * float(r.cost) / count)
            for r in found
        ),
        tensors(best.x[None])[0],
    )


def integrator(curve: OrientationCurve, model: str, closure: str) -> Callable[[Floats], Floats]:
    """Function of sets of constants (P, p): A (P, T, 3, 3) of a model, from a curve's first tensor.

    All sets are integrated at once: most of the time goes into the closure, which takes them
    together. Where the integration breaks down A is far off, and no least squares goes there.
    """
    if closure == CLOSURE_FREE:
        free = Diffusion(curve.tensor[0], curve.gradient, curve.shape_factor)
        return lambda values: np.array([free.tensors(row[0], curve.strain) for row in values])
    from fiberoripy import closures, orientation
    from scipy.integrate import solve_ivp

    ode: Rate = getattr(orientation, MODELS[model].ode)
    keywords = [p.keyword for p in MODELS[model].parameters]
    spin, stretch = split_gradient(curve.gradient)

    def tensors(values: Floats) -> Floats:
        own = [dict(zip(keywords, row, strict=True), xi=curve.shape_factor) for row in values]

        def rate(_: float, state: Floats) -> Floats:
            a = np.clip(state.reshape(-1, 3, 3), -1.0, 1.0)
            sets = zip(a, closures.compute_closure(a, closure=closure), own, strict=True)
            return np.ravel([ode(a2, a4, stretch, spin, **constants) for a2, a4, constants in sets])

        count, rows = len(values), len(curve.strain)
        answer = solve_ivp(
            rate,
            (curve.strain[0], curve.strain[-1]),
            np.tile(curve.tensor[0].ravel(), count),
            t_eval=curve.strain,
            rtol=ACCURACY,
            atol=1e-1 * ACCURACY,
        )
        tensor = np.ones((count, rows, 3, 3))
        solved = answer.y.T.reshape(-1, count, 3, 3).swapaxes(0, 1)
        tensor[:, : solved.shape[1]] = np.where(np.isfinite(solved), solved, 1.0)
        return tensor

    return tensors


def correlated_rows(residual: Floats) -> float:
    """Rows (T, c) that count as one: 1 + 2 sum of autocorrelations up to the first negative one."""
    rows = len(residual)
    power = float(np.sum(residual**2))
    if power == 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, rows):
        correlation = float(np.sum(residual[lag:] * residual[:-lag])) / power
        if correlation <= 0.0:
            break
        total += 2.0 * correlation
    return total


def _components(tensor: Floats) -> Floats:
    """The six components of tensors (P, T, 3, 3), one row after the other, (P, 6 T)."""
    rows, columns = zip(*INDEX.values(), strict=True)
    return np.asarray(tensor[..., rows, columns].reshape(len(tensor), -1))


def _starts(parameters: Sequence[Parameter], residuals: Callable[[Floats], Floats]) -> list[Floats]:
    """The best node of every block of the scan; a block is half of each range, or a quarter of one.

    So there are 4 starts for one and two parameters, 8 for three.
    """
    places = np.array(list(itertools.product(range(NODES), repeat=len(parameters))))
    nodes = np.stack([p.nodes()[k] for p, k in zip(parameters, places.T, strict=True)], axis=1)
    cost = np.sum(residuals(nodes) ** 2, axis=1)
    pieces = 4 if len(parameters) == 1 else 2
    _, block = np.unique(places * pieces // NODES, axis=0, return_inverse=True)
    blocks = [np.flatnonzero(block.ravel() == k) for k in range(block.max() + 1)]
    return [nodes[block[np.argmin(cost[block])]] for block in blocks]


def _estimates(
    parameters: Sequence[Parameter], values: Floats, jacobian: Any, residual: Floats, alike: float
) -> dict[str, Estimate]:
    """Values and confidence intervals; the scatter is that of the residuals themselves."""
    from scipy.stats import t

    count, free = len(residual), len(parameters)
    left = max(1.0, count / alike - free)
    scatter = float(residual @ residual) / max(1, count - free) * alike
    covariance = np.linalg.pinv(np.asarray(jacobian).T @ np.asarray(jacobian)) * scatter
    half = float(t.ppf(0.5 + 0.5 * CONFIDENCE, left)) * np.sqrt(np.diag(covariance))
    made = {}
    for p, x, h in zip(parameters, values, half, strict=True):
        near = 1e-4 * (p.high - p.low)
        at_bound = bool(x < p.low + (p.low if p.logarithmic else near) or x > p.high - near)
        made[p.name] = Estimate(float(x), max(0.0, float(x - h)), float(x + h), at_bound)
    return made
