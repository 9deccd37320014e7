"""How near pairs come in a step: the SIMD block against the plain kernel, and what a check skips.

Tolerance 1e-12 (float64) or 3e-5 (float32) of lengths of 10: rounding of some ten operations.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import warp as wp

from tests.meeting_cell import METHODS, Meeting, contact_rows
from warpfiber.passes.contact_check import ContactCheck
from warpfiber.passes.executor import Executor
from warpfiber.passes.pair_motion import make_pair_motion
from warpfiber.simulation import Simulation


def last_pairs(sim: Simulation) -> int:
    return int(sim.method.list.pair_count)  # type: ignore[union-attr]


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Cells that are closed at the end of the test."""
    made = Meeting([])
    yield made
    for simulation in made.running:
        simulation.close()


@pytest.fixture(params=["float64", "float32"])
def stepped(meeting: Meeting, request: pytest.FixtureRequest) -> Simulation:
    """A cell in the middle of a run, some pairs of it by images."""
    sim: Simulation = meeting("overdamped", 75, numerics={"precision": request.param})
    sim.step(10)
    sim.method.prepare()
    return sim


def cleared(sim: Simulation, native: bool) -> np.ndarray:
    """What the pairs of the list stay apart by, between the last two positions."""
    rows = contact_rows(sim)
    model, launch = sim.model, rows._motion(sim.state.node_pos, rows.pair_clear)
    kernel = make_pair_motion(model.precision.name, True, native=native)
    dim = launch.dim if native else model.segment_count
    rows.pair_clear.fill_(np.nan)
    wp.launch(kernel, dim=dim, inputs=[0, *launch.inputs], device=model.device)
    return rows.pair_clear.numpy()[: last_pairs(sim)].astype(float)


def test_block_is_the_plain_kernel(stepped: Simulation) -> None:
    plain, block = cleared(stepped, False), cleared(stepped, True)
    assert len(plain) > 100
    assert (plain < 2.3).any() and (plain > 2.5).any()
    eps = 1e-12 if stepped.scene.numerics.precision == "float64" else 3e-5
    assert np.abs(plain - block).max() < 10.0 * eps


def test_points_stay_apart(stepped: Simulation) -> None:
    """No two points of a pair come nearer, at any time of the step."""
    clear = cleared(stepped, True)
    rows, model = contact_rows(stepped), stepped.model
    first = model.host["segment_node"]
    back, now = (a.numpy().astype(float) for a in (rows.node_back, stepped.state.node_pos))
    i, j, code = stepped.method.list.host_pairs()  # type: ignore[union-attr]
    number = np.stack([((code >> 10 * axis) & 1023) - 512 for axis in range(3)], axis=1)
    lattices = [a.numpy()[0].astype(float) for a in (rows.lattice_back, rows.lattice_now)]
    assert np.abs(number).any()
    share = np.linspace(0.0, 1.0, 9)
    for tau in (0.0, 0.3, 0.7, 1.0):
        x = (1.0 - tau) * back + tau * now
        shift = number @ ((1.0 - tau) * lattices[0] + tau * lattices[1]).T

        def points(k: np.ndarray, x: np.ndarray = x) -> np.ndarray:
            start, end = x[first[k]], x[first[k] + 1]
            return start[:, None] + share[:, None] * (end - start)[:, None]

        apart = points(j)[:, None] + shift[:, None, None] - points(i)[:, :, None]
        nearest = np.linalg.norm(apart, axis=3).min(axis=(1, 2))
        assert (nearest > clear - 1e-3).all()


@pytest.mark.parametrize("linearizations", [1, 2])
@pytest.mark.parametrize("method", METHODS)
def test_check_that_skips_sees_the_same(meeting: Meeting, method: str, linearizations: int) -> None:
    sim = meeting(method, 75, numerics={"linearizations": linearizations})
    check = sim.method.contact.check
    whole = ContactCheck(
        sim.model,
        sim.state,
        sim.method.list,
        node_back=check.node_back,
        lattice_back=check.lattice_back,
        lattice_now=check.lattice_now,
    )
    overlaps = []
    for _ in range(20):
        builds = sim.method.list.build_count
        sim.step()
        if sim.method.list.build_count > builds:
            continue  # it has other pairs by now, and fibers may have been wrapped
        Executor(whole.launches(), "cpu").run(1, lambda: False)
        skipping, looking = check.largest.numpy()[0], whole.largest.numpy()[0]
        assert skipping == looking
        assert (check.crossed.numpy() == whole.crossed.numpy()).all()
        overlaps.append(looking)
    assert len(overlaps) > 5
    assert max(overlaps) > 1e-4
