"""What every worker does with its time: computing in each launch, and waiting for the others.

The graph of a step is captured once more with a look at the clocks behind every launch and every
barrier. Computing is the processor time of the thread, so that what else runs on the core does not
count; waiting goes by the time that passes.
Limits: systems with `clock_gettime` (not Windows); each look takes a fraction of 1 us.
"""

from __future__ import annotations

import ctypes
import time
from functools import cache
from typing import Any

import warp as wp

from warpfiber.passes.executor import Executor
from warpfiber.passes.host_arrays import host_view
from warpfiber.passes.workers import graph_handles


# Adds to spent[slot] what has passed since the last look: processor time, time.
@wp.func_native("""
    typedef signed (*clock_t_)(signed, long*);
    const signed which[2] = {processor, passing};
    for (signed c = 0; c < 2; ++c) {
        long now[2];
        ((clock_t_)address)(which[c], now);
        const long long ns = now[0] * 1000000000ll + now[1];
        spent.data[2 * slot + c] += ns - last.data[c];
        last.data[c] = ns;
    }
""")
def _look(
    address: wp.uint64,
    processor: wp.int32,
    passing: wp.int32,
    slot: wp.int32,
    last: wp.array(dtype=wp.int64),
    spent: wp.array(dtype=wp.int64),
): ...


@cache
def look_kernel() -> Any:
    """Kernel (one thread): what has passed since the last look belongs to this slot."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def look(
        address: wp.uint64,
        processor: wp.int32,
        passing: wp.int32,
        slot: wp.int32,
        last: wp.array(dtype=wp.int64),
        spent: wp.array(dtype=wp.int64),
    ):
        _look(address, processor, passing, slot, last, spent)

    return look


def clock_address() -> int:
    """Address of the system's `clock_gettime`; 0 without."""
    if not hasattr(time, "CLOCK_THREAD_CPUTIME_ID"):
        return 0
    return ctypes.cast(ctypes.CDLL(None).clock_gettime, ctypes.c_void_p).value or 0


class WorkerTimes:
    """Takes steps of an Executor of several workers and adds up what each of them does."""

    def __init__(self, executor: Executor) -> None:
        self.executor = executor
        self.steps = 0
        self.names = list(dict.fromkeys(launch.name for launch in executor.launches))
        # the last two slots: barriers, and before the step
        count = len(self.names) + 2
        self.spent = [wp.zeros(2 * count, dtype=wp.int64, device="cpu") for _ in self._workers()]
        wp.load_module(look_kernel().module, device="cpu")
        self.graphs = [self._capture(worker) for worker in self._workers()]
        self.handles = graph_handles(self.graphs)

    def _workers(self) -> range:
        return range(self.executor.workers)

    def _capture(self, worker: int) -> Any:
        last = wp.zeros(2, dtype=wp.int64, device="cpu")
        clocks = [wp.uint64(clock_address()), time.CLOCK_THREAD_CPUTIME_ID, time.CLOCK_MONOTONIC]

        def look(name: str | None) -> None:
            slot = len(self.names) if name is None else self.names.index(name)
            inputs = [*clocks, slot, last, self.spent[worker]]
            wp.launch(look_kernel(), dim=1, inputs=inputs, device="cpu")

        with wp.ScopedCapture(device="cpu", force_module_load=False) as capture:
            begin = [*clocks, len(self.names) + 1, last, self.spent[worker]]
            wp.launch(look_kernel(), dim=1, inputs=begin, device="cpu")
            self.executor.record(self.executor.items, worker, look)
        return capture.graph

    def step(self) -> None:
        """One step by all workers."""
        self.executor.replay(self.handles)
        self.steps += 1

    def busy(self, worker: int) -> dict[str, float]:
        """Seconds per step that a worker computes, by launch."""
        spent = host_view(self.spent[worker])[::2]
        return {name: 1e-9 * float(spent[k]) / self.steps for k, name in enumerate(self.names)}

    def waiting(self, worker: int) -> float:
        """Seconds per step that a worker waits for the others."""
        return 1e-9 * float(host_view(self.spent[worker])[2 * len(self.names) + 1]) / self.steps
