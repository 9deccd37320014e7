"""Workers that meet inside their graphs: nobody reads what is not yet written."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
import warp as wp

from warpfiber.passes import workers as room
from warpfiber.passes.executor import WORKER_BATCH, Executor, Launch, Repeat

ITEMS = 60
SLOW = 2000  # additions of the items of the first worker, so that the others are ahead


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _shift(
    offset: wp.int32,
    slow: wp.int32,
    source: wp.array(dtype=wp.float64),
    target: wp.array(dtype=wp.float64),
) -> None:
    """target[i] = 2 source[i + 1] + 1, cyclic; the first items take their time."""
    i = wp.tid() + offset
    n = source.shape[0]
    delay = wp.float64(0.0)
    if i < n / 3:
        for k in range(slow):
            delay = wp.sqrt(delay + wp.float64(k))
    x = source[(i + 1) % n]
    if delay < wp.float64(0.0):
        x += delay
    target[i] = wp.float64(2.0) * x + wp.float64(1.0)


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _count_down(going: wp.array(dtype=wp.int32), rounds: wp.array(dtype=wp.int32)) -> None:
    """One round less to go."""
    rounds[0] = rounds[0] + 1
    going[0] = going[0] - 1


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _late(offset: wp.int32, found: wp.array(dtype=wp.float64)) -> None:
    """found[i] += 1, the last item after some ms that no compiler can leave out."""
    i = wp.tid() + offset
    x = wp.float64(0.0)
    if i == found.shape[0] - 1:
        for k in range(3000000):
            x = wp.sqrt(x + wp.float64(k))
    found[i] = found[i] + wp.where(x > wp.float64(1e9), wp.float64(2.0), wp.float64(1.0))


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _begin(going: wp.array(dtype=wp.int32), most: wp.int32) -> None:
    going[0] = most


def _launches(a: Any, b: Any) -> list[Launch]:
    return [
        Launch("there", _shift, ITEMS, [SLOW, a, b], split=True),
        Launch("back", _shift, ITEMS, [SLOW, b, a], split=True),
    ]


def _numbers() -> tuple[Any, Any, np.ndarray]:
    start = np.random.default_rng(5).integers(0, 100, ITEMS).astype(float)
    return wp.array(start, dtype=wp.float64, device="cpu"), wp.zeros(ITEMS, dtype=wp.float64), start


def _expected(x: np.ndarray, shifts: int) -> np.ndarray:
    for _ in range(shifts):
        x = 2.0 * np.roll(x, -1) + 1.0
    return x


@pytest.mark.parametrize("workers", [2, 3, 4])
@pytest.mark.parametrize("steps", [1, WORKER_BATCH + 3])
def test_meet(workers: int, steps: int) -> None:
    """Every item reads its neighbor of the launch before, also where a slower worker has it."""
    a, b, start = _numbers()
    executor = Executor(_launches(a, b), "cpu", workers)
    executor.run(steps, lambda: False)
    executor.close()
    np.testing.assert_array_equal(a.numpy(), _expected(start, 2 * steps))


@pytest.mark.parametrize("workers", [2, 3])
def test_the_caller_waits_for_the_last(workers: int) -> None:
    """A replay is over when the slowest worker is done, also without a barrier at its end."""
    found = wp.zeros(ITEMS, dtype=wp.float64, device="cpu")
    ends = np.linspace(0, ITEMS, workers + 1).astype(int)
    graphs = []
    for first, last in zip(ends[:-1], ends[1:], strict=True):
        with wp.ScopedCapture(device="cpu") as capture:
            wp.launch(_late, dim=last - first, inputs=[first, found], device="cpu")
        graphs.append(capture.graph)
    crew = room.Workers({1: graphs}, workers)
    for steps in range(1, 4):
        crew.run(1, lambda: False)
        np.testing.assert_array_equal(found.numpy(), float(steps))
    crew.close()


def test_loop() -> None:
    """Launches that repeat do so as often for every worker, step after step."""
    a, b, start = _numbers()
    going, rounds = (wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(2))
    count = Launch("count", _count_down, 1, [going, rounds])
    items = [
        Launch("begin", _begin, 1, [going, 5]),
        Repeat("loop", [*_launches(a, b), count], going, 5),
    ]
    executor = Executor(items, "cpu", 3)
    executor.run(4, lambda: False)
    executor.close()
    assert rounds.numpy()[0] == 20
    np.testing.assert_array_equal(a.numpy(), _expected(start, 40))


def test_counts_overflow() -> None:
    """Counts of meetings run over the end of an int32."""
    a, b, start = _numbers()
    executor = Executor(_launches(a, b), "cpu", 2)
    executor._barrier.counts.fill_(2**31 - 3)
    executor.run(6, lambda: False)
    executor.close()
    assert (executor._barrier.counts.numpy()[:: room.LINE] < 0).all()
    np.testing.assert_array_equal(a.numpy(), _expected(start, 12))


def test_looked_after() -> None:
    """`halted` is asked before every graph: a batch of steps, then single ones."""
    a, b, start = _numbers()
    executor = Executor(_launches(a, b), "cpu", 2)
    asked: list[int] = []

    def halted() -> bool:
        asked.append(1)
        return len(asked) > 3

    executor.run(WORKER_BATCH + 5, halted)
    executor.close()
    assert len(asked) == 4
    np.testing.assert_array_equal(a.numpy(), _expected(start, 2 * (WORKER_BATCH + 2)))


def test_core_given_away() -> None:
    """More workers than cores end, as each gives way to those that it waits for."""
    assert room.give_way_address() != 0
    a, b, start = _numbers()
    executor = Executor(_launches(a, b), "cpu", 8)
    executor.run(3, lambda: False)
    executor.close()
    np.testing.assert_array_equal(a.numpy(), _expected(start, 6))


def test_threads_are_shared() -> None:
    """Two that are open have one crew; the second goes on when the first ends, both end it."""
    before = set(threading.enumerate())
    (a, b, start), (c, d, other) = _numbers(), _numbers()
    first, second = (Executor(_launches(*pair), "cpu", 3) for pair in ((a, b), (c, d)))
    crew = set(threading.enumerate()) - before
    assert len(crew) == 2
    for executor in (first, second, first):
        executor.run(2, lambda: False)
    first.close()
    second.run(1, lambda: False)
    assert all(thread.is_alive() for thread in crew)
    second.close()
    assert not any(thread.is_alive() for thread in crew)
    np.testing.assert_array_equal(a.numpy(), _expected(start, 8))
    np.testing.assert_array_equal(c.numpy(), _expected(other, 6))
