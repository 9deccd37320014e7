"""Whether two moving line segments passed through each other, by the solid angle they span.

Source: Klenin & Langowski 2000, Eq. (15): the Gauss integral of two segments is a sum of four arc
    sines with the sign of their volume; it jumps by 4 pi where one passes through the other and is
    continuous elsewhere.
Limits: brute force in time; grazing of ends within one of the time steps is not told apart.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def solid_angle(p1: Array, p2: Array, p3: Array, p4: Array) -> Array:
    """Omega of the segments p1 p2 and p3 p4, for arrays of points (..., 3)."""
    r13, r14, r23, r24 = p3 - p1, p4 - p1, p3 - p2, p4 - p2
    normals = [np.cross(r13, r14), np.cross(r14, r24), np.cross(r24, r23), np.cross(r23, r13)]
    units = [n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-300) for n in normals]
    total = 0.0
    for k in range(4):
        cosine = (units[k] * units[(k + 1) % 4]).sum(axis=-1)
        total = total + np.arcsin(np.clip(cosine, -1.0, 1.0))
    return total * np.sign((np.cross(p4 - p3, p2 - p1) * r13).sum(axis=-1))


def crossings(before: Array, after: Array, steps: int = 4000) -> int:
    """Times that the segments p1 p2 and p3 p4 met; `before`, `after` (4, 3), moved linearly."""
    tau = np.linspace(0.0, 1.0, steps + 1)[:, None]
    points = [(1.0 - tau) * before[k] + tau * after[k] for k in range(4)]
    angle = solid_angle(*points)
    return int((np.abs(np.diff(angle)) > 2.0 * np.pi).sum())
