"""What a rod without bending leaves out: how far flow and contact deform a straight fiber.

Source: period of a fiber in shear against that of a rod (r_f = 100, S_eff = 1 and 0.01: shifts of
    1.65e-5 and 1.7e-3), beam theory, drag 6 pi eta a of touching beads.
Symbols: a radius, L length, N = L/2a beads, E bending modulus, E_s axial modulus, I = pi a^4/4;
    D strain rate of the flow, |D| = sqrt(2/3 D:D), the most that an eigenvalue of an
    incompressible flow can be; S_eff = pi E/(64 eta rate r_f^4).
Limits: bounds of isolated straight fibers; SI throughout; a chain of fibers that press on each
    other passes larger forces than the flow puts on one.
"""

from __future__ import annotations

import math

FLOW_ERROR = 1.6e-5
"""Relative error of a rod's period times S_eff, where the fiber does not buckle."""
BUCKLING_STIFFNESS = 0.04
"""S_eff below which the flow may buckle a fiber: its shape is then no longer near a line."""


def flow_deflection(stiffness: float) -> float:
    """Relative error of the rod model in a flow for the effective stiffness S_eff."""
    return FLOW_ERROR / stiffness if stiffness > BUCKLING_STIFFNESS else math.inf


def flow_stretch(
    aspect_ratio: float, modulus: float, strain_rate: float, viscosity: float
) -> float:
    """Largest axial strain that the flow causes.

    Drag 3 pi eta per length and velocity against |D| s at the distance s of the center sums up to
    P = 3 pi eta |D| (L/2)^2 / 2 in the middle; P/(pi a^2 E_s) = 1.5 eta |D| r_f^2 / E_s.
    """
    return 1.5 * viscosity * strain_rate * aspect_ratio**2 / modulus


def largest_contact_force(
    aspect_ratio: float, radius: float, strain_rate: float, viscosity: float
) -> float:
    """Largest force between two lone equal rods that the flow presses together, N.

    A point of a rod leaves the flow by at most |D| s, s <= L/2: dp/dt - G p is -(1 - lambda) D p
    - lambda p (p.D p). The flow brings the two points, 2a apart, together by 2a |D| at most. So the
    rods approach by w <= |D| (L + 2a). A force f between them takes away at least f (1/xi + 1/xi),
    xi = 6 pi eta a N, and more where it also turns them: f <= w xi/2 = 6 pi eta |D| a^2 N (N + 1).
    """
    beads = aspect_ratio * (aspect_ratio + 1.0)
    return 6.0 * math.pi * viscosity * strain_rate * radius**2 * beads


def contact_deflection(force: float, length: float, radius: float, modulus: float) -> float:
    """Largest deflection, from end to end, of a free fiber under `force` at a point; in lengths.

    Drag balances force and torque linearly along the fiber. Under a force in the middle each half
    is a beam clamped there under f/L: its end stays behind by (f/L) (L/2)^4/(8 E I)
    = f L^3/(128 E I). Most is bent by a force at an end: 1.70 times that, f L^3/(75 E I).
    """
    inertia = 0.25 * math.pi * radius**4
    return force * length**2 / (75.0 * modulus * inertia) if modulus > 0.0 else math.inf
