"""A flexible fiber tumbling in shear: the run behind the tables of tip positions and half turns.

Source: Sasayama & Inagaki 2018, Fig. 5 (the case); forces and closures of bead_chain.py.
Symbols: L distance of the end nodes of the straight fiber; a kappa = largest joint angle/(2 M).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .bead_chain import (
    Array,
    Chain,
    acceleration,
    joint_angles,
    segment_geometry,
    shear_gradient,
    step_rk4,
    straight_nodes,
)
from .rigid import hermite_root


@dataclass(frozen=True)
class FlexibleRun:
    """A tumbling fiber: samples on a strain grid and the strain of the half turn."""

    chain: Chain
    half: float  # strain where the end-to-end vector crosses -x; nan if not reached
    strain: Array  # (K,)
    node_pos: Array  # (K, n, 3)
    tip: Array  # (K, 3), last node / L
    a_kappa: Array  # (K,), largest joint angle / (2 M)
    axial_strain: Array  # (K,), largest of the segments

    def at(self, values: Array, strain: float) -> float | Array:
        """Sample of `values` at a strain of the grid."""
        index = int(np.argmin(np.abs(self.strain - strain)))
        if abs(self.strain[index] - strain) > 1e-9:
            raise ValueError(f"strain {strain} is not on the grid")
        return values[index]


def run_flexible(
    chain: Chain,
    *,
    dt: float,
    strain_end: float,
    rate: float = 1.0,
    sample: float = 0.1,
    start_with_flow: bool = False,
) -> FlexibleRun:
    """Shear u = (rate z, 0, 0), fiber along x about the origin, at rest or with v = u.

    `sample` (strain) must be a whole number of steps of dt (time). The half turn is the first
    passage of the end-to-end vector through -x, by cubic interpolation inside the step.
    """
    per_sample = round(sample / (rate * dt))
    if abs(per_sample * rate * dt - sample) > 1e-9 * sample:
        raise ValueError("sample is not a whole number of steps")
    gradient = shear_gradient(rate)
    x = straight_nodes(chain, (1, 0, 0), (0, 0, 0))
    v = x @ gradient.T if start_with_flow else np.zeros_like(x)

    def law(pos: Array, vel: Array) -> Array:
        return acceleration(chain, pos, vel, gradient)

    half = np.nan
    frames = [x.copy()]
    for k in range(round(strain_end / sample) * per_sample):
        before, speed = x[-1] - x[0], v[-1] - v[0]
        x, v = step_rk4(law, x, v, dt)
        after = x[-1] - x[0]
        if np.isnan(half) and after[0] < 0.0 and before[2] < 0.0 <= after[2]:
            slope = (v[-1] - v[0])[2]
            half = rate * hermite_root(k * dt, dt, before[2], speed[2], after[2], slope)
        if (k + 1) % per_sample == 0:
            frames.append(x.copy())
    nodes = np.array(frames)
    return FlexibleRun(
        chain=chain,
        half=half,
        strain=np.arange(len(nodes)) * sample,
        node_pos=nodes,
        tip=nodes[:, -1] / chain.length,
        a_kappa=np.array([max(joint_angles(f), default=0.0) for f in nodes]) / (2 * chain.spacing),
        axial_strain=np.array([segment_geometry(f)[1].max() for f in nodes]) / chain.rest_length
        - 1.0,
    )


def flexible_chain(
    aspect_ratio: float, segments: int, modulus: float, closure: str, **options: object
) -> Chain:
    """Chain with M = (r_f - 1)/N_seg, a = eta = 1, rho = 0.1 (Re = 0.1 at rate 1)."""
    spacing = (aspect_ratio - 1) / segments
    return Chain(segments, spacing, modulus=modulus, closure=closure, **options)  # type: ignore[arg-type]
