"""What lies in the layers of a box: every segment clipped by every slab and each of its images.

Source: a point x + t d of a segment, 0 <= t <= 1, lies between the planes z = b and z = c where t
    is between (b - x_z)/d_z and (c - x_z)/d_z; its length there is |d| times that range of t.
    By length: pieces weigh p p; by number: a fiber weighs its end-to-end vector once, in the layer
    of the mean of its nodes.
Limits: planes z = const; a level segment is given to the layer above its plane.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Array = np.ndarray


def layer_columns(
    fibers: Sequence[Array],
    height: float,
    count: int,
    periodic: bool,
    length: Sequence[float],
    volume: Sequence[float],
    floor_area: float,
) -> dict[str, Array]:
    """Columns (count,): tensors as (count, 3, 3) or (count, 3, 3, 3, 3); nan where nothing is.

    `length` tip to tip and `volume` of each fiber; `fibers` nodes (n, 3) each.
    """
    thick = height / count
    piece = np.zeros(count)
    filled = np.zeros(count)
    a2, a4 = np.zeros((count, 3, 3)), np.zeros((count, 3, 3, 3, 3))
    votes, sum1, sum2 = np.zeros(count), np.zeros(count), np.zeros(count)
    n2, n4 = np.zeros((count, 3, 3)), np.zeros((count, 3, 3, 3, 3))
    for nodes, long, space in zip(fibers, length, volume, strict=True):
        for first, last in zip(nodes[:-1], nodes[1:], strict=True):
            step = last - first
            size = float(np.linalg.norm(step))
            p = step / size
            for layer in range(count):
                part = 0.0
                images = range(-4, 5) if periodic else range(1)
                for image in images:
                    bottom = layer * thick + image * height
                    part += _inside(first[2], step[2], bottom, bottom + thick)
                piece[layer] += part * size
                filled[layer] += part * space / (len(nodes) - 1)
                a2[layer] += part * size * np.einsum("i,j", p, p)
                a4[layer] += part * size * np.einsum("i,j,k,l", p, p, p, p)
        axis = nodes[-1] - nodes[0]
        axis = axis / np.linalg.norm(axis)
        middle = float(nodes[:, 2].mean())
        home = int(np.floor((middle % height if periodic else middle) / thick))
        if 0 <= home < count:
            votes[home] += 1.0
            sum1[home] += long
            sum2[home] += long * long
            n2[home] += np.einsum("i,j", axis, axis)
            n4[home] += np.einsum("i,j,k,l", axis, axis, axis, axis)
    with np.errstate(invalid="ignore"):
        return {
            "length": piece,
            "volume_fraction": filled / (floor_area * thick),
            "fibers": votes,
            "number_average_length": sum1 / votes,
            "weight_average_length": sum2 / sum1,
            "tensor": a2 / piece[:, None, None],
            "tensor4": a4 / piece[:, None, None, None, None],
            "tensor_fiber": n2 / votes[:, None, None],
            "tensor4_fiber": n4 / votes[:, None, None, None, None],
        }


def _inside(z: float, rise: float, bottom: float, top: float) -> float:
    """Share of a segment from z to z + rise between two planes."""
    if rise == 0.0:
        return 1.0 if bottom <= z < top else 0.0
    ends = sorted(((bottom - z) / rise, (top - z) / rise))
    return max(0.0, min(1.0, ends[1]) - max(0.0, ends[0]))
