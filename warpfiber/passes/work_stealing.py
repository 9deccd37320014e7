"""A launch whose portions workers take from one another, on the CPU.

Cores that are shared with others are not equally fast: with equal halves the faster one would wait.
Every worker begins with the portions that are its own, in order, so that it mostly finds in its
cache what it wrote the step before; once they are done it takes those of others from their ends.
Which worker does a portion makes no difference to the results. Every portion is a graph of one
launch; replaying it takes some 0.15 us.

What is left of a worker's portions is one number: the first and the end, claimed together. A worker
sets it when it begins, behind a barrier, and then nothing was left of it: who looks too early finds
nothing to take.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from warpfiber.passes.host_arrays import host_view
from warpfiber.passes.workers import LINE, graph_handles, replay_address

PORTIONS = 12  # of every worker: the last to end is late by half of one on average


@wp.func_native(f"""
    typedef bool (*replay_t)(void*);
    const int workers = left.shape[0] / {LINE}, portions = jobs.shape[0];
    auto span = [](int begin, int end) {{ return (long long)end << 32 | begin; }};
    __atomic_store_n(left.data + {LINE} * worker,
        span(portions * worker / workers, portions * (worker + 1) / workers), __ATOMIC_RELEASE);
    for (int turn = 0; turn < workers; ++turn) {{
        const int owner = (worker + turn) % workers;
        auto* const here = left.data + {LINE} * owner;
        auto seen = __atomic_load_n(here, __ATOMIC_ACQUIRE);
        while (true) {{
            const int begin = (int)seen, end = (int)(seen >> 32);
            if (begin >= end) break;
            const bool first = owner == worker;
            if (!__atomic_compare_exchange_n(here, &seen,
                    first ? span(begin + 1, end) : span(begin, end - 1), false,
                    __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE))
                continue;
            if (!((replay_t)replay)((void*)jobs.data[first ? begin : end - 1])) failed.data[0] = 1;
            seen = __atomic_load_n(here, __ATOMIC_ACQUIRE);
        }}
    }}
""")
def _take_portions(
    worker: wp.int32,
    replay: wp.uint64,
    jobs: wp.array(dtype=wp.uint64),
    left: wp.array(dtype=wp.int64),
    failed: wp.array(dtype=wp.int32),
): ...


@cache
def stealing_kernel() -> Any:
    """Kernel (one thread): own portions, then what others have left."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def take_portions(
        worker: wp.int32,
        replay: wp.uint64,
        jobs: wp.array(dtype=wp.uint64),
        left: wp.array(dtype=wp.int64),
        failed: wp.array(dtype=wp.int32),
    ):
        _take_portions(worker, replay, jobs, left, failed)

    return take_portions


class StolenLaunch:
    """Portions of a launch over `dim` items, and who may still take which.

    `run(begin, count)` launches the items from `begin` on; called while this is made, before the
    graphs that `record` is part of are captured.
    """

    def __init__(self, dim: int, workers: int, run: Callable[[int, int], None]) -> None:
        portions = min(dim, PORTIONS * workers)
        self.graphs = []  # kept alive
        for k in range(portions):
            begin, end = dim * k // portions, dim * (k + 1) // portions
            with wp.ScopedCapture(device="cpu", force_module_load=False) as capture:
                run(begin, end - begin)
            self.graphs.append(capture.graph)
        self.jobs = wp.array(graph_handles(self.graphs), dtype=wp.uint64, device="cpu")
        self.left = wp.zeros(LINE * workers, dtype=wp.int64, device="cpu")
        self._failed = wp.zeros(1, dtype=wp.int32, device="cpu")
        self.failed = host_view(self._failed)

    def record(self, worker: int) -> None:
        """This worker's share, in the graph that is being captured."""
        inputs = [worker, wp.uint64(replay_address()), self.jobs, self.left, self._failed]
        wp.launch(stealing_kernel(), dim=1, inputs=inputs, device="cpu")
