"""What a contact yields: the gap that belongs to a contact force, as the dual problem needs it.

Source: rows e = b + J delta + y(f), 0 <= f, e >= 0, one of them an equality. `hard`: y = 0.
    `linear`: penalty f = -k g, y = f/k. `exponential` (Sasayama & Inagaki 2018, Eq. A.1, signs
    inferred): f = D0 exp(-G0 g/2a) for g <= 0.001 a, so y = -g(f) = (2a/G0) ln(f/D0); forces
    smaller than the law's at the end of its range act there, y = -0.001 a.
Symbols: 2a sum of the two radii, g gap, f force, D0 strength, G0 decay, k stiffness.
"""

from functools import cache

import warp as wp

from warpfiber.laws.repulsion import RANGE
from warpfiber.model import precision

LAWS = ("hard", "linear", "exponential")


@cache
def make_contact_compliance(name, law):
    """`opening(k, G0, 2a, f)` = y and `softness(k, G0, 2a)`, the largest dy/df; k is D0 or k."""
    if law not in LAWS:
        raise ValueError(f"no contact law {law!r}")
    real = precision(name).real
    zero, one, edge = real(0.0), real(1.0), real(RANGE - 1.0)

    @wp.func
    def opening(stiffness: real, decay: real, contact: real, force: real) -> real:
        if wp.static(law == "linear"):
            return force / stiffness
        if wp.static(law == "exponential"):
            ratio = force / stiffness
            if ratio <= wp.exp(-decay * edge):
                return -edge * contact
            return contact / decay * wp.log(ratio)
        return zero

    @wp.func
    def softness(stiffness: real, decay: real, contact: real) -> real:
        if wp.static(law == "linear"):
            return one / stiffness
        if wp.static(law == "exponential"):
            return contact / decay * wp.exp(decay * edge) / stiffness
        return zero

    return opening, softness
