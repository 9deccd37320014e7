"""Threads that replay graphs side by side on the CPU, and how they wait for one another.

Every worker replays one graph, the same steps over its own part of every launch. Inside the graphs
a barrier stands where one worker reads what another wrote: a native loop over one count per worker,
which gives its core away when that takes long (two workers may share a core). Between graphs a
worker waits in a native loop too, in which it also replays what is posted to it: coming back to the
interpreter, which one thread has at a time, takes longer than many a step. Who has waited in vain
for long says that it sleeps, and whoever posts to it next wakes it by its lock.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfiber.passes.host_arrays import host_view

LOOKS = 4000  # some 50 us; longer waits give the core away
NAPS = 500  # times that the core is given away before a worker without work sleeps, some 0.2 ms
LINE = 16  # counts of workers are this far apart: a cache line each

PAUSE = """
#if defined(__x86_64__) || defined(__i386__)
        __builtin_ia32_pause();
#endif
"""


WAITING, POSTED, ASLEEP = range(3)  # what a worker does, until it has taken what was posted

CALLS = """
    typedef void (*call_t)();
    typedef bool (*replay_t)(void*);
"""


# A worker: returns to sleep, or because nothing (0) was posted.
@wp.func_native(f"""
    {CALLS}
    int* const post = posts.data + {LINE} * worker;
    while (true) {{
        for (int look = 0; __atomic_load_n(post, __ATOMIC_ACQUIRE) != {POSTED}; ++look) {{
            {PAUSE}
            if (look < looks) continue;
            if (give_way != 0) ((call_t)give_way)();
            int found = {WAITING};
            if ((give_way == 0 || look >= looks + {NAPS}) && __atomic_compare_exchange_n(
                    post, &found, {ASLEEP}, false, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE))
                return;
        }}
        void* const job = (void*)jobs.data[worker];
        __atomic_store_n(post, {WAITING}, __ATOMIC_RELAXED);
        if (job == nullptr) return;
        if (!((replay_t)replay)(job)) failed.data[0] = 1;
        int* const mine = ended.data + {LINE} * worker;
        __atomic_store_n(mine, (int)((unsigned)*mine + 1u), __ATOMIC_RELEASE);
    }}
""")
def _serve(
    worker: wp.int32,
    looks: wp.int32,
    give_way: wp.uint64,
    replay: wp.uint64,
    jobs: wp.array(dtype=wp.uint64),
    posts: wp.array(dtype=wp.int32),
    ended: wp.array(dtype=wp.int32),
    failed: wp.array(dtype=wp.int32),
): ...


# The caller: posts to all (unless they were woken since), replays its own graph, waits for theirs.
@wp.func_native(f"""
    {CALLS}
    const int workers = jobs.shape[0];
    if (woken.data[0] == 0) {{
        ++ended.data[0];
        for (int w = 1; w < workers; ++w) {{
            const int found = __atomic_exchange_n(
                posts.data + {LINE} * w, {POSTED}, __ATOMIC_ACQ_REL);
            woken.data[w] = found == {ASLEEP};
            woken.data[0] |= found == {ASLEEP};
        }}
        if (woken.data[0] != 0) return;
    }}
    woken.data[0] = 0;
    if (jobs.data[0] == 0) return;
    if (!((replay_t)replay)((void*)jobs.data[0])) failed.data[0] = 1;
    for (int w = 1; w < workers; ++w)
        for (int look = 0; __atomic_load_n(ended.data + {LINE} * w, __ATOMIC_ACQUIRE)
                != ended.data[0]; ++look) {{
            {PAUSE}
            if (look >= looks) {{
                look = looks;
                if (give_way != 0) ((call_t)give_way)();
            }}
        }}
""")
def _lead(
    looks: wp.int32,
    give_way: wp.uint64,
    replay: wp.uint64,
    jobs: wp.array(dtype=wp.uint64),
    posts: wp.array(dtype=wp.int32),
    ended: wp.array(dtype=wp.int32),
    woken: wp.array(dtype=wp.int32),
    failed: wp.array(dtype=wp.int32),
): ...


# Counts never go back; their difference tells who is behind, also once they overflow.
@wp.func_native(f"""
    typedef void (*call_t)();
    int* const arrived = counts.data;
    const unsigned mine = (unsigned)arrived[{LINE} * worker] + 1u;
    __atomic_store_n(arrived + {LINE} * worker, (int)mine, __ATOMIC_RELEASE);
    for (int other = 0; other < workers; ++other)
        for (int look = 0;; ++look) {{
            const int there = __atomic_load_n(arrived + {LINE} * other, __ATOMIC_ACQUIRE);
            if ((int)((unsigned)there - mine) >= 0) break;
            {PAUSE}
            if (look >= looks) {{
                look = looks;
                if (give_way != 0) ((call_t)give_way)();
            }}
        }}
""")
def _meet(
    worker: wp.int32,
    workers: wp.int32,
    looks: wp.int32,
    give_way: wp.uint64,
    counts: wp.array(dtype=wp.int32),
): ...


@cache
def crew_kernels() -> tuple[Any, Any]:
    """Kernels `serve` of the workers and `lead` of their caller (one thread each)."""

    @wp.kernel(module="warpfiber_crew", enable_backward=False, grid_stride=False)
    def serve(
        worker: wp.int32,
        looks: wp.int32,
        give_way: wp.uint64,
        replay: wp.uint64,
        jobs: wp.array(dtype=wp.uint64),
        posts: wp.array(dtype=wp.int32),
        ended: wp.array(dtype=wp.int32),
        failed: wp.array(dtype=wp.int32),
    ):
        _serve(worker, looks, give_way, replay, jobs, posts, ended, failed)

    @wp.kernel(module="warpfiber_crew", enable_backward=False, grid_stride=False)
    def lead(
        looks: wp.int32,
        give_way: wp.uint64,
        replay: wp.uint64,
        jobs: wp.array(dtype=wp.uint64),
        posts: wp.array(dtype=wp.int32),
        ended: wp.array(dtype=wp.int32),
        woken: wp.array(dtype=wp.int32),
        failed: wp.array(dtype=wp.int32),
    ):
        _lead(looks, give_way, replay, jobs, posts, ended, woken, failed)

    return serve, lead


@cache
def meet_kernel() -> Any:
    """Kernel (one thread): return when every worker has come here as often as this one."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def meet(
        worker: wp.int32,
        workers: wp.int32,
        looks: wp.int32,
        give_way: wp.uint64,
        counts: wp.array(dtype=wp.int32),
    ):
        _meet(worker, workers, looks, give_way, counts)

    return meet


@cache
def give_way_address() -> int:
    """Address of the system's function that lets another thread have the core; 0 without."""
    library = getattr(ctypes, "windll").kernel32 if os.name == "nt" else ctypes.CDLL(None)  # noqa: B009
    function = getattr(library, "SwitchToThread" if os.name == "nt" else "sched_yield", None)
    return ctypes.cast(function, ctypes.c_void_p).value or 0 if function is not None else 0


def replay_address() -> int:
    """Address of Warp's function that replays a captured graph of the CPU."""
    function = wp._src.context.runtime.core.wp_apic_cpu_replay_state
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def graph_handles(graphs: Sequence[Any]) -> np.ndarray:
    """What that function takes; valid as long as the graphs are kept."""
    return np.asarray([_number(graph.apic_state) for graph in graphs], dtype=np.uint64)


def _number(handle: Any) -> int:
    return int(getattr(handle, "value", handle))


class Barrier:
    """Where all workers meet; `record` is part of the graph of every one of them."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self.counts = wp.zeros(LINE * workers, dtype=wp.int32, device="cpu")

    def record(self, worker: int) -> None:
        """This worker goes on when all others are here."""
        inputs = [worker, self.workers, LOOKS, wp.uint64(give_way_address()), self.counts]
        wp.launch(meet_kernel(), dim=1, inputs=inputs, device="cpu")


class _Crew:
    """Threads that replay a graph when told to; the caller is worker 0."""

    def __init__(self, workers: int) -> None:
        self.users = 0
        self.busy = threading.Lock()
        self.ending = False
        serve, lead = crew_kernels()
        posts, ended = (wp.zeros(LINE * workers, dtype=wp.int32, device="cpu") for _ in range(2))
        woken, failed = (wp.zeros(workers, dtype=wp.int32, device="cpu") for _ in range(2))
        jobs = wp.zeros(workers, dtype=wp.uint64, device="cpu")
        calls = [LOOKS, wp.uint64(give_way_address()), wp.uint64(replay_address()), jobs, posts]
        self.jobs, self.woken, self.failed = (host_view(x) for x in (jobs, woken, failed))
        self.lead = _captured(lead, [*calls, ended, woken, failed])
        self.serve = [_captured(serve, [k, *calls, ended, failed]) for k in range(1, workers)]
        self.locks = [threading.Lock() for _ in range(1, workers)]
        self.threads = []
        for worker in range(1, workers):
            self.locks[worker - 1].acquire()
            thread = threading.Thread(target=self._work, args=(worker,), daemon=True)
            thread.start()
            self.threads.append(thread)

    def _work(self, worker: int) -> None:
        while True:
            wp.capture_launch(self.serve[worker - 1])
            if self.ending:
                return
            self.locks[worker - 1].acquire()  # asleep

    def replay(self, handles: np.ndarray) -> None:
        """The graph of every worker, once."""
        with self.busy:
            self._post(handles)
            if self.failed[0]:
                self.failed[0] = 0
                raise RuntimeError("a captured step could not be replayed")

    def _post(self, handles: np.ndarray) -> None:
        self.jobs[:] = handles
        wp.capture_launch(self.lead)
        if self.woken[0]:
            for lock, asleep in zip(self.locks, self.woken[1:], strict=True):
                if asleep:
                    lock.release()
            wp.capture_launch(self.lead)

    def close(self) -> None:
        """End the threads."""
        with self.busy:
            self.ending = True
            self._post(np.zeros(len(self.jobs), dtype=np.uint64))
        for thread in self.threads:
            thread.join()


def _captured(kernel: Any, inputs: list[Any]) -> Any:
    with wp.ScopedCapture(device="cpu", force_module_load=False) as capture:
        wp.launch(kernel, dim=1, inputs=inputs, device="cpu")
    return capture.graph


# By number of workers. One crew serves all that are open: its threads, still looking for what is
# posted after one list of graphs, begin the next at once, where others would have to be woken.
_crews: dict[int, _Crew] = {}


class Workers:
    """Replays steps, each worker its own graph of them.

    `graphs`: by number of steps, the graph of every worker; one step is among them.
    """

    def __init__(self, graphs: Mapping[int, list[Any]], workers: int) -> None:
        self.graphs = graphs  # kept alive
        self.handles = {steps: graph_handles(each) for steps, each in graphs.items()}
        self.workers = workers
        if workers not in _crews:
            _crews[workers] = _Crew(workers)
        self.crew = _crews[workers]
        self.crew.users += 1

    def run(self, steps: int, halted: Callable[[], bool]) -> None:
        """Take up to `steps` steps, looking at `halted` before each graph."""
        most = max(self.handles)
        while steps > 0 and not halted():
            taken = most if steps >= most else 1
            self.crew.replay(self.handles[taken])
            steps -= taken

    def close(self) -> None:
        """End the threads, unless others use them."""
        self.crew.users -= 1
        if self.crew.users == 0:
            _crews.pop(self.workers).close()
