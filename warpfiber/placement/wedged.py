"""Straight fibers that are too long to turn between two plates, and would be wedged there.

In u = rate z e_x a slender fiber keeps p_y/p_z while p_x/p_z grows by rate times t. One that lies
against the flow rises until p_x = 0, unless the plates stop it: then it stands between them and all
that flows by is held up, a handful of them the whole cell.
Source: Jeffery orbit of a slender rod; it passes upright with p_z = 1/sqrt(1 + (p_y/p_z)^2).
Symbols: H half centerline, gap between the planes that centers of ends reach, lengths in m; p unit
    direction; rate of the shear (sign).
Limits: contact with others may bring fibers there, too, and bent ones slip through.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.capsules import Floats

MARGIN = 0.8
"""Share of the gap that drawn fibers may rise to: packing turns them a little."""


def are_wedged(direction: Floats, half: Floats, gap: float, rate: float) -> NDArray[np.bool_]:
    """Whether fibers (n, 3) lie against a shear of this sign and stand higher than the gap."""
    against = rate * direction[:, 0] * direction[:, 2] < 0.0
    flat = np.hypot(direction[:, 1], direction[:, 2])
    rises = 2.0 * half * np.abs(direction[:, 2]) > gap * flat
    return np.asarray(against & rises)


def mirror_wedged(direction: Floats, half: Floats, gap: float, rate: float) -> int:
    """Turns those of `direction` to the other side of the flow, which it tilts down; how many."""
    wedged = are_wedged(direction, half, MARGIN * gap, rate)
    direction[wedged, 0] *= -1.0
    return int(np.count_nonzero(wedged))
