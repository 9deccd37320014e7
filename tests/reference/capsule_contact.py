"""Contact of sphero-cylinders in float64 NumPy: all pairs, curvature tensors, quadrature, memories.

Source: elliptic Hertz contacts from the sum of two curvature tensors; along a line where fibers are
    within 30 degrees of each other and the patch is longer than half a segment; the vertex rule;
    in the hollow of a kink minima less saddles plus maxima; Mindlin and Coulomb. Written with
    eigenvalues and numerical integrals, where the kernels have closed forms.
Symbols: x, v, w nodes of both fibers; s, t parts of the two segments; n from the first to the
    second; a memory is (displacement, overlap a step ago), and goes over to the next segment with
    the contact.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np

from tests.reference.bonded_spheres import Array, Rod
from tests.reference.segments import closest_points

NEAR = 1e-9
Memory = tuple[Array, float]
Memories = dict[tuple[int, int], Memory]


@dataclass
class Laws:
    """Numbers of the contact."""

    modulus: float = 7.5e5
    poisson: float = 0.5
    damping: float = 0.0
    friction: float = 0.0
    clamp: bool = True  # contacts never pull
    memories: Memories = field(default_factory=dict)

    @property
    def effective(self) -> float:
        """E* of two equal materials."""
        return 0.5 * self.modulus / (1.0 - self.poisson**2)

    @property
    def shear_ratio(self) -> float:
        """k_t / k_n = 8 G* / (2 E*)."""
        shear = 0.5 * self.modulus / (1.0 + self.poisson)
        return 4.0 * shear / (2.0 * (2.0 - self.poisson)) / self.effective


def hertz(laws: Laws, tensors: list[Array], depth: float) -> tuple[float, float]:
    """Force and stiffness of surfaces with these curvature tensors (2, 2) in one plane."""
    small, large = np.linalg.eigvalsh(np.sum(tensors, axis=0))
    correction = 1.0 - ((large / small) ** 0.0684 - 1.0) ** 1.531
    root = (small * large) ** -0.25
    force = 4.0 / 3.0 * laws.effective * root * depth**1.5 * correction**-1.5
    return force, 1.5 * force / depth


def per_angle(tensors: list[Array], angle: float) -> float:
    """Logarithmic derivative of a contact's energy by the angle between two crossing cylinders."""
    small, large = np.linalg.eigvalsh(np.sum(tensors, axis=0))
    by_product = -0.25
    if large > small:
        power = (large / small) ** 0.0684
        correction = 1.0 - (power - 1.0) ** 1.531
        by_ratio = 1.5 / correction * 1.531 * (power - 1.0) ** 0.531 * 0.0684 * power
        by_product -= by_ratio * (large + small) / (large - small)
    return float(by_product * 2.0 / math.tan(angle))


def curvature(radius: float, angle: float | None) -> Array:
    """Of a cylinder whose axis has this angle in the plane; None: of a sphere."""
    if angle is None:
        return np.eye(2) / radius
    across = np.array([-math.sin(angle), math.cos(angle)])
    return np.outer(across, across) / radius


@dataclass
class Touch:
    """What one pair of segments does: spring force, stiffness, and where.

    springs: (force, s, t) of all extrema that count; along a line there is none but the sum.
    """

    force: float
    stiffness: float
    s: float
    t: float
    depth: float = 0.0
    springs: list[tuple[float, float, float]] = field(default_factory=list)
    energy: float = 0.0
    twist: float = 0.0  # derivative of the energy by the angle from the first to the second


def line_touch(laws: Laws, delta: Array, a: Array, b: Array, ra: float, rb: float) -> Touch | None:
    """Contact along a line; None where the pair of segments is to be taken as a point."""
    la, lb = np.linalg.norm(a), np.linalg.norm(b)
    cosine = abs(a @ b) / (la * lb)
    if cosine <= math.cos(math.radians(30.0)):
        return None
    sine = max(float(np.linalg.norm(np.cross(a, b)) / (la * lb)), 0.02)
    middle = a / la + math.copysign(1.0, a @ b) * b / lb
    middle /= np.linalg.norm(middle)

    def gap(z: float | Array) -> Array:
        """From a to b at the coordinate z along the mean direction."""
        s = np.asarray(z) / (a @ middle)
        t = (np.asarray(z) - delta @ middle) / (b @ middle)
        return delta + np.multiply.outer(t, b) - np.multiply.outer(s, a)

    zero, slope = gap(0.0), gap(1.0) - gap(0.0)
    steep = slope @ slope
    square = zero @ zero - (zero @ slope) ** 2 / steep if steep > 0.0 else zero @ zero
    reach, least = ra + rb, math.sqrt(max(square, 0.0))
    depth = reach - least
    if depth < 0.0 or 2.0 * reach * depth < (0.25 * min(la, lb) * sine) ** 2:
        return None
    ends = sorted([delta @ middle, (delta + b) @ middle])
    low, high = max(0.0, ends[0]), min(float(a @ middle), ends[1])
    if low >= high:
        return Touch(0.0, 0.0, 0.0, 0.0)
    nodes, weights = np.polynomial.legendre.leggauss(3)  # exact for what is integrated
    if steep > 0.0:
        center = -(zero @ slope) / steep
        half = math.sqrt(max(reach**2 - square, 0.0) / steep)
        low, high = max(low, center - half), min(high, center + half)
        if low >= high:
            return Touch(0.0, 0.0, 0.0, 0.0)
    z = 0.5 * (low + high) + 0.5 * (high - low) * nodes
    overlap = (reach**2 - (gap(z) ** 2).sum(1)) / (reach + least)
    weights = 0.5 * (high - low) * weights
    integral = float(weights @ overlap)
    # a whole patch of length 2 sqrt(2 reach delta) / sine has the force of Hertz
    whole = 4.0 / 3.0 * math.sqrt(2.0 * reach) * depth**1.5 / sine
    angle = math.asin(min(1.0, sine))
    per_integral = hertz(laws, [curvature(ra, 0.0), curvature(rb, angle)], depth)[0] / whole
    place = float(weights @ (overlap * z)) / integral
    t = (place - delta @ middle) / (b @ middle)
    # deepest along both, and a mean length of them further on each side
    further = 0.5 * float(a @ middle + abs(b @ middle))
    first, last = min(0.0, ends[0]) - further, max(float(a @ middle), ends[1]) + further
    nearest = gap(min(max(-float(zero @ slope) / max(float(steep), 1e-30), first), last))
    return Touch(
        per_integral * integral,
        per_integral * (high - low),
        place / float(a @ middle),
        min(max(t, 0.0), 1.0),
        reach - float(np.linalg.norm(nearest)),
    )


def descends(x: Array, vertex: int, towards: int, away: Array) -> bool:
    """Whether a fiber comes nearer along its edge from a node; away: from the node to the other."""
    edge = x[towards] - x[vertex]
    return bool(away @ edge > NEAR * (edge @ edge))


def extrema(
    x: Array, i: int, j: int, first: tuple[int, int], last: tuple[int, int]
) -> list[tuple[float, float, float]]:
    """(weight, part of i, part of j): halves of saddles and quarters of maxima of two segments."""
    found = []
    for side, (segment, other) in enumerate(((i, j), (j, i))):
        for k in (0, 1):
            vertex, inner, beyond = segment + k, segment + 1 - k, segment + 3 * k - 1
            if vertex in (first[side], last[side] + 1):
                continue
            _, there = closest_points(x[vertex], x[vertex], x[other], x[other + 1])
            away = x[other] + there * (x[other + 1] - x[other]) - x[vertex]
            if not (descends(x, vertex, inner, away) and descends(x, vertex, beyond, away)):
                continue
            if there >= 1.0 - NEAR and other < last[1 - side]:
                continue
            if there <= NEAR and other > first[1 - side] and descends(x, other, other - 1, -away):
                continue
            found.append((-0.5, float(k), there) if side == 0 else (-0.5, there, float(k)))
    for k, m in itertools.product((0, 1), (0, 1)):
        ends = (i + k, j + m)
        if any(end in (low, high + 1) for end, low, high in zip(ends, first, last, strict=True)):
            continue
        gap = x[ends[1]] - x[ends[0]]
        near = [descends(x, ends[0], n, gap) for n in (i + 1 - k, i + 3 * k - 1)]
        near += [descends(x, ends[1], n, -gap) for n in (j + 1 - m, j + 3 * m - 1)]
        if all(near):
            found.append((0.25, float(k), float(m)))
    return found


def touch(laws: Laws, x: Array, i: int, j: int, rods: tuple[Rod, Rod]) -> Touch | None:
    """What segments i and j (first nodes in x) of the fibers do; x: nodes of both, one by one."""
    count = len(rods[0].rest)
    first = (0, count)
    last = (count - 2, count + len(rods[1].rest) - 2)
    a, b, delta = x[i + 1] - x[i], x[j + 1] - x[j], x[j] - x[i]
    ra, rb = rods[0].radius, rods[1].radius
    s, t = closest_points(x[i], x[i + 1], x[j], x[j + 1])
    c = delta + t * b - s * a
    depth = ra + rb - float(np.linalg.norm(c))
    if depth <= 0.0:
        return None
    line = line_touch(laws, delta, a, b, ra, rb)
    end_a = (s <= NEAR and i == first[0]) or (s >= 1.0 - NEAR and i == last[0])
    end_b = (t <= NEAR and j == first[1]) or (t >= 1.0 - NEAR and j == last[1])
    if line is not None and not (end_a or end_b):
        return line if line.force > 0.0 else None
    reported = not (s >= 1.0 - NEAR and i < last[0]) and not (t >= 1.0 - NEAR and j < last[1])
    if s <= NEAR and i > first[0]:
        reported &= bool(c @ (x[i] - x[i - 1]) >= 0.0)
    if t <= NEAR and j > first[1]:
        reported &= bool(c @ (x[j] - x[j - 1]) <= 0.0)
    if line is not None and not reported:
        return line if line.force > 0.0 else None
    sine = np.linalg.norm(np.cross(a, b)) / np.linalg.norm(a) / np.linalg.norm(b)
    angle = math.asin(min(1.0, max(float(sine), 0.02)))
    tensors = [curvature(ra, None if end_a else 0.0), curvature(rb, None if end_b else angle)]
    if line is not None and line.force >= hertz(laws, tensors, depth)[0]:
        return line
    points = [(1.0, s, t)] if reported else []
    points += extrema(x, i, j, first, last) if line is None else []
    whole = Touch(0.0, 0.0, s, t, depth)
    for weight, on_a, on_b in points:
        deep = ra + rb - float(np.linalg.norm(delta + on_b * b - on_a * a))
        if deep > 0.0:
            push, slope = hertz(laws, tensors, deep)
            whole.force, whole.stiffness = (
                whole.force + weight * push,
                whole.stiffness + weight * slope,
            )
            whole.energy += 0.4 * weight * push * deep
            whole.springs.append((weight * push, on_a, on_b))
    if sine > 0.02 and not (end_a or end_b):
        whole.twist = whole.energy * per_angle(tensors, math.copysign(angle, float(a @ b)))
    if not reported:
        whole.force = whole.stiffness = 0.0
    return whole if whole.springs else None


def memory(laws: Laws, before: Memories, i: int, j: int, found: Touch, x: Array) -> Memory:
    """This pair's of a step ago, or the nearest of those that the contact can have come from."""
    if (i, j) in before:
        return before[(i, j)]
    on_i, on_j = (k + (1 if part >= 0.5 else -1) for k, part in ((i, found.s), (j, found.t)))
    far = [
        min(part, 1.0 - part) * np.linalg.norm(x[k + 1] - x[k])
        for k, part in ((i, found.s), (j, found.t))
    ]
    beside = [(on_i, j), (i, on_j)]
    for key in [*(beside if far[0] <= far[1] else beside[::-1]), (on_i, on_j)]:
        if key in before:
            return before[key]
    return np.zeros(3), 0.0


def contact_loads(
    laws: Laws, rods: tuple[Rod, Rod], x: Array, v: Array, w: Array, dt: float
) -> tuple[Array, Array]:
    """Forces and moments on all nodes of two fibers; memories move on by dt."""
    forces, moments = np.zeros_like(x), np.zeros_like(x)
    count = len(rods[0].rest)
    mass = np.concatenate([rods[0].mass, rods[1].mass])
    earlier, laws.memories = laws.memories, {}
    for i, j in itertools.product(range(count - 1), range(count, len(x) - 1)):
        found = touch(laws, x, i, j, rods)
        if found is None:
            continue
        weights = (np.array([1.0 - found.s, found.s]), np.array([1.0 - found.t, found.t]))
        nodes = (np.array([i, i + 1]), np.array([j, j + 1]))
        c = weights[1] @ x[nodes[1]] - weights[0] @ x[nodes[0]]
        distance = float(np.linalg.norm(c))
        n = c / distance
        arms = 0.5 * (distance + rods[0].radius - rods[1].radius)
        levers = (arms * n, -(distance - arms) * n)
        speeds, spins, softness = [], [], 0.0
        for side in (0, 1):
            spin = weights[side] @ w[nodes[side]]
            speeds.append(weights[side] @ v[nodes[side]] + np.cross(spin, levers[side]))
            spins.append(spin)
            softness += float((weights[side] ** 2 / mass[nodes[side]]).sum())
        slip = speeds[0] - speeds[1]
        damper = 2.0 * math.sqrt(5.0 / 6.0) * laws.damping
        resistance = damper * math.sqrt(found.stiffness / softness)
        size = found.force + resistance * float(slip @ n)
        size = max(size, 0.0) if laws.clamp else size
        force = -size * n
        for push, on_i, on_j in found.springs:
            parts = (np.array([1.0 - on_i, on_i]), np.array([1.0 - on_j, on_j]))
            gap = parts[1] @ x[nodes[1]] - parts[0] @ x[nodes[0]]
            spring = push / np.linalg.norm(gap) * gap
            for side, sign in ((0, -1.0), (1, 1.0)):
                np.add.at(forces, nodes[side], sign * np.outer(parts[side], spring))
                if found.force > 0.0:
                    np.add.at(forces, nodes[side], -sign * np.outer(weights[side], push * n))
        if found.twist != 0.0:
            edges = [x[nodes[side][1]] - x[nodes[side][0]] for side in (0, 1)]
            axis = np.cross(*edges)
            axis *= found.twist / np.linalg.norm(axis)
            for side, sign in ((0, 1.0), (1, -1.0)):
                edge = edges[side]
                pull = sign * np.cross(axis, edge) / (edge @ edge)
                np.add.at(forces, nodes[side], np.array([-pull, pull]))
        if found.force <= 0.0:
            continue
        if laws.friction > 0.0:
            stiffness = laws.shear_ratio * found.stiffness
            h, old = memory(laws, earlier, i, j, found, x)
            if old > 0.0:
                length = np.linalg.norm(h)
                h = h - (h @ n) * n
                h = h + 0.5 * dt * float((spins[0] + spins[1]) @ n) * np.cross(n, h)
                h = h * (length / max(float(np.linalg.norm(h)), 1e-30))
                h = h * min(1.0, math.sqrt(old / found.depth))
            slide = slip - (slip @ n) * n
            h = h + dt * slide
            drag = -stiffness * h - damper * math.sqrt(stiffness / softness) * slide
            most = laws.friction * size
            if np.linalg.norm(drag) > most:
                drag = drag * (most / np.linalg.norm(drag))
                h = -drag / stiffness
            laws.memories[(i, j)] = (h, found.depth)
            force = force + drag
        for side, sign in ((0, 1.0), (1, -1.0)):
            couple = np.cross(levers[side], sign * force)
            np.add.at(forces, nodes[side], sign * np.outer(weights[side], force))
            np.add.at(moments, nodes[side], np.outer(weights[side], couple))
    return forces, moments


def stored_energy(laws: Laws, rods: tuple[Rod, Rod], x: Array) -> float:
    """Energy of the springs of all points where two fibers touch, J."""
    count = len(rods[0].rest)
    pairs = itertools.product(range(count - 1), range(count, len(x) - 1))
    touches = (touch(laws, x, i, j, rods) for i, j in pairs)
    return math.fsum(found.energy for found in touches if found is not None)
