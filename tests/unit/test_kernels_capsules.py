"""Contact of two fibers of bonded spheres against its restatement, and what must not change it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.reference.capsule_contact import Laws, contact_loads
from tests.rods import rates, start_rods
from warpfiber.simulation import Simulation

RADIUS, STEP = 1.2e-3, 2.4e-3


def rod(start: Any, direction: Any, segments: int, bend: float = 0.0, **keys: Any) -> ref.Rod:
    """A fiber from `start`, turning by `bend` (rad) at every node."""
    axis = np.asarray(direction, float) / np.linalg.norm(direction)
    side = np.cross(axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    angle = bend * np.arange(segments)[:, None]
    edges = STEP * (np.cos(angle) * axis + np.sin(angle) * side)
    nodes = np.concatenate([np.zeros((1, 3)), edges.cumsum(0)]) + np.asarray(start) + 0.5
    return ref.Rod(nodes, RADIUS, segment_length=STEP, caps="capsule", **keys)


# start and direction of the second fiber; the first has five segments along x from the origin
MEETINGS: dict[str, tuple[Any, Any]] = {
    "crossed": ([5e-3, -4e-3, 2.3e-3], [0.0, 1.0, 0.0]),
    "at 40 degrees": ([2e-3, -3e-3, 2.25e-3], [math.cos(0.7), math.sin(0.7), 0.0]),
    "at 15 degrees": ([1e-3, -1e-3, 2.3e-3], [math.cos(0.26), math.sin(0.26), 0.0]),
    "at 3 degrees": ([1e-3, -0.2e-3, 2.3e-3], [math.cos(0.052), math.sin(0.052), 0.0]),
    "parallel": ([1.3e-3, 0.3e-3, 2.3e-3], [1.0, 0.0, 0.0]),
    "parallel, end by end": ([11.5e-3, 0.3e-3, 2.2e-3], [1.0, 0.0, 0.0]),
    "against": ([9.3e-3, 0.3e-3, 2.3e-3], [-1.0, 0.01, 0.02]),
    "end on side": ([5.3e-3, 0.1e-3, 2.35e-3], [0.05, 0.02, 1.0]),
    "end on end": ([14.3e-3, 0.1e-3, 0.05e-3], [1.0, 0.05, 0.02]),
    "in the hollow of a kink": ([4.75e-3, -1.3e-3, 2.3e-3], [0.1, 1.0, 0.0]),
    "apart": ([5e-3, -4e-3, 2.5e-3], [0.0, 1.0, 0.0]),
}


def pair(name: str, bend: float = 0.0, **keys: Any) -> tuple[ref.Rod, ref.Rod]:
    """The two fibers of a meeting."""
    start, direction = MEETINGS[name]
    first = rod([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 5, **keys)
    if "hollow" in name:  # two minima on either side of the third node
        first.rest[:, 2] += 0.04 * np.abs(first.rest[:, 0] - first.rest[2, 0]) * (1.0 + bend)
        first = ref.Rod(first.rest, RADIUS, segment_length=STEP, caps="capsule", **keys)
    return first, rod(start, direction, 4, bend, **keys)


def meeting(rods: tuple[ref.Rod, ...], laws: Laws, **keys: Any) -> Simulation:
    """Simulation of fibers that meet."""
    contact = {"law": "hertz", "damping": laws.damping, "friction": laws.friction}
    return start_rods(rods, contact=contact, **keys)


def loads(sim: Simulation, rods: tuple[ref.Rod, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Forces and moments of the start."""
    linear, angular = rates(sim)
    mass = np.concatenate([r.mass for r in rods])[:, None]
    inertia = np.concatenate([r.inertia for r in rods])[:, None]
    return mass * linear, inertia * angular


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("bend", [0.0, 0.02, -0.3])
@pytest.mark.parametrize("name", MEETINGS)
def test_forces(name: str, bend: float, precision: str) -> None:
    """At rest and stress-free all loads are those of the contact; k eps of the overlap."""
    rods, laws = pair(name, bend), Laws()
    x = np.concatenate([r.rest for r in rods])
    still = np.zeros_like(x)
    expected = contact_loads(laws, rods, x, still, still, 0.0)
    sim = meeting(rods, laws, numerics={"precision": precision})
    found = loads(sim, rods)
    touching = np.abs(expected[0]).max()
    assert (touching > 0.0) == (name != "apart" and (name, bend) != ("crossed", -0.3))
    # stress-free bonds pull by eps of their length; in float32 an overlap of 1e-4 m by eps of 0.5 m
    eps = 2.2e-16 if precision == "float64" else 1.2e-7
    bonds = 10.0 * eps * rods[0].k_n * STEP
    for mine, theirs, arm in zip(found, expected, (1.0, STEP), strict=True):
        tolerance = 1e5 * eps * np.abs(theirs).max()
        assert np.abs(mine - theirs).max() <= tolerance + 10.0 * bonds * arm


@pytest.mark.parametrize("friction", [0.0, 0.3, 100.0])
@pytest.mark.parametrize("name", ["crossed", "at 15 degrees", "parallel", "end on side"])
def test_steps(name: str, friction: float) -> None:
    """300 steps of two fibers thrown at each other: memories, sliding, dashpots, lists."""
    rods, laws = pair(name, 0.02, damping=0.0335), Laws(damping=0.113, friction=friction)
    x = np.concatenate([r.rest for r in rods])
    rng = np.random.default_rng(2)
    v = 0.05 * rng.normal(size=x.shape)
    v[6:] -= [0.1, 0.2, 0.5]
    w = 20.0 * rng.normal(size=x.shape)
    sim = meeting(rods, laws, v=v, w=w, numerics={"skin": 4e-4})
    parts = [slice(0, 6), slice(6, 11)]
    motions = [ref.start(r, v=v[s], w=w[s]) for r, s in zip(rods, parts, strict=True)]
    dt = sim.dt

    def add(step: float) -> None:
        """Contact on top of what the bonds do."""
        now = [np.concatenate([getattr(m, key) for m in motions]) for key in "xvw"]
        forces, moments = contact_loads(laws, rods, *now, step)  # type: ignore[arg-type]
        for r, m, s in zip(rods, motions, parts, strict=True):
            bonds = ref.bond_loads(r, m.x, m.q)
            more = ref.damping_loads(r, m.x, m.v, m.w)
            m.a = (bonds[0] + more[0] + forces[s]) / r.mass[:, None]
            m.b = (bonds[1] + more[1] + moments[s]) / r.inertia[:, None]

    add(0.0)
    for _ in range(300):
        for m in motions:
            m.v = m.v + 0.5 * dt * m.a
            m.w = m.w + 0.5 * dt * m.b
            m.x = m.x + dt * m.v
            m.q = ref.product(ref.exponential(dt * m.w), m.q)
        add(dt)
        for m in motions:
            m.v = m.v + 0.5 * dt * m.a
            m.w = m.w + 0.5 * dt * m.b
    sim.step(300)
    expected = np.concatenate([m.x for m in motions])
    moved = np.abs(expected - x).max()
    assert np.abs(sim.node_pos - expected).max() < 1e-7 * moved
    assert sim.method.list is not None and sim.method.list.build_count > 2


@pytest.mark.parametrize("degrees", [90.0, 45.0, 31.0, 25.0, 15.0, 8.0, 3.0])
def test_sliding_over_nodes(degrees: float) -> None:
    """A fiber dragged along another feels the same force wherever the nodes are.

    Where the patch reaches far into other segments these take another slice for the deepest one:
    second order in overlap / radius = 0.08. At wide angles no segment is that far away.
    """
    angle = math.radians(degrees)
    direction = np.array([math.cos(angle), math.sin(angle), 0.0])
    n = 30
    forces = []
    for part in np.linspace(0.0, 1.0, 7):
        first = rod([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], n)
        middle = np.array([(n / 2 + part) * STEP, 0.0, 2.3e-3])
        second = rod(middle - (n / 2 + 0.3 * part) * STEP * direction, direction, n)
        sim = meeting((first, second), Laws())
        force = loads(sim, (first, second))[0][: n + 1].sum(0)
        assert np.abs(force[:2]).max() < (1e-9 if degrees > 40.0 else 4e-2) * abs(force[2])
        forces.append(-force[2])
    assert np.ptp(forces) < (1e-9 if degrees > 40.0 else 1e-2) * np.mean(forces)
    sine = max(math.sin(angle), 0.02)
    ratio = (1.0 + abs(math.cos(angle))) / (1.0 - abs(math.cos(angle)))
    correction = 1.0 - (ratio**0.0684 - 1.0) ** 1.531
    depth = 1e-4
    modulus = 0.5 * 7.5e5 / 0.75
    expected = 4.0 / 3.0 * modulus * math.sqrt(RADIUS / sine) * depth**1.5 * correction**-1.5
    close = 1e-9 if degrees > 40.0 else 1e-2
    assert np.mean(forces) == pytest.approx(expected, rel=close)


def test_a_contact_that_begins_again_has_no_memory() -> None:
    """Fibers that part lose their memory; the list still holds them."""
    rods, laws = pair("crossed"), Laws(friction=1.0)
    v = np.zeros((11, 3))
    v[6:] = [0.05, 0.0, 0.05]
    sim = meeting(rods, laws, v=v)
    contacts = sim.method.contacts  # type: ignore[attr-defined]
    sim.step(5)
    assert contacts.acts.numpy().sum() == 2  # the patch reaches over a node
    assert np.abs(contacts.memory.numpy()[1][:, :3]).max() > 0.0
    assert contacts.written.numpy()[1].max() == 5
    sim.step(500)
    assert contacts.acts.numpy().sum() == 0
    assert contacts.written.numpy()[1].max() < 505


@pytest.mark.parametrize("speed", [0.05, 0.5])
@pytest.mark.parametrize(("clamp", "expected"), [(True, 0.717824), (False, 0.699571)])
def test_restitution_of_the_law(clamp: bool, expected: float, speed: float) -> None:
    """Head on: e = 0.6996 for a dashpot that may pull, 0.7178 for one that may not."""
    rods = rod([0.0, 0.0, 0.0], [1, 0, 0], 1), rod([1.2e-3, -1.2e-3, 2.4e-3], [0, 1, 0], 1)
    laws = Laws(damping=0.113, clamp=clamp)
    x = np.concatenate([r.rest for r in rods])
    mass = np.concatenate([r.mass for r in rods])[:, None]
    v = np.zeros((4, 3))
    v[:2, 2], v[2:, 2] = 0.5 * speed, -0.5 * speed
    still, dt = np.zeros((4, 3)), 4e-6 * speed**-0.2
    rate = still
    while v[2, 2] < 0.0 or x[2, 2] - x[0, 2] < 2.0 * RADIUS + 1e-9:
        v = v + 0.5 * dt * rate
        x = x + dt * v
        rate = contact_loads(laws, rods, x, v, still, dt)[0] / mass
        v = v + 0.5 * dt * rate
    assert (v[2, 2] - v[0, 2]) / speed == pytest.approx(expected, rel=1e-3)
