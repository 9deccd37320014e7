"""Scenes of straight fibers for the tests of the placement, and distances by another formula."""

from __future__ import annotations

from typing import Any

import numpy as np

from warpfiber.placement import Placement
from warpfiber.scene import Scene, scene_from_dict

DIAMETER = 1e-5
PERIODIC = ("periodic", "periodic", "periodic")


def made_scene(
    *groups: dict[str, Any],
    edge: float | tuple[float, float, float] | None = 5e-4,
    boundary: tuple[str, str, str] = PERIODIC,
    law: str = "exponential",
    segments: int | list[int] | None = 3,
    seed: int = 1,
) -> Scene:
    """A scene with these fiber groups; edge (m), None = no box."""
    common = {"diameter": DIAMETER, "density": 4e9, "youngs_modulus": 1e9}
    tables: dict[str, Any] = {
        "seed": seed,
        "flow": {"kind": "simple_shear", "shear_rate": 100.0, "viscosity": 100.0},
        "fibers": [{**common, **group} for group in groups],
        "contact": {"law": law},
        "stage": [{"kind": "flow", "end_strain": 1.0}],
        "numerics": {"method": "bead_chain"},
    }
    if segments is not None:
        tables["numerics"]["segments"] = segments
    if edge is not None:
        size = [edge] * 3 if isinstance(edge, float) else list(edge)
        tables["box"] = {"size": size, "boundary": list(boundary)}
    return scene_from_dict(tables)


def cube_edge(count: int, aspect_ratio: float, volume_fraction: float) -> float:
    """Edge of the cube (m) that `count` fibers fill to this volume fraction."""
    volume = count * 0.25 * np.pi * DIAMETER**3 * aspect_ratio
    return float((volume / volume_fraction) ** (1.0 / 3.0))


def ends(placed: Placement) -> tuple[np.ndarray, np.ndarray]:
    """First and last node of every fiber (m), checking that the nodes lie evenly between them."""
    start = placed.fiber_node_start
    first, last = placed.node_pos[start[:-1]], placed.node_pos[start[1:] - 1]
    for f in range(len(start) - 1):
        nodes = placed.node_pos[start[f] : start[f + 1]]
        even = first[f] + np.linspace(0.0, 1.0, len(nodes))[:, None] * (last[f] - first[f])
        np.testing.assert_allclose(nodes, even, atol=1e-12)
    return first, last


def point_distance(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of points x from segments a b."""
    t = np.sum((x - a) * (b - a), axis=-1) / np.sum((b - a) ** 2, axis=-1)
    return np.linalg.norm(x - a - np.clip(t, 0.0, 1.0)[..., None] * (b - a), axis=-1)


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance of segments a b and c d: four end distances, or the lines' own."""
    best = np.minimum(point_distance(a, c, d), point_distance(b, c, d))
    best = np.minimum(best, np.minimum(point_distance(c, a, b), point_distance(d, a, b)))
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    det = uu * vv - uv**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (uv * (v * w).sum(-1) - vv * (u * w).sum(-1)) / det
        t = (uu * (v * w).sum(-1) - uv * (u * w).sum(-1)) / det
    inside = (det > 1e-12 * uu * vv) & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    s, t = np.where(inside, s, 0.0), np.where(inside, t, 0.0)
    line = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    return np.where(inside, line, best)
