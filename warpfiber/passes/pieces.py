"""How many pieces a segment is entered into the cells as, by group of fibers.

Cost of a search, in the time of one candidate: every piece meets the midpoints within the reach and
half the longest piece of it, and has a cost of its own. Halving a long segment doubles its pieces
but lets all cells be narrower. The counts depend on lengths at rest and on the box, not on
where the segments are, so a run and its continuation cut alike.
"""

from __future__ import annotations

import math

PIECE_COST = 12.0  # a piece costs as much as this many candidates (measured, 20,000 segments)
MOST_PIECES = 64


def piece_counts(
    lengths: list[float], numbers: list[int], reach: float, volume: float
) -> list[int]:
    """Pieces of one segment of each group: `numbers` segments of `lengths`, in a `volume`."""
    if not lengths:
        return []
    best, least = [1] * len(lengths), math.inf
    for parts in range(1, MOST_PIECES + 1):
        limit = max(lengths) / parts
        counts = [min(MOST_PIECES, math.ceil(length / limit * (1.0 - 1e-9))) for length in lengths]
        pieces = [number * count for number, count in zip(numbers, counts, strict=True)]
        sizes = [length / count for length, count in zip(lengths, counts, strict=True)]
        around = reach + 0.5 * max(sizes)
        cost = PIECE_COST * sum(pieces)
        for number, size in zip(pieces, sizes, strict=True):
            near = math.pi * around**2 * (size + 4.0 / 3.0 * around)
            cost += 0.5 * number * min(1.0, near / volume) * sum(pieces)
        if cost < 0.98 * least:  # more pieces must be worth their while
            best, least = counts, cost
    return best
