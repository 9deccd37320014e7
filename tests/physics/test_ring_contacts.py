"""Contacts of rings: the segment from the last node to the first is one like all others."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.physics.test_contact_hand_over import TILT
from tests.reference import bonded_spheres as ref
from tests.rods import rates, start_rods
from warpfiber.simulation import Simulation

RADIUS, N = 1.2e-3, 26
ROUND = 10.3e-3
CENTER = np.array([0.5, 0.5, 0.5])
RUBBING = {"law": "hertz", "damping": 0.113, "friction": 0.5}


def circle(away: Any, tilt: float = 0.0) -> np.ndarray:
    """Nodes of a ring around x, turned by `tilt` about x, away from CENTER."""
    angle = 2.0 * np.pi * np.arange(N) / N
    x = ROUND * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    c, s = math.cos(tilt), math.sin(tilt)
    turned: np.ndarray = x @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    return turned + CENTER + np.asarray(away)


def hoop(nodes: np.ndarray) -> ref.Rod:
    """A closed fiber."""
    return ref.Rod(nodes, RADIUS, closed=True)


def track(first: int, straight: int = 11, around: int = 8) -> np.ndarray:
    """A closed path with two straight sides along x; its numbering starts at the node `first`."""
    step = 2.0 * RADIUS * 1.01
    bend = step / (2.0 * math.sin(math.pi / (2 * around)))
    side = step * (np.arange(straight + 1) - 0.5 * straight)
    turn = math.pi * (np.arange(1, around) / around - 0.5)
    right = np.stack([side[-1] + bend * np.cos(turn), bend * np.sin(turn)], axis=1)
    low = np.stack([side, np.full(straight + 1, -bend)], axis=1)
    half = np.concatenate([low, right])
    plane = np.concatenate([half, -half])
    nodes = np.concatenate([plane, np.zeros((len(plane), 1))], axis=1)
    return np.roll(nodes + CENTER, -first, axis=0)


@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.5])
def test_numbering(tilt: float) -> None:
    """Two rings that meet move alike wherever their numbering starts; k eps of the forces."""
    found = []
    for shift in (0, 1, 9, N - 1):
        away = [0.3e-3, 0.2e-3, 2.0 * RADIUS - 5e-5] if tilt < 1.0 else [2e-3, -ROUND, ROUND]
        rods = [hoop(np.roll(circle([0.0, 0.0, 0.0]), -shift, axis=0))]
        if tilt == 0.3:
            away[2] += ROUND * math.sin(tilt) - 1e-4
        if tilt > 1.0:
            away[2] = 0.5e-3
        rods.append(hoop(np.roll(circle(away, tilt), -(2 * shift), axis=0)))
        v = np.zeros((2 * N, 3))
        v[N:, 0], v[N:, 2] = 0.3, -0.2
        told = ["contacts", "overlap", "energy"]
        sim = start_rods(rods, v=v, contact=RUBBING, numerics={"dt": 1e-5}, quantities=told)
        sim.prepare()
        acts = int(sim.method.contacts.acts.numpy().sum())  # type: ignore[attr-defined]
        sim.step(400)
        x = sim.node_pos
        whole = np.concatenate(
            [np.roll(x[:N], shift, axis=0), np.roll(x[N:], 2 * shift, axis=0)],
        )
        found.append((acts, whole, sim.measure()))
    assert np.abs(found[0][1][:N] - circle([0.0] * 3)).max() > 1e-6  # the first ring was pushed
    for acts, whole, row in found[1:]:
        largest = max(abs(v) for k, v in row.items() if k.startswith(("energy", "diss")))
        for name, value in row.items():
            scale = largest if name.startswith(("energy", "diss")) else 1.0
            assert abs(value - found[0][2][name]) < 1e-7 * scale, name
        assert acts == found[0][0]
        assert np.abs(whole - found[0][1]).max() < 1e-9 * ROUND


def eight(first: int, nodes: int = 60) -> np.ndarray:
    """Parameter of the nodes of a closed fiber that crosses itself where it is 0 and pi."""
    angle: np.ndarray = 2.0 * np.pi * (np.arange(nodes) + first + 0.1) / nodes
    return angle


def crossed(first: int, speed: float) -> Simulation:
    """A figure of eight whose two strands slide across one another; numbered from `first` on."""
    t = eight(first)
    away = [26e-3 * np.sin(t), 13e-3 * np.sin(2.0 * t), (RADIUS - 1e-4) * np.cos(t)]
    v = np.stack([speed * np.cos(t), 0.1 + 0.0 * t, -0.05 * np.cos(t)], axis=1)
    rod = hoop(CENTER + np.stack(away, axis=1))
    return start_rods([rod], v=v, contact=RUBBING, numerics={"dt": 1e-5})


@pytest.mark.parametrize("speed", [1.5, -1.5])
def test_contact_with_itself(speed: float) -> None:
    """A ring that slides across itself moves alike wherever it is numbered from; rounding."""
    found = []
    for first in (0, 1, 2, 30, 59):
        sim = crossed(first, speed)
        friction, touched, met = 0.0, 0, set()
        for _ in range(80):
            sim.step(10)
            count = sim.method.list.pair_count  # type: ignore[union-attr]
            contacts = sim.method.contacts  # type: ignore[attr-defined]
            acts = contacts.acts.numpy()[:count] != 0
            touched += int(acts.sum())
            i, j, _ = sim.method.list.host_pairs()  # type: ignore[union-attr]
            met |= set(zip(i[acts].tolist(), j[acts].tolist(), strict=True))
            force = contacts.force.numpy()[:count][acts]
            friction += float(np.hypot(force[:, 0], force[:, 1]).sum())
        assert len(met) > 1  # it passes from segment to segment
        found.append((np.roll(sim.node_pos, first, axis=0), friction, touched))
    assert found[0][2] > 10
    for nodes, friction, touched in found[1:]:
        assert touched == found[0][2]
        assert abs(friction / found[0][1] - 1.0) < 1e-7
        assert np.abs(nodes - found[0][0]).max() < 1e-9 * ROUND


def dragged(first: int, velocity: list[float], friction: float) -> Simulation:
    """A prescribed straight fiber across the straight side of a fixed closed one."""
    path = track(first)
    low = path[:, 1].min()
    cross = np.array(
        [CENTER[0] - math.copysign(2.7e-3, velocity[0]), low, CENTER[2] + 2.0 * RADIUS - 1e-4]
    )
    second = cross + np.outer((np.arange(7) - 3.4) * 2.02 * RADIUS, [0.0, 1.0, 0.0])
    row = {
        "diameter": 2.0 * RADIUS,
        "density": 1340.0,
        "youngs_modulus": 7.5e5,
        "frozen": True,
        "count": 1,
        "orientation": "aligned",
        "position": [0.01, 0.01, 0.01],
    }
    step = 2.02 * RADIUS
    fibers = [
        row | {"centerline_length": len(path) * step, "shape": {"kind": "ring"}},
        row | {"centerline_length": 6 * step},
    ]
    return start_rods(
        [hoop(path), ref.Rod(second, RADIUS, caps="capsule")],
        fibers=fibers,
        load=[{"group": 1, "velocity": velocity}],
        contact={"law": "hertz", "friction": friction},
        numerics={"dt": 2e-5},
    )


def pushes(sim: Simulation) -> np.ndarray:
    """Sum over the contacts of all listed pairs, in run units."""
    contacts = sim.method.contacts  # type: ignore[attr-defined]
    count = sim.method.list.pair_count  # type: ignore[union-attr]
    acts = contacts.acts.numpy()[:count] != 0
    total: np.ndarray = contacts.force.numpy()[:count][acts].sum(axis=0)
    return total


@pytest.mark.parametrize("first", [0, 5, 6])
@pytest.mark.parametrize("speed", [0.1, -0.1])
def test_drag_over_the_closure(first: int, speed: float) -> None:
    """mu times a constant normal force, also over the closing segment; see TILT."""
    sim = dragged(first, [speed, 0.0, 0.0], 0.3)
    found, builds = [], 0
    for _ in range(400):
        sim.step(7)
        before, builds = builds, sim.method.list.build_count  # type: ignore[union-attr]
        if builds == before:
            found.append(pushes(sim))
    push = np.asarray(found)[30:]
    normal, drag = np.abs(push[:, 2]), np.hypot(push[:, 0], push[:, 1])
    assert normal[0] > 0.0
    assert np.ptp(normal) < TILT * normal[0]
    assert np.abs(drag / normal - 0.3).max() < 0.3 * TILT


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_ring_on_ring(precision: str) -> None:
    """Two rings face to face: all nodes are pushed alike, the same whichever is numbered first."""
    rods = [hoop(circle([0.0, 0.0, 0.0])), hoop(circle([0.0, 0.0, 2.0 * RADIUS - 2e-5]))]
    linear, _ = rates(start_rods(rods, contact=RUBBING, numerics={"precision": precision}))
    tolerance = 1e-9 if precision == "float64" else 0.02  # eps of a radius over the overlap
    assert linear[0, 2] < -1.0
    assert np.abs(linear[:N, 2] / linear[0, 2] - 1.0).max() < tolerance
    assert np.abs(linear[N:, 2] / linear[0, 2] + 1.0).max() < tolerance


def test_pairs() -> None:
    """A ring lists no pairs of its own nearer than pi a along it, whichever way round."""
    sim = start_rods([hoop(circle([0.0] * 3))], contact=RUBBING, numerics={"skin": 6e-3})
    sim.prepare()
    i, j, _ = sim.method.list.host_pairs()  # type: ignore[union-attr]
    apart = np.minimum(j - i, N - (j - i))
    assert apart.min() == 3
    assert np.bincount(np.concatenate([i[apart == 3], j[apart == 3]])).tolist() == [2] * N


def test_rest() -> None:
    """A ring that came to rest on a held one: its contacts carry its weight on average.

    4 standard errors, and what is left of its motion.
    """
    row = {
        "diameter": 2.0 * RADIUS,
        "density": 1340.0,
        "youngs_modulus": 7.5e5,
        "count": 1,
        "orientation": "aligned",
        "position": [0.01, 0.01, 0.01],
        "centerline_length": 2.0 * math.pi * ROUND,
        "shape": {"kind": "ring"},
    }
    rods = [hoop(circle([0.0, 0.0, 0.0])), hoop(circle([0.0, 0.0, 2.0 * RADIUS - 1e-6]))]
    sim = start_rods(
        rods,
        contact=RUBBING,
        fibers=[row | {"frozen": True}, row],
        gravity={"acceleration": [0.0, 0.0, -200.0]},
        stage=[{"kind": "settle", "end_time": 1.0, "damping": 300.0}],
        numerics={"dt": 2e-5},
    )
    sim.begin_stage(sim.scene.stages[0])
    sim.step(4000)
    found = []
    for _ in range(200):
        sim.step(20)
        found.append(abs(pushes(sim)[2]) * sim.model.units.force)
    blocks = np.reshape(found, (10, 20)).mean(axis=1)
    arc = math.pi / N / math.sin(math.pi / N)  # a ring weighs what its circle does
    weight = 200.0 * N * rods[1].mass[0] * arc
    scatter = blocks.std(ddof=1) / math.sqrt(10.0)
    assert abs(blocks.mean() - weight) < 4.0 * scatter + 1e-6 * weight
    assert scatter < 1e-3 * weight
    assert np.ptp(sim.node_pos[N:, 2]) < 1e-5


def test_restored() -> None:
    """A restored run goes on to the last bit; so does one with more workers."""

    def run(workers: int = 1) -> Simulation:
        rods = [hoop(circle([0.0] * 3)), hoop(circle([0.4e-3, 0.3e-3, 2.0 * RADIUS - 5e-5], 0.02))]
        v = np.zeros((2 * N, 3))
        v[N:, 0] = 0.5
        sim = start_rods(rods, v=v, contact=RUBBING, numerics={"dt": 1e-5}, workers=workers)
        sim.begin_stage(sim.scene.stages[0])
        return sim

    whole, parts, shared = run(), run(), run(2)
    whole.step(900)
    shared.step(900)
    parts.step(450)
    again = run()
    again.restore(parts.snapshot())
    again.step(450)
    assert whole.method.list.build_count > 1  # type: ignore[union-attr]
    for sim in (shared, again):
        assert np.array_equal(sim.node_pos, whole.node_pos)
        assert np.array_equal(sim.state.node_velocity.numpy(), whole.state.node_velocity.numpy())
