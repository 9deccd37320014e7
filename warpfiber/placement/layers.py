"""Directions and centers of fibers of many lengths, layer by layer through the thickness.

`inside`: each fiber stays in its layer, so |p_z| <= (thickness - d) / (L - d): directions that do
not fit are drawn again. The tensor of a layer counts one vote per fiber.
`span`: the center of a fiber lies in its layer and the fiber reaches into the others; only the
outer walls turn directions away. The tensor of a layer is that of the pieces in it, by length.

What was drawn is measured, and the tensors and shares to draw from are corrected by what is
missing, with the same random numbers, until they are met or no longer come closer.

Source: orientation distribution as in `orientations`. Layers of measured volume fraction and
    orientation, stacked as clusters of fibers (`inside`), are those of the sliding-plate cell in
    "Direct fiber model validation: orientation evolution in simple shear flow".
Symbols: H half centerline (m), p direction, a radius (m), K layers.
Limits: layers along z between walls. A tensor that a thin layer cannot hold is missed: the report
    says by how much. Lengths do not depend on the layer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from warpfiber.placement.capsules import Floats, Ints
from warpfiber.placement.orientations import draw_directions, match_moments
from warpfiber.placement.slices import slices, votes
from warpfiber.placement.space import Cell, wall_distance
from warpfiber.placement.wedged import mirror_wedged

ROUNDS = 40
"""Times that directions which do not fit are drawn again."""
CANDIDATES = 32
"""Directions drawn for a fiber each time; the first that fits is taken."""
TURNS = 3
"""Times that directions inside a layer are turned to its tensor."""
CORRECTIONS = 6
CLOSE = 1e-3
"""Largest error of a tensor or of a share that needs no further correction."""
CLASS = 64
"""Fewest fibers of neighboring lengths whose moments are matched on their own."""
CLASSES = 12
"""Most such classes in a layer."""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
"""Multiples of it, without their whole part, fill 0 ... 1 evenly: each layer gets all lengths."""


@dataclass(frozen=True)
class Stack:
    """Layers as asked for, from low to high."""

    edges: Floats
    """m, (K + 1,)"""
    share: Floats
    """of the fiber volume, sum 1, (K,)"""
    fraction: Floats
    """volume fractions, (K,)"""
    tensor: Floats
    """orientation tensors, (K, 3, 3)"""
    inside: bool
    """whether each fiber stays in its layer"""
    law: str = "acg"
    """distribution of directions"""
    mirror: float = 0.0
    """sign of the shear that fibers are to turn in freely; 0: any direction"""

    def __len__(self) -> int:
        return len(self.share)


@dataclass
class Drawn:
    """Straight fibers before packing."""

    direction: Floats
    """(n, 3)"""
    center: Floats
    """m, (n, 3)"""
    layer: Ints
    """that the center lies in, (n,)"""
    redrawn: int = 0
    """directions drawn again"""
    mirrored: int = 0
    """turned to the other side of the flow"""
    stuck: Ints | None = None
    """fibers for which no direction fits"""


def draw_fibers(stack: Stack, half: Floats, radius: float, cell: Cell, seed: int) -> Drawn:
    """Fibers of half centerlines (n,) m, rising, in a box; always the same for one seed."""
    tensor, share = stack.tensor.copy(), stack.share.copy()
    best: tuple[float, Drawn] | None = None
    for _ in range(CORRECTIONS):
        drawn = _drawn(stack, tensor, share, half, radius, cell, seed)
        if drawn.stuck is not None:
            return drawn if best is None else best[1]
        got, part = measured(stack, drawn, half)
        error = max(
            float(np.max(np.abs(got - stack.tensor))), float(np.max(np.abs(part - stack.share)))
        )
        if best is None or error < best[0]:
            best = error, drawn
        if error < CLOSE:
            break
        tensor = np.array(
            [_nearest(t + d) for t, d in zip(tensor, stack.tensor - got, strict=True)]
        )
        if not stack.inside:
            share = share * stack.share / np.maximum(part, 0.1 * stack.share)
            share /= share.sum()
    assert best is not None
    return best[1]


def measured(stack: Stack, drawn: Drawn, half: Floats) -> tuple[Floats, Floats]:
    """Tensors (K, 3, 3) as the mode counts them, and shares of the length (K,)."""
    arm = half[:, None] * drawn.direction
    cut = slices(drawn.center - arm, drawn.center + arm, stack.edges)
    tensor = votes(drawn.direction, drawn.layer, len(stack)) if stack.inside else cut.tensor
    return tensor, cut.length / cut.length.sum()


def _drawn(
    stack: Stack,
    tensor: Floats,
    share: Floats,
    half: Floats,
    radius: float,
    cell: Cell,
    seed: int,
) -> Drawn:
    assert cell.size is not None
    n = len(half)
    rng = np.random.default_rng(seed)
    place, offset = rng.random((n, 3)), rng.random()
    # By length: layers get equal parts of the long fibers, too.
    turn = (np.arange(n) * GOLDEN + offset) % 1.0
    layer = np.searchsorted(np.cumsum(share)[:-1], turn, side="right").astype(np.int64)
    direction = np.zeros((n, 3))
    for k in range(len(stack)):
        mine = np.flatnonzero(layer == k)
        own = np.random.default_rng([seed, k])
        direction[mine] = draw_directions(tensor[k], len(mine), own, stack.law)
        for rows in np.array_split(mine, min(CLASSES, max(1, len(mine) // CLASS))):
            direction[rows] = match_moments(direction[rows], tensor[k])
    redrawn = 0
    bad = _misfits(stack, direction, layer, half, radius, cell)
    for _ in range(ROUNDS):
        if not len(bad):
            break
        left = []
        for k in np.unique(layer[bad]):
            rows = np.repeat(bad[layer[bad] == k], CANDIDATES)
            fresh = draw_directions(tensor[k], len(rows), rng, stack.law)
            fits = np.ones(len(rows), dtype=bool)
            fits[_misfits(stack, fresh, layer[rows], half[rows], radius, cell)] = False
            found = np.argmax(fits.reshape(-1, CANDIDATES), axis=1)
            taken = CANDIDATES * np.arange(len(found)) + found
            direction[rows[taken]] = fresh[taken]
            redrawn += int(np.sum(found + 1))
            left.append(rows[taken[~fits[taken]]])
        bad = np.concatenate(left)
    if stack.inside:
        _turn_to(stack, direction, layer, half, radius, cell)
    mirrored = 0
    if stack.mirror != 0.0:
        gap = float(cell.size[2]) - 2.0 * wall_distance(radius)
        mirrored = mirror_wedged(direction, half, gap, stack.mirror)
    low, high = _range(stack, direction, layer, half, radius, cell)
    center = low + (high - low) * place
    stuck = bad if len(bad) else None
    return Drawn(direction, center, layer, redrawn, mirrored, stuck)


def _turn_to(
    stack: Stack, direction: Floats, layer: Ints, half: Floats, radius: float, cell: Cell
) -> None:
    """Turns the directions of each layer a little, where they fit, to its tensor by number."""
    for k in range(len(stack)):
        rows = np.flatnonzero(layer == k)
        for _ in range(TURNS):
            turned = match_moments(direction[rows], stack.tensor[k])
            fits = np.ones(len(rows), dtype=bool)
            fits[_misfits(stack, turned, layer[rows], half[rows], radius, cell)] = False
            direction[rows[fits]] = turned[fits]


def _range(
    stack: Stack, direction: Floats, layer: Ints, half: Floats, radius: float, cell: Cell
) -> tuple[Floats, Floats]:
    """Lowest and highest centers (n, 3), m, of fibers; low > high where one does not fit."""
    assert cell.size is not None
    reach = half[:, None] * np.abs(direction) + wall_distance(radius)
    low = np.where(cell.wall, reach, 0.0)
    high = np.where(cell.wall, cell.size - reach, cell.size)
    if len(stack) > 1 or cell.wall[2]:
        bottom, top = stack.edges[layer], stack.edges[layer + 1]
        own = reach[:, 2] if stack.inside else np.zeros(len(half))
        low[:, 2] = np.maximum(low[:, 2], bottom + own)
        high[:, 2] = np.minimum(high[:, 2], top - own)
    return low, high


def _misfits(
    stack: Stack, direction: Floats, layer: Ints, half: Floats, radius: float, cell: Cell
) -> NDArray[np.intp]:
    """Rows of fibers that fit nowhere in their layer with this direction."""
    low, high = _range(stack, direction, layer, half, radius, cell)
    return np.flatnonzero(np.any(low > high, axis=1))


def _nearest(tensor: Floats) -> Floats:
    """The tensor with its negative eigenvalues set to (almost) zero, trace 1."""
    eigen, axes = np.linalg.eigh(0.5 * (tensor + tensor.T))
    eigen = np.maximum(eigen, 1e-6)
    return np.asarray((axes * (eigen / eigen.sum())) @ axes.T)
