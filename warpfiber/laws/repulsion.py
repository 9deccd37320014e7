"""Short-range repulsion between two capsules, and its potential.

Source: Sasayama & Inagaki 2018, Eq. (A.1), signs inferred: F = D0 exp(-G0 (D / 2a - 1)) along the
    line of the closest points, for D <= 2.001 a.
Symbols: D distance of the closest points, 2a sum of the two radii, D0 (N), G0 (-).
"""

from functools import cache

import warp as wp

from warpfiber.model import precision

RANGE = 1.0005  # of the sum of the radii: 2.001 a between equal fibers


@cache
def make_repulsion(name):
    """`repulsion_size(D0, G0, D, 2a)` and `repulsion_energy` (zero at the end of the range)."""
    real = precision(name).real
    one, edge = real(1.0), real(RANGE - 1.0)

    @wp.func
    def repulsion_size(strength: real, decay: real, distance: real, contact: real) -> real:
        return strength * wp.exp(-decay * (distance / contact - one))

    @wp.func
    def repulsion_energy(strength: real, decay: real, distance: real, contact: real) -> real:
        here = wp.exp(-decay * (distance / contact - one))
        return strength * contact / decay * (here - wp.exp(-decay * edge))

    return repulsion_size, repulsion_energy
