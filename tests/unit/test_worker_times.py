"""Times of workers: those who compute are busy, those who do not wait, loops count as often."""

from __future__ import annotations

import time

import numpy as np
import pytest
import warp as wp

from warpfiber.passes.executor import Executor, Launch, Repeat
from warpfiber.passes.worker_times import WorkerTimes, clock_address

LONG = 3_000_000  # square roots, some ms

pytestmark = pytest.mark.skipif(not clock_address(), reason="no clock_gettime")


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _add(
    offset: wp.int32, roots: wp.array(dtype=wp.int32), found: wp.array(dtype=wp.float64)
) -> None:
    """found[i] += 1, after as many square roots as the item asks for."""
    i = wp.tid() + offset
    x = wp.float64(0.0)
    for k in range(roots[i]):
        x = wp.sqrt(x + wp.float64(k))
    found[i] = found[i] + wp.where(x > wp.float64(1e9), wp.float64(2.0), wp.float64(1.0))


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _count(going: wp.array(dtype=wp.int32), most: wp.int32) -> None:
    """`most` rounds, again and again."""
    going[0] = wp.where(going[0] == 0, most, going[0] - 1)


def _array(values: list[int]) -> wp.array:
    return wp.array(values, dtype=wp.int32, device="cpu")


def test_busy_and_waiting() -> None:
    """The first of two has all the work of one launch, the second of the other: steps are taken."""
    found = wp.zeros(2, dtype=wp.float64, device="cpu")
    items = [
        Launch("first", _add, 2, [_array([LONG, 0]), found], split=True),
        Launch("second", _add, 2, [_array([0, LONG]), found], split=True),
    ]
    executor = Executor(items, "cpu", 2)
    times = WorkerTimes(executor)
    begin = time.process_time()
    for _ in range(3):
        times.step()
    spent = time.process_time() - begin
    one, two = times.busy(0), times.busy(1)
    waits = times.waiting(0), times.waiting(1)
    executor.close()
    np.testing.assert_array_equal(found.numpy(), 2.0 * times.steps)
    # ratios of work a million to one, whatever the machine does beside it
    assert one["first"] > 100.0 * one["second"]
    assert two["second"] > 100.0 * two["first"]
    computing = one["first"] + two["second"]
    assert times.steps * computing <= spent  # the clock is that of the processor, in seconds
    # each waits at least as long as the other computes alone
    assert waits[0] >= 0.9 * two["second"]
    assert waits[1] >= 0.9 * one["first"]


def test_loops() -> None:
    """A launch that repeats is added up over its rounds."""
    going, found = _array([0]), wp.zeros(2, dtype=wp.float64, device="cpu")
    work = Launch("work", _add, 2, [_array([LONG // 10] * 2), found], split=True)
    once = Launch("once", _add, 2, [_array([LONG // 10] * 2), found], split=True)
    count = Launch("count", _count, 1, [going, 8])
    executor = Executor([once, count, Repeat("loop", [work, count], going, 8)], "cpu", 2)
    times = WorkerTimes(executor)
    times.step()
    busy = times.busy(1)
    executor.close()
    np.testing.assert_array_equal(found.numpy(), 9.0)
    assert 4.0 * busy["once"] < busy["work"] < 16.0 * busy["once"]
