"""A list that will not last the next step is built before it, so that few steps are repeated."""

from __future__ import annotations

import pytest

from tests.meeting_cell import METHODS, meeting_scene
from warpfiber.passes.list_bound import FORESEEN
from warpfiber.simulation import Simulation

# Of all lists; how far fibers bent by others spring without them changes from step to step.
LEAST = {"rigid_rod": 0.6, "overdamped": 0.4}


@pytest.mark.parametrize("method", METHODS)
def test_most_lists_are_foreseen(method: str) -> None:
    sim = Simulation(meeting_scene(method, 75), workers=1)
    contact = sim.method.contact  # type: ignore[attr-defined]
    settle, foreseen = contact.settle, []

    def looked_at(step: int) -> bool:
        mark, builds = contact.check.share_back.numpy()[0], contact.search.list.build_count
        new: bool = settle(step)
        if contact.search.list.build_count > builds:  # else it was room for rows
            foreseen.append(bool(mark == FORESEEN))
            assert contact.check.share_back.numpy()[0] == 0.0
        return new

    contact.settle = looked_at
    for _ in range(80):
        sim.step()
        assert not sim.method._halted()
    assert len(foreseen) > 10
    assert sum(foreseen) > LEAST[method] * len(foreseen)
    assert contact.search.list.build_count >= len(foreseen)
    sim.close()
