"""Pace of a fiber that springs far: it is slowed, keeps to the flow, and others are left alone.

Tolerance: the motion of a slowed fiber is that of one whose forces are so much smaller, to rounding
(eps times the size of the cell); in proportion only where the step resolves it.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.cell import Kind, place
from tests.meeting_cell import Meeting
from warpfiber.methods.contact import ImplicitContact
from warpfiber.passes.chain_pace import LEAST, MOST_MOVE
from warpfiber.placement import Placement
from warpfiber.simulation import Simulation

FAR = {"size": [400.0, 400.0, 400.0]}
LINKS = 8


def arcs(sagittas: list[float]) -> Placement:
    """Fibers on arcs of a parabola, far apart."""
    s = np.linspace(-1.0, 1.0, LINKS + 1)
    nodes = []
    for k, sagitta in enumerate(sagittas):
        # chords as long as the links: x moves in as z moves out
        z = sagitta * (1.0 - s**2)
        x = np.concatenate([[0.0], np.cumsum(np.sqrt(64.0 - np.diff(z) ** 2))])
        line = np.stack([x - 0.5 * x[-1], np.full_like(s, 60.0 * k), z], axis=1)
        nodes.append(line + 100.0)
    return place(nodes, [0] * len(sagittas))


def spring(modulus: float, sagittas: list[float], pace: bool = True) -> Simulation:
    """One step of arcs in shear."""
    meeting = Meeting([])
    sim = meeting(
        "overdamped",
        kinds=(Kind(LINKS, 4.0, modulus=modulus),),
        which=[0] * len(sagittas),
        box=FAR,
        placement=arcs(sagittas),
    )
    contact = sim.method.contact  # type: ignore[attr-defined]
    assert isinstance(contact, ImplicitContact) and contact.packed
    sim.method.paced = pace  # type: ignore[attr-defined]
    sim.step(1)
    return sim


def paces(sim: Simulation) -> np.ndarray:
    """Of every fiber in the last step."""
    values: np.ndarray = sim.method.fiber_pace.numpy().copy()  # type: ignore[attr-defined]
    return values


def bend(sim: Simulation, fiber: int) -> float:
    """Sagitta now."""
    start = sim.fiber_node_start
    mine = sim.node_pos[start[fiber] : start[fiber + 1]]
    return float(mine[LINKS // 2, 2] - 0.5 * (mine[0, 2] + mine[-1, 2]))


def test_only_what_springs_far_is_slowed() -> None:
    """Of two fibers the one that is bent little takes the step as it would without any pace."""
    sim, free = (spring(1e6, [12.0, 0.5], pace) for pace in (True, False))
    pace = paces(sim)
    assert LEAST <= pace[0] < 1.0 and pace[1] == 1.0
    start = arcs([12.0, 0.5]).node_pos[: LINKS + 1, 2]  # the flow moves nothing along z
    moved, freely = (np.abs(run.node_pos[: LINKS + 1, 2] - start).max() for run in (sim, free))
    assert moved < freely and freely > MOST_MOVE
    half = slice(LINKS + 1, None)
    assert sim.node_pos[half].tobytes() == free.node_pos[half].tobytes()
    for run in (sim, free):
        run.close()


def test_pace_is_a_softer_fiber() -> None:
    """The slowed fiber moves as one of `pace` times its modulus does, whose compliance it has."""
    sim = spring(3e6, [12.0])
    pace = float(paces(sim)[0])
    assert LEAST < pace < 1.0
    soft = spring(pace * 3e6, [12.0], pace=False)
    np.testing.assert_allclose(sim.node_pos, soft.node_pos, rtol=0.0, atol=1e-9)
    for run in (sim, soft):
        run.close()


@pytest.mark.parametrize("modulus", [3e6, 3e9])
def test_bend_goes_in_the_end(modulus: float) -> None:
    """Slower, but the fiber straightens; a stiff one at once, whatever its pace."""
    sim = spring(modulus, [12.0])
    before = abs(bend(sim, 0))
    for _ in range(3):
        sim.step(1)
        assert abs(bend(sim, 0)) < before
        before = abs(bend(sim, 0))
    sim.close()
