"""Lengths of fibers from two averages and two limits, or from a measured histogram.

The law is log-normal or Weibull, cut to [shortest, longest]; its two parameters are those with the
asked averages after the cut. A sample takes the quantiles (i + 1/2) / n, so its averages are those
of the law to 1 / n^2 of their spread instead of 1 / sqrt(n).

Source: averages as in ASTM practice, L_N = sum n L / sum n, L_W = sum n L^2 / sum n L. Kunc: fibers
    of a burned-off column of diameter d are counted if they cross it at all, the long ones too
    often: n is divided by 1 + 4 L / (pi d) (Kunc et al., SPE ACCE 2007).
Symbols: L length tip to tip (m), L_N number average, L_W weight average (m), q part of the number.
Limits: one peak per law. Inside a bin of a histogram all lengths are equally likely.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpfiber.placement.cells import Floats
from warpfiber.scene import LengthDistribution

POINTS = 20_001
"""Points of the table of a law, even in ln L; its averages are then exact to 1e-8."""
CLOSE = 1e-9
"""Relative error of the averages of a law."""
NEWTON_STEPS = 200
SHAPES = (0.02, 50.0)
"""Range of sigma and of 1 / k: narrower laws are one length, wider ones uniform in ln L."""


@dataclass(frozen=True)
class LengthLaw:
    """A law of lengths as a table."""

    length: Floats
    """m, rising, (n,)"""
    cumulative: Floats
    """part of the number that is shorter, 0 ... 1, (n,)"""
    number_average: float
    """m"""
    weight_average: float
    """m"""

    def sample(self, count: int) -> Floats:
        """Lengths (count,) m, rising: the middle quantiles of equal parts of the number."""
        q = (np.arange(count) + 0.5) / count
        return np.asarray(np.interp(q, self.cumulative, self.length))


def length_law(asked: LengthDistribution, shortest: float, longest: float) -> LengthLaw:
    """The law of a scene, between two limits in m; ValueError says what cannot be."""
    if asked.histogram is not None:
        return _measured(asked, shortest, longest)
    assert asked.number_average is not None and asked.weight_average is not None
    return _fitted(asked.kind, asked.number_average, asked.weight_average, shortest, longest)


def averages(length: Floats) -> tuple[float, float]:
    """L_N and L_W of lengths (n,), m."""
    total = float(length.sum())
    return total / len(length), float(np.sum(length**2)) / total


def _measured(asked: LengthDistribution, shortest: float, longest: float) -> LengthLaw:
    """The law of a histogram, cut to the limits, Kunc's correction included."""
    assert asked.histogram is not None
    rows = np.array(asked.histogram, dtype=np.float64)
    low, high = np.maximum(rows[:, 0], shortest), np.minimum(rows[:, 1], longest)
    inside = high > low
    if not np.any(inside & (rows[:, 2] > 0.0)):
        raise ValueError(f"no fiber is between {shortest:.4g} and {longest:.4g} m long")
    part = rows[inside, 2] * (high - low)[inside] / (rows[:, 1] - rows[:, 0])[inside]
    low, high = low[inside], high[inside]
    middle = 0.5 * (low + high)
    if asked.kunc_diameter is not None:
        part = part / (1.0 + 4.0 * middle / (math.pi * asked.kunc_diameter))
    part = part / part.sum()
    first = float(np.sum(part * middle))
    second = float(np.sum(part * (middle**2 + (high - low) ** 2 / 12.0)))
    edges = np.append(low, high[-1])
    return LengthLaw(edges, np.append(0.0, np.cumsum(part)), first, second / first)


def _fitted(kind: str, l_n: float, l_w: float, shortest: float, longest: float) -> LengthLaw:
    """The cut law with these averages."""
    x = np.linspace(math.log(shortest), math.log(longest), POINTS)
    length = np.exp(x)

    def law(scale: float, shape: float) -> LengthLaw:
        """Of ln of the scale in m, and ln of sigma or 1 / k."""
        width = math.exp(shape)
        u = (x - scale) / width
        # ln of the density of ln L; Weibull's 1 / k plays the part of sigma
        exponent = -0.5 * u * u if kind == "lognormal" else u - np.exp(np.minimum(u, 700.0))
        density = np.exp(exponent - exponent.max())
        mass = 0.5 * (density[1:] + density[:-1])
        cumulative = np.append(0.0, np.cumsum(mass))
        number = density.copy()
        number[[0, -1]] *= 0.5
        first = float(np.sum(number * length) / cumulative[-1])
        second = float(np.sum(number * length**2) / cumulative[-1])
        return LengthLaw(length, cumulative / cumulative[-1], first, second / first)

    def miss(at: Floats) -> Floats:
        made = law(float(at[0]), float(at[1]))
        return np.log([made.number_average / l_n, made.weight_average / l_w])

    spread = math.sqrt(max(math.log(l_w / l_n), 1e-6))
    at = np.array([math.log(l_n) - 0.5 * spread**2, math.log(spread)])
    error = miss(at)
    for _ in range(NEWTON_STEPS):
        if np.max(np.abs(error)) < CLOSE:
            return law(float(at[0]), float(at[1]))
        slope = np.stack([(miss(at + h) - miss(at - h)) / 2e-5 for h in 1e-5 * np.eye(2)], axis=1)
        move = np.linalg.lstsq(slope, -error, rcond=None)[0]
        move *= min(1.0, 0.5 / float(np.max(np.abs(move))))
        for _ in range(30):
            new = at + move
            new[1] = np.clip(new[1], *np.log(SHAPES))
            tried = miss(new)
            if np.linalg.norm(tried) < np.linalg.norm(error):
                break
            move *= 0.5
        else:
            break
        at, error = new, tried
    near = law(float(at[0]), float(at[1]))
    raise ValueError(
        f"no {kind} law between {shortest:.4g} and {longest:.4g} m has these averages; the nearest "
        f"has {near.number_average:.4g} and {near.weight_average:.4g} m"
    )
