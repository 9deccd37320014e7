"""Nodes of a fiber from its center, direction and rest shape.

Symbols: L_c centerline length, node to node (m).
Limits: straight fibers only.
"""

from __future__ import annotations

import numpy as np

from warpfiber.placement.capsules import Floats


def straight_nodes(
    center: Floats, direction: Floats, centerline_length: float, segments: int
) -> Floats:
    """Equally spaced nodes (n, segments + 1, 3) m; center (n, 3) m, direction (n, 3)."""
    along = (np.arange(segments + 1) / segments - 0.5) * centerline_length
    return np.asarray(center[:, None, :] + along[None, :, None] * direction[:, None, :])
