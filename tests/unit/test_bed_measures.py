"""Forces of contacts, inclination, numbers and stress by node; who is who does not matter."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import rates, start_rods
from warpfiber.methods.bed_measures import NODE_FIELDS
from warpfiber.passes.measurement import fiber_pair_keys
from warpfiber.simulation import Simulation

RADIUS, STEP = 1.2e-3, 2.4e-3
DEPTH = 1e-4
MODULUS = 7.5e5
# Hertz of two crossed cylinders, N
PUSH = 4.0 / 3.0 * 0.5 * MODULUS / 0.75 * math.sqrt(RADIUS) * DEPTH**1.5


def rod(middle: Any, direction: Any, segments: int = 5) -> ref.Rod:
    """A straight fiber around a point."""
    along = (np.arange(segments + 1) - 0.5 * segments)[:, None] * STEP
    axis = np.asarray(direction, float) / np.linalg.norm(direction)
    return ref.Rod(np.asarray(middle) + along * axis, RADIUS, caps="capsule")


def measured(rods: list[ref.Rod], *quantities: str, **keys: Any) -> Simulation:
    """Simulation of rods that meet without friction."""
    contact = {"law": "hertz"}
    return start_rods(rods, contact=contact, quantities=quantities, **keys)


def test_forces_by_contact_and_by_pair() -> None:
    """One fiber on two; a parallel one touches along a line with several pairs of segments."""
    apart = 2.0 * RADIUS - DEPTH
    crossed = [
        rod([0.5, 0.5, 0.5], [1, 0, 0]),
        rod([0.5, 0.5, 0.5 + apart], [0, 1, 0]),
        rod([0.5, 0.5, 0.5 - apart], [0, 1, 0]),
    ]
    row = measured(crossed, "contacts").measure()
    assert row["contact_force_mean"] == pytest.approx(PUSH, rel=1e-9)
    assert row["contact_force_pair_mean"] == pytest.approx(PUSH, rel=1e-9)
    assert row["coordination_number"] == pytest.approx(4.0 / 3.0)

    sim = measured([crossed[0], rod([0.5, 0.5, 0.5 + apart], [1, 0, 0])], "contacts")
    row = sim.measure()
    acts = int(sim.method.contacts.acts.numpy().sum())  # type: ignore[attr-defined]
    assert acts >= 5
    whole = row["contact_force_pair_mean"]
    assert whole == pytest.approx(acts * row["contact_force_mean"], rel=1e-9)
    assert whole == pytest.approx(1.17 * math.pi / 4 * 5e5 * 5 * STEP * DEPTH, rel=0.05)


def test_a_new_list_keeps_the_forces() -> None:
    sim = measured(
        [rod([0.5, 0.5, 0.5], [1, 0, 0]), rod([0.5, 0.5, 0.5023], [0, 1, 0])], "contacts"
    )
    sim.prepare()
    before = sim.measure()
    sim.method.contacts.build(0)  # type: ignore[attr-defined]
    assert sim.measure() == before
    assert before["contact_force_mean"] > 0.0


def test_a_fiber_is_not_its_own_neighbor() -> None:
    """Longer than the periodic box, so that its ends meet."""
    box = {"size": [0.1, 5.9 * STEP, 0.1], "boundary": ["periodic"] * 3}
    sim = measured([rod([0.05, 0.006, 0.05], [0, 1, 0])], "contacts", box=box)
    row = sim.measure()
    assert sim.method.contacts.acts.numpy().sum() > 0  # type: ignore[attr-defined]
    assert row["coordination_number"] == 0.0
    assert row["contact_force_mean"] == 0.0


def test_inclination() -> None:
    """Angles with the horizontal, whichever way fibers point; bins of 10 degrees."""
    angles = [0.0, 5.0, 15.0, -15.0, 44.0, 89.0]
    rods = []
    for k, angle in enumerate(angles):
        slope = math.radians(angle)
        rods.append(rod([0.3 + 0.05 * k, 0.5, 0.5], [math.cos(slope), 0.0, math.sin(slope)]))
    row = measured(rods, "inclination").measure()
    assert row["inclination_mean"] == pytest.approx(np.abs(angles).mean())
    shares = [row[f"inclination_{10 * k:02d}_{10 * k + 10:02d}"] for k in range(9)]
    assert shares == pytest.approx([2 / 6, 2 / 6, 0, 0, 1 / 6, 0, 0, 0, 1 / 6])


def test_inclination_of_a_ring() -> None:
    """That of its plane."""
    angle = 2.0 * np.pi * np.arange(20) / 20
    circle = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1) * 0.01
    tilt = math.radians(33.0)
    turn = np.array(
        [[math.cos(tilt), 0, -math.sin(tilt)], [0, 1, 0], [math.sin(tilt), 0, math.cos(tilt)]]
    )
    ring = ref.Rod(0.5 + circle @ turn.T, RADIUS, closed=True, caps="capsule")
    sim = start_rods([ring], quantities=["inclination"])
    assert sim.measure()["inclination_mean"] == pytest.approx(33.0, rel=1e-9)


def test_contacts_by_node() -> None:
    """Crossing a fifth of a segment beyond a node: that node, and the middle ones of the other."""
    first = rod([0.5, 0.5, 0.5], [1, 0, 0])
    second = rod([0.5 - 0.3 * STEP, 0.5 + 0.2 * STEP, 0.50239], [0, 1, 0])
    sim = measured([first, second])
    sim.prepare()
    sim_fields = fields(sim, "contact_count")
    assert sim_fields[2] == 1.0 and sim_fields[6 + 2] == 1.0
    assert sim_fields.sum() == 2.0


def fields(sim: Simulation, name: str) -> np.ndarray:
    """One field of the nodes."""
    return NODE_FIELDS[name](sim.method)  # type: ignore[arg-type]


def test_stress_by_node() -> None:
    """E e of a stretched fiber, plus E a k of one bent to a circle."""
    straight = rod([0.5, 0.5, 0.5], [1, 0, 0], 10)
    x = straight.rest.copy()
    x[:, 0] = 0.5 + 1.02 * (x[:, 0] - 0.5)
    sim = start_rods([straight], x=x)
    sim.prepare()
    assert fields(sim, "bond_stress") == pytest.approx(0.02 * MODULUS, rel=1e-9)
    bend = 0.03  # rad from node to node
    half = 0.5 * bend * (np.arange(11) - 5)
    q = np.stack([0.0 * half, np.sin(half), 0.0 * half, np.cos(half)], axis=1)
    sim = start_rods([straight], x=x, q=q)
    sim.prepare()
    expected = MODULUS * (0.02 + RADIUS * bend / STEP)
    assert fields(sim, "bond_stress") == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("angle", "steps"), [(90.0, 15), (40.0, 15), (12.0, 15), (0.0, 6)])
def test_names_do_not_matter(angle: float, steps: int) -> None:
    """Fibers in another order and nodes from the other end: the same accelerations to rounding."""
    slope = math.radians(angle)
    rods = [
        rod([0.5, 0.5, 0.5], [1, 0, 0]),
        rod([0.501, 0.5003, 0.5023], [math.cos(slope), math.sin(slope), 0.01]),
        rod([0.4985, 0.4998, 0.4977], [math.cos(slope), -math.sin(slope), 0.0], 4),
    ]
    count = [len(r.rest) for r in rods]
    first = np.cumsum([0, *count])
    v = 0.05 * np.random.default_rng(1).normal(size=(first[-1], 3))
    v[first[1] : first[2], 2] -= 0.6
    v[first[2] :, 2] += 0.6
    contact = {"law": "hertz", "damping": 0.113, "friction": 0.5}
    quantities = ["contacts", "energy"]
    sim = start_rods(rods, v=v, contact=contact, quantities=quantities)
    order = [2, 0, 1]
    other = [ref.Rod(rods[k].rest[::-1], RADIUS, caps="capsule") for k in order]
    place = np.concatenate([np.arange(first[k + 1] - 1, first[k] - 1, -1) for k in order])
    again = start_rods(other, v=v[place], contact=contact, quantities=quantities)
    linear, _ = rates(sim)
    assert np.abs(rates(again)[0] - linear[place]).max() < 1e-9 * np.abs(linear).max()
    for each in (sim, again):
        each.step(steps)
    a, b = sim.measure(), again.measure()
    assert a["contact_force_mean"] > 0.0
    for name, value in a.items():
        assert b[name] == pytest.approx(value, rel=1e-6, abs=1e-15), name
    moved = np.abs(sim.node_pos - np.concatenate([r.rest for r in rods])).max()
    assert np.abs(again.node_pos - sim.node_pos[place]).max() < 1e-8 * moved


def test_keys_of_fiber_pairs() -> None:
    """Equal where fibers and image are equal, different elsewhere; none of none."""
    rng = np.random.default_rng(1)
    rows = rng.integers([0, 0, -40], [7, 9, 40], size=(2000, 3)).astype(np.int32)
    keys = fiber_pair_keys(*rows.T)
    _, expected = np.unique(rows, axis=0, return_inverse=True)
    _, found = np.unique(keys, return_inverse=True)
    np.testing.assert_array_equal(found, expected.ravel())
    assert len(fiber_pair_keys(*rows[:0].T)) == 0
