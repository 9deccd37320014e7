"""What is left of gaps and approaches after a step: each row obeys the law that it was made for.

Tolerance: dual problems are solved to SOLVED lengths here; what a row leaves is apart from its law
by no more than some hundreds of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.meeting_cell import HARD, Meeting, last_rows
from tests.reference.bead_chain import Array
from warpfiber.simulation import Simulation

SOLVED = 1e-9
TIGHT: dict[str, Any] = {"dt": 0.05, "contact_tolerance": SOLVED}


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


def left_over(sim: Simulation, mine: Array) -> Array:
    """What is left of the predicted gap or approach of the rows `mine` of the last step."""
    found = {name: values[mine] for name, values in last_rows(sim).items()}
    shift = sim.method.contact.solves[0][1].node_shift.numpy()  # type: ignore[attr-defined]
    node = sim.model.host["segment_node"]

    def move(segment: Array, s: Array) -> Array:
        at = node[segment]
        moved: Array = (1.0 - s)[:, None] * shift[at] + s[:, None] * shift[at + 1]
        return moved

    approach = move(found["j"], found["t"]) - move(found["i"], found["s"])
    left: Array = found["base"] + (found["normal"] * approach).sum(axis=1)
    return left


def test_lubricated_chains_balance(meeting: Meeting) -> None:
    """Every lubrication row: what is left of the approach is dt/c times its force."""
    sim = meeting("overdamped", 40, numerics=TIGHT, contact=HARD | {"lubrication": "paper"})
    sim.step(5)
    found = last_rows(sim)
    wet = found["compliance"] > 0.0
    assert wet.sum() > 20 and (found["force"][wet] < 0.0).any() and (found["force"][wet] > 0).any()
    left = left_over(sim, wet)
    assert np.abs(left + (found["compliance"] * found["force"])[wet]).max() < 1e3 * SOLVED


@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
def test_exponential_rows_obey_their_law(meeting: Meeting, method: str) -> None:
    """Where there is a force, the gap at the end of the step is the law's: -(2a/G0) ln(f/D0)."""
    strength, decay = 200.0, 50.0
    sim = meeting(
        method,
        75,
        box={"size": [32.0, 32.0, 32.0]},
        numerics=TIGHT | {"contact": "penalty"},
        contact={"law": "exponential", "strength": strength, "decay": decay},
    )
    sim.step(20)
    found = last_rows(sim)
    mine = (found["force"] > 0.0) & (found["j"] >= 0)
    assert mine.sum() > 5
    gap, force = left_over(sim, mine), found["force"][mine]
    expected = np.minimum(1e-3, -2.0 / decay * np.log(force / strength))
    assert np.abs(gap - expected).max() < 1e2 * SOLVED
    apart = left_over(sim, (found["force"] == 0.0) & (found["j"] >= 0))
    assert apart.min() > 1e-3 - 1e2 * SOLVED
