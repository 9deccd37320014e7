"""Contact of sphero-cylinders in float64 NumPy: all pairs, quadrature, complex steps, memories.

Source: energy of elliptic Hertz contacts in slices across the mean directions of two segments, or
    across a segment beside the tip of the other; forces are derivatives by complex steps, where the
    kernels have gradients in closed form, and no contact is taken at a point but that of two tips;
    Mindlin and Coulomb.
Symbols: x, v, w nodes of both fibers; s, t parts of the two segments; n from the first to the
    second; a memory is (displacement, overlap a step ago), and goes over to the next segment with
    the contact.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.reference.bonded_spheres import Array, Rod
from tests.reference.segments import closest_points

STEP = 2.4e-3  # m, of segments
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


def product(a: Array, b: Array) -> Any:
    """Scalar product without conjugation."""
    return (a * b).sum(-1)


def size(a: Array) -> Any:
    """Length, analytic in complex numbers."""
    return np.sqrt(product(a, a))


def pick(a: Any, b: Any, largest: bool) -> Any:
    """The larger or the smaller one by its real part; their mean where rounding would decide."""
    if abs(a.real - b.real) < 1e-9 * STEP:
        return 0.5 * (a + b)
    return a if (a.real >= b.real) == largest else b


def rounding(small: Any, large: Any) -> Any:
    """sqrt(R*) F_2^-1.5 of the two principal relative curvatures."""
    correction = 1.0 - ((large / small) ** 0.0684 - 1.0) ** 1.531
    return (small * large) ** -0.25 * correction**-1.5


def cylinder_rounding(ra: float, rb: float, sine: Any) -> Any:
    """Of two cylinders, from the eigenvalues of the sum of their curvature tensors."""
    middle, both = 0.5 * (1.0 / ra + 1.0 / rb), sine * sine / (ra * rb)
    square = middle * middle - both
    large = middle + (np.sqrt(square) if square.real > 0.0 else 0.0)
    return rounding(both / large, large)


@dataclass
class Touch:
    """What one pair of segments does, and where."""

    energy: Any
    stiffness: float = 0.0
    damped: float = 0.0
    s: float = 0.0
    t: float = 0.0
    depth: float = 0.0
    pulls: Array = field(default_factory=lambda: np.zeros((4, 3)))  # on its nodes
    force: float = 0.0

    def plus(self, other: Touch) -> Touch:
        """Both ways of slicing together."""
        energy = self.energy + other.energy
        if energy.real <= 0.0:
            return self
        part = other.energy.real / energy.real
        return Touch(
            energy,
            self.stiffness + other.stiffness,
            self.damped + other.damped,
            (1.0 - part) * self.s + part * other.s,
            (1.0 - part) * self.t + part * other.t,
            max(self.depth, other.depth),
        )


def sliced(
    first: Array, slope: Array, low: Any, high: Any, beyond: Any, reach: float, rigidity: Any
) -> tuple[Any, float, float, float, float, float]:
    """Energy, stiffness, center, length, whole length and depth of slices first + z slope.

    beyond: between which z the deepest one counts; rigidity: E* sqrt(R*) F_2^-1.5 times the way
    across per z.
    """
    nothing = (0.0 * low, 0.0, 0.0, 0.0, 1.0, 0.0)
    if high.real - low.real <= 1e-9 * STEP:
        return nothing
    steep = product(slope, slope)
    middle = -product(first, slope) / steep if steep.real > 1e-18 else 0.5 * (low + high)
    z = pick(pick(middle, beyond[0], True), beyond[1], False)
    least = size(first + z * slope)
    if least.real >= reach:
        return nothing
    offset = product(first + z * slope, slope)
    wide = np.sqrt(offset**2 + steep * (reach**2 - least**2)).real
    span = (reach**2 - least**2).real
    down = span / (wide - offset.real) if wide > offset.real else math.inf
    up = span / (wide + offset.real) if wide > -offset.real else math.inf
    low = low if z.real - down < low.real else z.real - down + 0.0 * low
    high = high if z.real + up > high.real else z.real + up + 0.0 * high
    if high.real - low.real <= 1e-9 * STEP:
        return nothing
    nodes, weights = np.polynomial.legendre.leggauss(3)  # exact for what is integrated
    at = 0.5 * (low + high) + 0.5 * (high - low) * nodes
    gaps = first + at[:, None] * slope
    overlap = reach**2 - product(gaps, gaps)
    weights = 0.5 * (high - low) * weights
    energy = 0.5 * rigidity * (reach + least) ** -2.5 * (weights * overlap**2).sum()
    length = (high - low).real
    stiffness = (rigidity * (reach + least) ** -0.5).real * length
    center = ((weights * overlap * at).sum() / (weights * overlap).sum()).real
    return energy, stiffness, center, length, down + up, float(reach - least.real)


def sides(laws: Laws, x: Array, ra: float, rb: float, sign: float) -> Touch:
    """Slices across the mean direction of the first segment and `sign` times the second."""
    a, b = x[1] - x[0], x[3] - x[2]
    u, w = a / size(a), sign * b / size(b)
    cosine = product(u, w)
    weight = 0.5 + cosine if abs(cosine.real) < 0.5 else 0.5 + 0.5 * np.sign(cosine.real)
    if weight.real <= 0.0:
        return Touch(0.0 * cosine)
    middle = (u + w) / size(u + w)
    sine = size(np.cross(u, w))
    sine = sine if sine.real > 0.02 else 0.02 + 0.0 * sine
    end, start, stop = (product(p - x[0], middle) for p in x[1:])

    def gap(z: Any) -> Array:
        """From the first axis to the second one in a slice."""
        on_b: Array = x[2] + (z - start) / (stop - start) * b
        return on_b - (x[0] + z / end * a)

    nothing = 0.0 * end
    bounds = pick(start, stop, False), pick(start, stop, True)
    low, high = pick(nothing, bounds[0], True), pick(end, bounds[1], False)
    zero = gap(nothing)
    slope = gap(nothing + 1.0) - zero
    stiff = cylinder_rounding(ra, rb, sine) * sine
    rigidity = weight * laws.effective * (stiff if sine.real > 0.03 else stiff.real)
    # deepest along both, and a quarter of their mean length further on each side
    further = 0.125 * (end + pick(stop - start, start - stop, True))
    beyond = (
        pick(nothing, bounds[0], False) - further,
        pick(end, bounds[1], True) + further,
    )
    energy, stiffness, center, length, whole, depth = sliced(
        zero, slope, low, high, beyond, ra + rb, rigidity * 2.0 / (1.0 + cosine)
    )
    return Touch(
        energy,
        stiffness,
        stiffness * length / min(whole, 4.0 * further.real),
        center / end.real,
        ((center - start) / (stop - start)).real,
        depth,
    )


def both_sides(laws: Laws, x: Array, ra: float, rb: float) -> Touch:
    """Slices across both mean directions."""
    return sides(laws, x, ra, rb, 1.0).plus(sides(laws, x, ra, rb, -1.0))


def tip_on_side(laws: Laws, x: Array, ra: float, rb: float, end: int) -> Touch:
    """The tip x[end] of the first segment on the second one."""
    b = x[3] - x[2]
    length = size(b)
    round_tip = rounding(1.0 / ra, 1.0 / ra + 1.0 / rb)
    first = x[2] - x[end]
    zero = 0.0 * length
    energy, stiffness, center, covered, whole, depth = sliced(
        first, b / length, zero, length, (zero, length), ra + rb, laws.effective * round_tip + zero
    )
    return Touch(
        energy,
        stiffness,
        stiffness * covered / min(whole, length.real),
        float(end),
        center / length.real,
        depth,
    )


def turned(found: Touch) -> Touch:
    """The same seen from the other segment."""
    found.s, found.t = found.t, found.s
    return found


def two_tips(laws: Laws, x: Array, ra: float, rb: float, end: int, other: int) -> Touch:
    """Spheres at the tips x[end] and x[2 + other]."""
    depth = ra + rb - size(x[2 + other] - x[end])
    if depth.real <= 0.0:
        return Touch(0.0 * depth)
    curved = 1.0 / ra + 1.0 / rb
    stiffness = 2.0 * laws.effective * rounding(curved, curved) * np.sqrt(depth)
    force = stiffness.real
    energy = 4.0 / 15.0 * stiffness * depth**2
    return Touch(energy, force, force, float(end), float(other), depth.real)


def touch(laws: Laws, x: Array, i: int, j: int, rods: tuple[Rod, Rod]) -> Touch | None:
    """What segments i and j (first nodes in x) of the fibers do; x: nodes of both, one by one."""
    count = len(rods[0].rest)
    nodes = x[[i, i + 1, j, j + 1]].astype(complex)
    s, t = closest_points(x[i], x[i + 1], x[j], x[j + 1])
    ra, rb = rods[0].radius, rods[1].radius
    if np.linalg.norm(x[j] + t * (x[j + 1] - x[j]) - x[i] - s * (x[i + 1] - x[i])) >= ra + rb:
        return None
    end, other = int(s >= 0.5), int(t >= 0.5)
    is_tip = i + end in (0, count - 1)
    is_other_tip = j + other in (count, len(x) - 1)
    kinds: list[Callable[[Array], Touch]] = [lambda y: both_sides(laws, y, ra, rb)]
    if is_tip:
        kinds.append(lambda y: tip_on_side(laws, y, ra, rb, end))
    if is_other_tip:
        kinds.append(lambda y: turned(tip_on_side(laws, y[[2, 3, 0, 1]], rb, ra, other)))
    if is_tip and is_other_tip:
        kinds.append(lambda y: two_tips(laws, y, ra, rb, end, other))
    kind = max(kinds, key=lambda k: k(nodes).energy.real)
    found = kind(nodes)
    if found.energy.real <= 0.0:
        return None
    step = 1e-30
    for place in np.ndindex(4, 3):
        moved = nodes.copy()
        moved[place] += 1j * step
        found.pulls[place] = -kind(moved).energy.imag / step
    found.energy = float(found.energy.real)
    c = x[j] + found.t * (x[j + 1] - x[j]) - x[i] - found.s * (x[i + 1] - x[i])
    found.force = max(0.0, float(found.pulls[2:].sum(0) @ c) / float(np.linalg.norm(c)))
    return found


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
        resistance = damper * math.sqrt(found.damped / softness)
        pushed = found.force + resistance * float(slip @ n)
        pushed = max(pushed, 0.0) if laws.clamp else pushed
        pulls = found.pulls
        np.add.at(forces, nodes[0], pulls[:2])
        np.add.at(forces, nodes[1], pulls[2:])
        force = (found.force - pushed) * n
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
            drag = (
                -stiffness * h
                - damper * math.sqrt(laws.shear_ratio * found.damped / softness) * slide
            )
            most = laws.friction * pushed
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
