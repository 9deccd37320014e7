"""How far fibers are bent.

Symbols: away = distance of a node from the line between the ends of its fiber.
"""

from __future__ import annotations

from typing import Any

import numpy as np

BENT = 0.1  # radii: nodes of a bent fiber are farther than that from the line between its ends


def largest_bend(node_pos: Any, fiber_node_start: Any) -> float:
    """Largest such distance of all fibers, in the unit of `node_pos` (N, 3)."""
    start, nodes = np.asarray(fiber_node_start), np.asarray(node_pos, dtype=float)
    counts = np.diff(start)
    first = np.repeat(nodes[start[:-1]], counts, axis=0)
    span = np.repeat(nodes[start[1:] - 1], counts, axis=0) - first
    length2 = np.einsum("ij,ij->i", span, span)
    along = np.einsum("ij,ij->i", nodes - first, span) / np.where(length2 > 0.0, length2, 1.0)
    away = np.linalg.norm(nodes - first - along[:, None] * span, axis=1)
    return float(away.max(initial=0.0))
