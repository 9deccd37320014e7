"""The step of a fiber without inertia against its float64 restatement: every scheme and form.

Tolerance 1e-12 of the largest value: rounding of an elimination whose blocks are well conditioned.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber
from tests.reference import overdamped as od
from tests.reference import overdamped_step as restated
from tests.reference.bead_chain import Array
from warpfiber.model import TORN
from warpfiber.scene.tables import strain_rate
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
ROUGH = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])
GRADIENT = ROUGH / strain_rate(tuple(map(tuple, ROUGH)))  # rate 1: the run's units are SI
FLOW = {"kind": "gradient", "viscosity": 1.0, "gradient": GRADIENT.tolist()}
KINDS = {
    "one segment": Kind(1, 9.0),
    "two": Kind(2, 2.3),
    "beads": Kind(7, 1.0),
    "reduced": Kind(6, 2.71),
    "stiff": Kind(5, 3.4, modulus=2e7),
    "thick": Kind(4, 1.6, radius=1.3, modulus=30.0),
}


def overdamped(start: Start, kinds: list[Kind], fibers: list[Array], **keys: Any) -> Simulation:
    """Simulation of one fiber per kind; `numerics` are added to."""
    numerics = {"method": "overdamped", "dt": 0.05, **keys.pop("numerics", {})}
    return start(
        kinds,
        fibers,
        list(range(len(kinds))),
        numerics=numerics,
        flow=keys.pop("flow", FLOW),
        **keys,
    )


def set_history(sim: Simulation, rng: np.random.Generator, size: float = 3.0) -> dict[str, Array]:
    """Random velocities, last displacements and tensions; a step has been taken."""
    nodes, segments = sim.model.node_count, sim.model.segment_count
    history = {
        "velocity": rng.normal(size=(nodes, 3)),
        "motion": 0.05 * rng.normal(size=(nodes, 3)),
        "tension": size * rng.normal(size=segments),
        "before": size * rng.normal(size=segments),
    }
    sim.state.node_velocity.assign(history["velocity"])
    sim.method.node_motion.assign(history["motion"])
    sim.method.tension.assign(history["tension"])
    sim.method.tension_back.assign(history["before"])
    sim.state.step.assign([1])
    return history


def restated_step(
    kind: Kind, form: str, scheme: str, x: Array, past: dict[str, Array], dt: float
) -> tuple[od.Shape, Array]:
    """New shape and the velocity of the end of the step."""
    fiber = od.Fiber(kind.chain(), GRADIENT, form)
    now = od.Shape(x, past["tension"])
    if scheme == "sdirk2":
        shape, velocity, _ = restated.step_sdirk2(fiber, now, dt, past["velocity"])
        return shape, velocity
    shape = restated.step_bdf2(fiber, now, od.Shape(x - past["motion"], past["before"]), dt)
    return shape, (shape.node_pos - (x + past["motion"] / 3.0)) / (2.0 * dt / 3.0)


@pytest.mark.parametrize("scheme", ["sdirk2", "bdf2"])
@pytest.mark.parametrize("form", ["compliant", "inextensible"])
def test_one_step(start: Start, form: str, scheme: str) -> None:
    rng = np.random.default_rng(3)
    kinds = list(KINDS.values())
    fibers = [bent_fiber(kind, rng, stretch=0.002) for kind in kinds]
    sim = overdamped(
        start,
        kinds,
        fibers,
        numerics={"integrator": scheme},
        groups={"inextensible": form == "inextensible"},
    )
    past = set_history(sim, rng)
    sim.step()
    got = {
        "node_pos": sim.node_pos,
        "velocity": sim.node_velocity,
        "tension": sim.method.tension.numpy(),
        "motion": sim.method.node_motion.numpy(),
    }
    begin = 0
    for f, (kind, x) in enumerate(zip(kinds, fibers, strict=True)):
        nodes, parts = slice(begin, begin + len(x)), slice(begin - f, begin - f + kind.segments)
        mine = {
            name: values[nodes if name in ("velocity", "motion") else parts]
            for name, values in past.items()
        }
        shape, velocity = restated_step(kind, form, scheme, x, mine, 0.05)
        for name, expected, where in (
            ("node_pos", shape.node_pos, nodes),
            ("velocity", velocity, nodes),
            ("motion", shape.node_pos - x, nodes),
            ("tension", shape.tension, parts),
        ):
            if name == "motion" and scheme == "sdirk2":
                continue  # BDF2 alone goes on from it
            off = np.abs(got[name][where] - expected).max() / np.abs(expected).max()
            # the size of a tension is that of the forces that it balances
            assert off < 1e-12, (kind, name, off)
        begin += len(x)
    assert sim.step_count == 2
    assert sim.time == pytest.approx(0.05, rel=1e-15)


def test_error_estimate(start: Start) -> None:
    kind, rng = KINDS["reduced"], np.random.default_rng(4)
    x = bent_fiber(kind, rng, stretch=0.002)
    sim = overdamped(start, [kind], [x])
    past = set_history(sim, rng)
    sim.step()
    now = od.Shape(x, past["tension"])
    fiber = od.Fiber(kind.chain(), GRADIENT, "compliant")
    expected = restated.step_sdirk2(fiber, now, 0.05, past["velocity"]).error
    assert sim.method.fiber_error.numpy()[0] == pytest.approx(expected, rel=1e-12)


def test_free_joints_and_gravity(start: Start) -> None:
    """A horizontal chain of free joints sinks evenly: weight of its beads over their drag."""
    kind = Kind(5, 2.5, density=2.0)
    turn = np.random.default_rng(5).normal(size=5).cumsum()
    edges = 5.0 * np.stack([np.cos(turn), np.sin(turn), np.zeros(5)], axis=1)
    x = np.concatenate([np.zeros((1, 3)), edges.cumsum(axis=0)])
    sim = overdamped(
        start,
        [kind],
        [x],
        flow={"kind": "rest", "viscosity": 1.0},
        groups={"bending_modulus": 0.0},
        gravity={"acceleration": [0.0, 0.0, -3.0], "fluid_density": 0.5},
    )
    sim.step(20)
    speed = 4.0 / 3.0 * np.pi * 1.5 * 3.0 / (6.0 * np.pi)
    assert np.abs(sim.node_pos - (x - [0.0, 0.0, speed * sim.time])).max() < 1e-12
    assert np.abs(sim.node_velocity - [0.0, 0.0, -speed]).max() < 1e-12


def test_compression_within_a_step(start: Start) -> None:
    """A matrix that compression makes indefinite is solved without the negative tensions."""
    kind = Kind(6, 2.0, modulus=100.0)
    x = bent_fiber(kind, np.random.default_rng(6), spread=0.1, stretch=0.0)
    sim = overdamped(
        start,
        [kind],
        [x],
        groups={"bending_modulus": 0.0},
        numerics={"integrator": "bdf2", "dt": 0.2},
    )
    sim.state.step.assign([1])
    push = np.full(kind.segments, -500.0)
    sim.method.tension.assign(push)
    sim.method.tension_back.assign(push)
    sim.step()
    chain = kind.chain(bending_modulus=0.0)
    fiber = od.Fiber(chain, GRADIENT, "compliant")
    none = np.zeros(kind.segments)
    expected = restated.step_bdf2(fiber, od.Shape(x, none), od.Shape(x, none), 0.2)
    assert np.abs(sim.node_pos - expected.node_pos).max() < 1e-11
    assert not sim.state.status.numpy()[TORN]


@pytest.mark.parametrize(("name", "bound"), [("reduced", 2e-5), ("stiff", 1e-4), ("thick", 2e-5)])
def test_single_precision(start: Start, name: str, bound: float) -> None:
    """One step of either scheme stays within some hundred roundings of float64, in radii."""
    kind, rng = KINDS[name], np.random.default_rng(7)
    x = bent_fiber(kind, rng, stretch=0.002)
    for scheme in ("sdirk2", "bdf2"):
        found = []
        for precision in ("float64", "float32"):
            numerics = {"integrator": scheme, "precision": precision}
            sim = overdamped(start, [kind], [x], numerics=numerics)
            set_history(sim, np.random.default_rng(8))
            sim.step()
            found.append(sim.node_pos)
        assert np.abs(found[1] - found[0]).max() < bound
