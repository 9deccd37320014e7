"""What is stored, what is dissipated and what walls put in add up, to the order of dt."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import start_rods
from warpfiber.simulation import Simulation

RADIUS, STEP = 1.2e-3, 2.4e-3
WALLS = {"size": [1.0, 1.0, 0.02], "boundary": ["open", "open", "wall"]}


def rod(middle: Any, degrees: float, segments: int, damping: float = 0.0335) -> ref.Rod:
    """A straight level fiber."""
    angle = math.radians(degrees)
    along = (np.arange(segments + 1) - 0.5 * segments)[:, None] * STEP
    direction = [math.cos(angle), math.sin(angle), 0.0]
    rest = np.asarray(middle) + along * np.asarray(direction)
    return ref.Rod(rest, RADIUS, damping=damping, caps="capsule")


def total(row: dict[str, float]) -> float:
    """Stored and dissipated less what the walls put in."""
    terms = [v for k, v in row.items() if k.startswith(("energy", "dissipated"))]
    return math.fsum(terms) - row.get("wall_work", 0.0)


def imbalance(sim: Simulation, time: float) -> tuple[float, dict[str, float]]:
    """Largest change of the total on the way to a time, of what moved at most; the last row."""
    first = row = sim.measure()
    worst, scale = 0.0, first["energy_kinetic"]
    for instant in np.linspace(0.0, time, 21)[1:]:
        sim.run(time=instant)
        row = sim.measure()
        worst = max(worst, abs(total(row) - total(first)))
        scale = max(scale, row["energy_kinetic"], abs(row.get("wall_work", 0.0)))
    return worst / scale, row


def crossing(fraction: float) -> Simulation:
    """Two fibers thrown at each other: dashpots and friction of contacts and bonds."""
    rods = [rod([0.5, 0.5, 0.5], 0.0, 9), rod([0.5, 0.5, 0.5 + 2.41e-3], 90.0, 9)]
    v = np.zeros((20, 3))
    v[10:] = [0.1, 0.2, -0.5]
    contact = {"law": "hertz", "damping": 0.113, "friction": 0.3}
    numerics = {"dt_fraction": fraction}
    return start_rods(rods, v=v, contact=contact, numerics=numerics, quantities=["energy"])


def on_a_plane(fraction: float) -> Simulation:
    """A fiber slides and turns on a wall: dashpot and friction of the wall, gravity, settling."""
    v = np.zeros((7, 3))
    v[:, 1], v[:, 2] = 0.1, -0.2
    return start_rods(
        [rod([0.5, 0.5, RADIUS + 1e-4], 0.0, 6)],
        v=v,
        box=WALLS,
        contact={"law": "none", "damping": 0.113, "wall_friction": 0.4},
        gravity={},
        stage=[{"kind": "settle", "damping": 5.0, "end_time": 1.0}],
        numerics={"dt_fraction": fraction},
        quantities=["energy"],
    )


def on_a_belt(fraction: float) -> Simulation:
    """A fiber on a wall that moves beneath it."""
    return start_rods(
        [rod([0.5, 0.5, 0.99 * RADIUS], 30.0, 6)],
        box=WALLS,
        contact={"law": "none", "damping": 0.113, "wall_friction": 0.4},
        gravity={},
        wall=[{"name": "z-", "velocity": [0.2, 0.0, 0.0]}],
        numerics={"dt_fraction": fraction},
        quantities=["energy"],
    )


def on_an_incline(fraction: float) -> Simulation:
    """A fiber on a plane of its own that stands askew and moves along itself."""
    tilted = {"name": "chute", "normal": [-0.6, 0.0, 0.8], "position": [0.5, 0.5, 0.5]}
    middle = np.array([0.5, 0.5, 0.5]) + 0.99 * RADIUS * np.array([-0.6, 0.0, 0.8])
    return start_rods(
        [rod(middle.tolist(), 90.0, 6)],
        contact={"law": "none", "damping": 0.113},
        gravity={},
        wall=[tilted | {"friction": 0.5, "velocity": [0.16, 0.1, 0.12]}],
        numerics={"dt_fraction": fraction},
        quantities=["energy"],
    )


def squeezed(fraction: float) -> Simulation:
    """Three crossed fibers between walls, of which the upper one comes down."""
    rods = [rod([0.5, 0.5, (0.99 + 1.98 * k) * RADIUS], 90.0 * k, 7) for k in range(3)]
    sim = start_rods(
        rods,
        box=WALLS,
        contact={"law": "hertz", "damping": 0.113, "friction": 0.3, "wall_friction": 0.4},
        stage=[{"kind": "compress", "wall": "z+", "speed": 0.1, "end_time": 0.1}],
        numerics={"dt_fraction": fraction},
        quantities=["energy"],
    )
    sim.method.begin_stage(sim.scene.stages[0])
    return sim


CASES: dict[str, tuple[Callable[[float], Simulation], float, float]] = {
    "crossing": (crossing, 0.01, 1e-3),
    "on a plane": (on_a_plane, 0.03, 3e-3),
    "on a belt": (on_a_belt, 0.03, 3e-3),
    "on an incline": (on_an_incline, 0.03, 3e-3),
    "squeezed": (squeezed, 0.01, 2e-4),
}


@pytest.mark.parametrize("name", CASES)
def test_balance(name: str) -> None:
    """The total stays, up to C dt of what moved; C per dt limit from the largest step.

    Contacts between nodes and at wide angles: these have a potential.
    """
    start, time, most = CASES[name]
    found = []
    for fraction in (0.2, 0.1, 0.05):
        error, row = imbalance(start(fraction), time)
        assert error < 5.0 * most * fraction
        found.append(error)
    assert found[2] < 0.6 * found[1] < 0.36 * found[0]
    settles = name == "on a plane"
    for kind in ("bonds", "contacts", "friction"):
        assert row[f"dissipated_{kind}"] > 0.0
    assert (row["dissipated_settling"] > 0.0) == settles


def test_what_contacts_store() -> None:
    """Hertz between fibers and on a wall, 8/15 E* sqrt(R) d^2.5; half a spring for the memory."""
    sim = crossing(0.1)
    sim.step(40)
    row, units = sim.measure(), sim.model.units
    x = sim.node_pos
    a, b = x[5] - x[4], x[15] - x[14]
    n = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    depth = 2.0 * RADIUS - abs(float((x[14] - x[4]) @ n))
    modulus = 0.5 * 7.5e5 / 0.75
    expected = 8.0 / 15.0 * modulus * math.sqrt(RADIUS) * depth**2.5
    assert depth > 1e-5
    assert row["energy_contact"] == pytest.approx(expected, rel=1e-6)
    contacts = sim.method.contacts  # type: ignore[attr-defined]
    acts = contacts.acts.numpy()[: contacts.search.list.pair_count] != 0
    h = contacts.memory.numpy()[sim.step_count % 2][: len(acts)][acts][:, :3] * units.length
    stiffness = 2.0 / 3.0 * 2.0 * modulus * math.sqrt(RADIUS * depth)  # k_t / k_n = 2/3 at nu = 1/2
    assert row["energy_friction"] == pytest.approx(0.5 * stiffness * (h**2).sum(), rel=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_what_lines_store(degrees: float) -> None:
    """The force along a line is the slope of its energy where fibers keep their directions."""

    def pressed(depth: float) -> Simulation:
        rods = [
            rod([0.5, 0.5, 0.5], 0.0, 9),
            rod([0.503, 0.5, 0.5 + 2.0 * RADIUS - depth], degrees, 5),
        ]
        contact = {"law": "hertz", "friction": 0.0}
        return start_rods(rods, contact=contact, quantities=["energy"])

    low, here, high = (pressed(1e-4 + s * 1e-6) for s in (-1.0, 0.0, 1.0))
    for sim in (low, here, high):
        sim.prepare()
    slope = (high.measure()["energy_contact"] - low.measure()["energy_contact"]) / 2e-6
    contacts = here.method.contacts  # type: ignore[attr-defined]
    force = contacts.force.numpy()[contacts.acts.numpy() != 0][:, 2].sum()
    # at the ends of a fiber half spheres take over from the line
    assert slope == pytest.approx(abs(force) * here.model.units.force, rel=1e-2)
