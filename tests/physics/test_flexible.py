"""A flexible fiber tumbling in shear: convergence in dt, and in segments to the unreduced fiber.

Source of the numbers: Runge-Kutta runs of another coding at steps that change no digit printed,
r_f = 25, E = 3125, a = eta = rate = 1, density 0.1 (S_eff of Sasayama & Inagaki 2018, Fig. 5).
Columns: strain of the half turn; z/L of the last node at strains 10, 15, 20, 30; x/L at 20.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, straight_fiber
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
LENGTH = 48.0
STRAINS = (10.0, 15.0, 20.0, 30.0)
TIPS = {
    (24, "none"): (-0.044435561, -0.157173443, -0.130954664, -0.042618202, -0.178933407),
    (12, "paper"): (-0.043941059, -0.155199023, -0.132071316, -0.042330085, -0.183891396),
    (12, "consistent"): (-0.044951935, -0.155963053, -0.129670139, -0.042556686, -0.180111838),
    (8, "paper"): (-0.042984314, -0.148194955, -0.134714919, -0.042743882, -0.190148922),
    (8, "consistent"): (-0.045950721, -0.151773598, -0.127770814, -0.042943279, -0.184849772),
    (6, "paper"): (-0.041024850, -0.141352878, -0.139849604, -0.043820639, -0.172099941),
    (4, "paper"): (-0.031910252, -0.132823301, -0.112671869, -0.050112599, -0.033133183),
}


def tips(start: Start, segments: int, closure: str, **numerics: object) -> tuple[np.ndarray, float]:
    """z/L at STRAINS and x/L at 20 of the last node, and dt."""
    kind = Kind(segments, 24.0 / segments, modulus=3125.0)
    sim = start(
        [kind],
        [straight_fiber(kind, (1, 0, 0), (0, 0, 0))],
        velocity=np.zeros((segments + 1, 3)),
        flow=SHEAR,
        numerics={"closure": closure, **numerics},
    )
    found = []
    for strain in STRAINS:
        # the step that ends nearest to the mark, then along the velocity to the mark itself
        sim.run(strain - 0.5 * sim.dt)
        tip = sim.node_pos[-1] + (strain - sim.time) * sim.node_velocity[-1]
        found.append(tip[2] / LENGTH)
        if strain == 20.0:
            along = tip[0] / LENGTH
    return np.array([*found, along]), sim.dt


@pytest.mark.parametrize(("segments", "closure"), TIPS)
def test_half_the_stable_step(start: Start, segments: int, closure: str) -> None:
    """At the default dt (half the limit) the tip is within 1e-3 L; 0.07 dt (0.059 measured)."""
    got, dt = tips(start, segments, closure)
    error = np.abs(got - TIPS[segments, closure]).max()
    assert error < 1e-3
    assert error < 0.07 * dt


@pytest.mark.parametrize(("segments", "closure"), [(12, "paper"), (12, "consistent")])
def test_first_order_in_dt(start: Start, segments: int, closure: str) -> None:
    """Error of the tip against Runge-Kutta over dt = 8, 4, 2 e-3: exponent 1 within 0.03."""
    steps = np.array([8e-3, 4e-3, 2e-3])
    errors = [
        np.abs(tips(start, segments, closure, dt=dt)[0] - TIPS[segments, closure]).max()
        for dt in steps
    ]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(steps))
    assert np.abs(slopes - 1.0).max() < 0.03


def test_convergence_in_segments(start: Start) -> None:
    """`consistent`: the distance to the fiber of 24 segments falls from 8 to 12 by second order.

    (12/8)^2 = 2.25; at strain 15, the largest deflection: ratio between 1.8 and 6.
    """
    full = TIPS[24, "none"][1]
    coarse, fine = (tips(start, n, "consistent", dt=2e-3)[0][1] for n in (8, 12))
    assert 1.8 < abs(coarse - full) / abs(fine - full) < 6.0
