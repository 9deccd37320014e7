"""First moments of drag and contact forces on fibers, bead by bead and pair by pair.

Source: force 6 pi eta a (u - v) on every bead of a chain, moved along with the line between its
    nodes; a pair of fibers that press on each other with the force F (on the first) adds
    (x_c2 - x_c1) F, with the middles x_c of both; a wall adds (x_w - x_c) F with the point x_w
    that it touches. A straight rod that turns freely, p' = W p + lambda (S p - p p.S p), has
        K [lambda pp (p.S p) + (1 - lambda) sym(S p p)],  K = 2 pi eta a^3 N (N^2 - 1).
Symbols: M beads per segment, N beads of a rod, lambda = (N^2 - 1)/(N^2 + 3), W, S antisymmetric and
    symmetric part of the gradient.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def symmetric(moment: Array) -> Array:
    """Symmetric part (..., 3, 3)."""
    return 0.5 * (moment + np.swapaxes(moment, -1, -2))


def bead_middle(nodes: Array, spacing: int) -> Array:
    """Mean place of the beads of a chain (n, 3)."""
    return _along(nodes, spacing).mean(axis=0)


def drag_moment(
    nodes: Array,
    velocity: Array,
    spacing: int,
    radius: float,
    viscosity: float,
    gradient: Array,
    origin: Array,
) -> Array:
    """sum over beads of (r - x_c) 6 pi eta a (u - v), made symmetric (3, 3)."""
    place, speed = _along(nodes, spacing), _along(velocity, spacing)
    force = 6.0 * np.pi * viscosity * radius * ((place - origin) @ gradient.T - speed)
    return symmetric((place - place.mean(axis=0)).T @ force)


def rod_moment(axis: Array, beads: float, radius: float, viscosity: float, strain: Array) -> Array:
    """Moment (3, 3) of one free rod along `axis` in the rate of strain (3, 3)."""
    shape = (beads**2 - 1.0) / (beads**2 + 3.0)
    stretched = strain @ axis
    along = float(axis @ stretched)
    own = shape * along * np.outer(axis, axis)
    own += (1.0 - shape) * symmetric(np.outer(stretched, axis))
    return 2.0 * np.pi * viscosity * radius**3 * beads * (beads**2 - 1.0) * own


def _along(values: Array, spacing: int) -> Array:
    """Values of nodes (n, 3) at all beads, linear between."""
    parts = [values[:1]]
    for first, last in zip(values[:-1], values[1:], strict=True):
        t = np.arange(1, spacing + 1)[:, None] / spacing
        parts.append(first + t * (last - first))
    return np.concatenate(parts)
