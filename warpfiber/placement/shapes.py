"""Stress-free shapes of fibers: nodes on the centerline, all segments equally long.

`straight`; `ring`, closed from the last node to the first; `s`, two arcs of half the length that
curve opposite ways; `bent`, a middle and two equal tips with sharp corners; `u` and `z`, bent at
right angles with tips of a quarter of the length; `points`, the nodes of a file.

Source: Xu, Ma & Guo, Materials 16 (2023) 2712, Figures 5 and 18 (S, U and Z fibers, maximum Feret
    diameter). The angle of a U is taken as the dihedral angle of its tips: 0 flat, 180 a Z.
Symbols: L_c length of the centerline (m), n segments, l = L_c / n, kappa curvature (1/m).
    S: chord (2 / kappa) sin(kappa l / 2); Feret diameter (4 / kappa) sin(kappa L_c / 4).
Limits: corners lie on nodes. A ring of n segments has n nodes, any other shape n + 1.
"""

from __future__ import annotations

import math

import numpy as np

from warpfiber.placement.capsules import Floats, axis_distance
from warpfiber.placement.node_file import LENGTH_SPREAD, read_node_file
from warpfiber.scene import Shape
from warpfiber.scene.derived import SHORTEST_BOND

ON_NODE = 1e-6
"""Distance of a corner from a node in segments that is rounding."""
SHORTEST = 0.95 * SHORTEST_BOND
"""Shortest chord of a segment in diameters: arcs that curve by 1 / d have shorter ones."""


def straight_nodes(
    center: Floats, direction: Floats, centerline_length: float, segments: int
) -> Floats:
    """Equally spaced nodes (n, segments + 1, 3) m; center (n, 3) m, direction (n, 3)."""
    along = (np.arange(segments + 1) / segments - 0.5) * centerline_length
    return np.asarray(center[:, None, :] + along[None, :, None] * direction[:, None, :])


def rest_nodes(shape: Shape, length: float, segments: int, diameter: float) -> Floats:
    """Nodes (m) about their mean, from end to end along x; length L_c and diameter in m.

    ValueError says what is wrong: corners off the nodes, segments too short, self-overlap.
    """
    step = length / segments
    if shape.kind == "points":
        nodes = _from_file(shape, length, segments, diameter)
    elif shape.kind == "ring":
        turn = 2.0 * math.pi * np.arange(segments) / segments
        radius = length / (2.0 * math.pi)
        nodes = radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(segments)], axis=1)
    else:
        nodes = np.concatenate([np.zeros((1, 3)), np.cumsum(_chords(shape, step, segments), 0)])
    closed = shape.kind == "ring"
    chord = float(np.min(np.linalg.norm(_edges(nodes, closed), axis=1)))
    if chord < SHORTEST * diameter:
        raise ValueError(
            f"segments are {chord:.4g} m long, shorter than half the diameter; use fewer"
        )
    _refuse_self_overlap(nodes, closed, step, diameter)
    return nodes if closed else _along_x(nodes)


def feret_diameter(nodes: Floats) -> float:
    """Largest distance of two nodes (m) of one fiber (n, 3) m."""
    gap = nodes[:, None, :] - nodes[None, :, :]
    return float(np.sqrt(np.max(np.einsum("ijk,ijk->ij", gap, gap))))


def _chords(shape: Shape, step: float, segments: int) -> Floats:
    """Segments (n, 3) m of shapes that are drawn from one end."""
    middle = (np.arange(segments) + 0.5) * step
    if shape.kind == "straight":
        return np.tile([step, 0.0, 0.0], (segments, 1))
    if shape.kind == "s":
        curvature = abs(shape.curvature or 0.0)
        turn = curvature * np.minimum(middle, segments * step - middle)
        chord = 2.0 / curvature * math.sin(0.5 * curvature * step)
        return np.stack([np.cos(turn), np.sin(turn), np.zeros(segments)], axis=1) * chord
    corner1, corner2, dihedral = 90.0, 90.0, 180.0
    total = segments * step
    tip = 0.25 * total
    if shape.kind == "u":
        dihedral = shape.angle or 0.0
    elif shape.kind == "bent":
        assert None not in (shape.middle, shape.tip)
        tip = float(shape.tip or 0.0)
        corner1, corner2 = float(shape.corner1 or 0.0), float(shape.corner2 or 0.0)
        dihedral = float(shape.dihedral or 0.0)
        asked = float(shape.middle or 0.0) + 2.0 * tip
        if abs(asked - total) > LENGTH_SPREAD * total:
            raise ValueError(f"middle + 2 tip is {asked:.6g} m, the centerline {total:.6g} m long")
        tip *= total / asked
    if not _on_node(tip / total, segments):
        raise ValueError(
            f"its corners lie {tip / step:.4g} segments from the ends, not on nodes; "
            f"change segments{_nearest(tip / total, segments)}"
        )
    return _bent(round(tip / step), segments, corner1, corner2, dihedral) * step


def _on_node(part: float, segments: int) -> bool:
    """Whether this part of the centerline is a whole number of segments, one at least."""
    count = part * segments
    return abs(count - round(count)) <= ON_NODE * segments and round(count) >= 1


def _nearest(part: float, segments: int) -> str:
    """The next smaller and larger numbers of segments with a node at this part, as a remedy."""
    below = next((n for n in range(segments - 1, 1, -1) if _on_node(part, n)), None)
    above = next((n for n in range(segments + 1, 2 * segments + 5) if _on_node(part, n)), None)
    named = " or ".join(str(n) for n in (below, above) if n is not None)
    return f" to {named}" if named else ""


def _bent(tip: int, segments: int, corner1: float, corner2: float, dihedral: float) -> Floats:
    """Unit segments: tip, middle along x, tip; interior corners and dihedral angle in degrees."""
    one, two, twist = math.radians(corner1), math.radians(corner2), math.radians(dihedral)
    first = np.array([-math.cos(one), -math.sin(one), 0.0])
    side = np.array([0.0, math.cos(twist), math.sin(twist)])
    last = np.array([-math.cos(two), 0.0, 0.0]) + math.sin(two) * side
    made = np.tile([1.0, 0.0, 0.0], (segments, 1))
    made[:tip], made[segments - tip :] = first, last
    return made


def _from_file(shape: Shape, length: float, segments: int, diameter: float) -> Floats:
    """The one fiber of a node file; ValueError if it has another size."""
    fibers = read_node_file(shape.file or "", diameter)
    if len(fibers) != 1:
        raise ValueError(f"it holds {len(fibers)} fibers; give one")
    nodes = fibers[0]
    if len(nodes) != segments + 1:
        raise ValueError(f"it has {len(nodes) - 1} segments, numerics asks for {segments}")
    found = float(np.sum(np.linalg.norm(np.diff(nodes, axis=0), axis=1)))
    if abs(found - length) > LENGTH_SPREAD * length:
        raise ValueError(f"it is {found:.6g} m long, not {length:.6g} m; make them agree")
    return nodes


def _along_x(nodes: Floats) -> Floats:
    """The same turned such that the way from end to end points along x, about the mean."""
    nodes = nodes - nodes.mean(axis=0)
    _, _, axes = np.linalg.svd(nodes)
    across = nodes[-1] - nodes[0]
    long = float(np.linalg.norm(across))
    along = across / long if long > 1e-9 * feret_diameter(nodes) else axes[0]
    side = axes[1] - (axes[1] @ along) * along
    if np.linalg.norm(side) < 0.1:
        side = axes[0] - (axes[0] @ along) * along
    side /= np.linalg.norm(side)
    return np.asarray(nodes @ np.stack([along, side, np.cross(along, side)], axis=1))


def _edges(nodes: Floats, closed: bool) -> Floats:
    return np.roll(nodes, -1, axis=0) - nodes if closed else np.diff(nodes, axis=0)


def segments_of(nodes: Floats, closed: bool) -> tuple[Floats, Floats, Floats]:
    """Centers (n, 3) m, directions (n, 3) and half lengths (n,) m of the segments of one fiber."""
    edge = _edges(nodes, closed)
    length = np.linalg.norm(edge, axis=1)
    first = nodes if closed else nodes[:-1]
    return first + 0.5 * edge, edge / length[:, None], 0.5 * length


def _refuse_self_overlap(nodes: Floats, closed: bool, step: float, diameter: float) -> None:
    """ValueError if segments overlap that are more than half a circle of diameter d apart."""
    center, direction, half = segments_of(nodes, closed)
    n = len(half)
    i, j = np.triu_indices(n, 1)
    apart = np.minimum(j - i, n - (j - i)) if closed else j - i
    far = (apart - 1) * step >= 0.5 * math.pi * diameter
    i, j = i[far], j[far]
    offset = center[i] - center[j]
    _, _, gap = axis_distance(offset, direction[i], half[i], direction[j], half[j])
    distance = np.linalg.norm(gap, axis=1)
    if len(distance) and float(distance.min()) < diameter:
        k = int(np.argmin(distance))
        raise ValueError(
            f"segments {i[k]} and {j[k]} overlap ({distance[k]:.4g} m apart, diameter "
            f"{diameter:.4g} m); bend it less, or make it thinner"
        )
