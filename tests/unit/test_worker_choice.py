"""One worker or several, by the time that steps take: the faster kind is found and kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import warpfiber as wf
from warpfiber.methods import method as methods
from warpfiber.passes.executor import Executor, Launch
from warpfiber.passes.worker_choice import FIRST_LOOK, LAST_LOOK, WINDOW, WorkerChoice
from warpfiber.scene import scene_from_dict


def _spent(choice: WorkerChoice, seconds: float, cost: dict[bool, float]) -> dict[bool, float]:
    """Seconds of steps of each kind, where a step of a kind takes `cost`."""
    spent = {True: 0.0, False: 0.0}
    while sum(spent.values()) < seconds:
        kind = choice.shared
        choice.note(4, 4 * cost[kind])
        spent[kind] += 4 * cost[kind]
    return spent


@pytest.mark.parametrize("slow", [1.0 / 0.95, 1.2, 2.0])
def test_the_faster_kind_is_kept(slow: float) -> None:
    """Looks take at most one window in 16 at first, and one in 128 later."""
    choice = WorkerChoice()
    cost = {True: 1e-4, False: slow * 1e-4}
    first = _spent(choice, 3 * FIRST_LOOK * WINDOW, cost)
    assert 0.0 < first[False] / first[True] < slow * 1.1 / FIRST_LOOK
    later = _spent(choice, 50 * LAST_LOOK * WINDOW, cost)
    assert 0.0 < later[False] / later[True] < slow * 1.1 / LAST_LOOK


def test_one_worker_takes_over_while_several_are_slow() -> None:
    """Disturbed from the start: one worker from the first look on; several again after it."""
    choice = WorkerChoice()
    disturbed = _spent(choice, 200 * WINDOW, {True: 3e-4, False: 1e-4})
    assert disturbed[True] < (FIRST_LOOK + 10) * WINDOW
    calm = _spent(choice, 400 * WINDOW, {True: 0.6e-4, False: 1e-4})
    assert calm[False] < (LAST_LOOK + 2) * WINDOW
    assert choice.shared


def test_no_step_is_no_window() -> None:
    """Time without a step, as of a list that grows again and again, is no cost of steps."""
    choice = WorkerChoice()
    for _ in range(3 * FIRST_LOOK):
        choice.note(0, WINDOW)
    assert choice.shared


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _count(offset: wp.int32, found: wp.array(dtype=wp.int32)) -> None:
    i = wp.tid() + offset
    found[i] = found[i] + 1


def test_the_executor_takes_the_kind_that_is_chosen() -> None:
    """Several workers, one, and several again; the crew is not asked for steps of one."""
    found = wp.zeros(40, dtype=wp.int32, device="cpu")
    choice = WorkerChoice()
    executor = Executor([Launch("count", _count, 40, [found], split=True)], "cpu", 2, choice=choice)
    pool: Any = executor._pool
    asked = []
    replay = pool.crew.replay
    pool.crew.replay = lambda handles: (asked.append(choice.shared), replay(handles))
    for shared in (True, False, True):
        choice.shared = shared
        executor.run(9, lambda: False)
    pool.crew.replay = replay
    executor.close()
    assert asked and all(asked)
    assert (found.numpy() == 27).all()


def test_runs_choose_unless_they_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Large cells on two cores: chosen by time; the same bits whichever kind takes the steps."""
    monkeypatch.setattr(methods, "WORKER_BREAK_EVEN", 10)
    monkeypatch.setattr(methods.os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    size = 4e-4
    scene = {
        "box": {"size": [size] * 3, "boundary": ["periodic"] * 3},
        "flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0},
        "stage": [{"kind": "flow", "end_strain": 1.0}],
        "fibers": [
            {
                "diameter": 1e-5,
                "aspect_ratio": 11,
                "count": 60,
                "density": 1e3,
                "youngs_modulus": 1e7,
            }
        ],
        "numerics": {"method": "bead_chain", "segments": 5, "device": "cpu"},
    }
    ends = {}
    for kind in (True, False, None):
        simulation = wf.Simulation(scene_from_dict(scene), workers=2 if kind is None else None)
        choice = simulation.method.worker_choice
        assert (choice is None) == (kind is None)
        for _ in range(5):
            if choice is not None:
                choice.shared = kind
            simulation.step(20)
        assert simulation.method.list.build_count > 0
        ends[kind] = simulation.state.node_pos.numpy()
        simulation.close()
    for kind in (True, False):
        np.testing.assert_array_equal(ends[kind], ends[None])
