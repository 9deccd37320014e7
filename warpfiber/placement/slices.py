"""What lies in each layer of a cell: length and orientation of the pieces cut at its planes.

Pieces of straight segments are cut exactly, so a layer's tensor is an average over its fiber length
(that is, volume: what tomography sees). One vote per fiber counts those with the middle in a layer.

Symbols: L length tip to tip (m), L_N, L_W its number and weight average.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpfiber.placement.capsules import Floats, Ints
from warpfiber.placement.lengths import averages
from warpfiber.placement.orientations import orientation_tensor

FLAT_STEP = 1e-12
"""Rise of a segment relative to its length below which it counts as horizontal."""


@dataclass(frozen=True)
class Slices:
    """Content of K layers."""

    length: Floats
    """m of centerline, (K,)"""
    tensor: Floats
    """orientation tensor by length, (K, 3, 3)"""


def slices(first: Floats, last: Floats, edges: Floats) -> Slices:
    """Cuts segments from first to last (S, 3) m at planes z = edges (K + 1,) m, rising."""
    step = last - first
    length = np.sqrt(np.einsum("nk,nk->n", step, step))
    direction = step / np.maximum(length, 1e-300)[:, None]
    low = np.minimum(first[:, 2], last[:, 2])
    rise = np.maximum(np.abs(step[:, 2]), FLAT_STEP * length)
    total, tensor = [], []
    for bottom, top in zip(edges[:-1], edges[1:], strict=True):
        part = np.clip((top - low) / rise, 0.0, 1.0) - np.clip((bottom - low) / rise, 0.0, 1.0)
        piece = part * length
        total.append(piece.sum())
        tensor.append((direction * piece[:, None]).T @ direction / max(float(piece.sum()), 1e-300))
    return Slices(np.array(total), np.array(tensor))


def votes(direction: Floats, layer: Ints, count: int) -> Floats:
    """Orientation tensors (count, 3, 3) of the fibers of each layer, one vote per fiber."""
    return np.array([orientation_tensor(direction[layer == k]) for k in range(count)])


def layer_averages(length: Floats, layer: Ints, count: int) -> list[tuple[float, float]]:
    """L_N and L_W (m) of the fibers (n,) of each layer; 0 where it has none."""
    return [
        averages(length[layer == k]) if np.any(layer == k) else (0.0, 0.0) for k in range(count)
    ]


def largest_a33(length: Floats, diameter: float, gap: float) -> tuple[float, float]:
    """Most that a33 can be, by number and by length, of straight fibers (n,) m between two planes.

    A fiber of length L tip to tip fits a gap h if |p_z| <= (h - d)/(L - d); 0 without fibers.
    """
    if not len(length):
        return 0.0, 0.0
    steepest = np.clip((gap - diameter) / np.maximum(length - diameter, 1e-300), 0.0, 1.0) ** 2
    return float(steepest.mean()), float(length @ steepest / length.sum())
