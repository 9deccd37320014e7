"""Portions that workers take from one another: each is done once, and nobody waits in vain."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpfiber.passes.executor import WORKER_BATCH, Executor, Launch, Repeat
from warpfiber.passes.work_stealing import PORTIONS

SLOW = 20_000  # additions of the first items, so that others take the portions behind them
PATIENCE = 300_000_000  # looks, some seconds, after which a test fails instead of hanging


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _shift(
    offset: wp.int32,
    slow: wp.int32,
    source: wp.array(dtype=wp.float64),
    target: wp.array(dtype=wp.float64),
    times: wp.array(dtype=wp.int32),
) -> None:
    """target[i] = 2 source[i + 1] + 1, cyclic; times[i] counts; the first items take long."""
    i = wp.tid() + offset
    n = source.shape[0]
    delay = wp.float64(0.0)
    if i < n / 8:
        for k in range(slow):
            delay = wp.sqrt(delay + wp.float64(k))
    x = source[(i + 1) % n]
    if delay < wp.float64(0.0):
        x += delay
    target[i] = wp.float64(2.0) * x + wp.float64(1.0)
    times[i] = times[i] + 1


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _count_down(going: wp.array(dtype=wp.int32)) -> None:
    going[0] = going[0] - 1


@wp.func_native(f"""
    __atomic_store_n(done.data + item, 1, __ATOMIC_RELEASE);
    if (item != 0) return;
    int look = 0;
    while (__atomic_load_n(done.data + awaited, __ATOMIC_ACQUIRE) == 0 && look < {PATIENCE}) ++look;
    done.data[0] = look < {PATIENCE} ? 2 : 3;
""")
def _mark(item: wp.int32, awaited: wp.int32, done: wp.array(dtype=wp.int32)): ...


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _await(offset: wp.int32, awaited: wp.int32, done: wp.array(dtype=wp.int32)) -> None:
    """The first item is done once the awaited one is."""
    _mark(wp.tid() + offset, awaited, done)


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("items", [5, 200])
def test_every_item_is_done_once_in_every_step(workers: int, items: int) -> None:
    """Integers in float64: exact. Fewer items than portions, and steps of whole batches."""
    start = np.random.default_rng(items).integers(0, 9, items).astype(np.float64)
    a = wp.array(start, dtype=wp.float64, device="cpu")
    b = wp.zeros(items, dtype=wp.float64, device="cpu")
    times = wp.zeros(items, dtype=wp.int32, device="cpu")
    launches = [
        Launch("there", _shift, items, [SLOW, a, b, times], split=True, stolen=True),
        Launch("back", _shift, items, [0, b, a, times], split=True, stolen=True),
    ]
    executor = Executor(launches, "cpu", workers)
    steps = 2 * WORKER_BATCH + 1
    executor.run(steps, lambda: False)
    executor.close()
    assert (times.numpy() == 2 * steps).all()
    expected = start
    for _ in range(2 * steps):
        expected = 2.0 * np.roll(expected, -1) + 1.0
    np.testing.assert_array_equal(a.numpy(), expected)


def test_portions_of_loops_are_done_in_every_round() -> None:
    """A launch alone in its loop: begun anew behind one barrier."""
    items, rounds = 100, 7
    a, b = (wp.zeros(items, dtype=wp.float64, device="cpu") for _ in range(2))
    times = wp.zeros(items, dtype=wp.int32, device="cpu")
    going = wp.array([rounds], dtype=wp.int32, device="cpu")
    stolen = Launch("round", _shift, items, [100, a, b, times], split=True, stolen=True)
    loop = Repeat("loop", [stolen, Launch("count", _count_down, 1, [going])], going, rounds)
    executor = Executor([loop], "cpu", 2, single=True)
    executor.run(1, lambda: False)
    executor.close()
    assert (times.numpy() == rounds).all()


def test_who_is_done_takes_what_others_have_left() -> None:
    """The first worker stands still in its first item until another has done its last one."""
    items = 4 * PORTIONS
    for steps in range(3):
        done = wp.zeros(items, dtype=wp.int32, device="cpu")
        launch = Launch("await", _await, items, [items // 2 - 1, done], split=True, stolen=True)
        executor = Executor([launch], "cpu", 2, single=True)
        executor.run(1, lambda: False)
        executor.close()
        assert done.numpy()[0] == 2, steps
        assert (done.numpy()[1:] == 1).all()
