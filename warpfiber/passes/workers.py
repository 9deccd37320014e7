"""Threads that replay graphs side by side on the CPU, and how they wait for one another.

Every worker replays one graph, the same steps over its own part of every launch. Inside the graphs
a barrier stands where one worker reads what another wrote: a native loop over one count per worker,
which gives its core away when that takes long (two workers may share a core). Between graphs locks
decide who may go on; because waking a sleeping thread takes longer than many a step, a thread that
waits first looks at a ticket for some microseconds in a native loop, which leaves the interpreter
to the others. The ticket only says when to look at the lock; it decides nothing.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import warp as wp

LOOKS = 4000  # some 50 us; longer waits sleep, or give the core away
LINE = 16  # counts of workers are this far apart: a cache line each

PAUSE = """
#if defined(__x86_64__) || defined(__i386__)
        __builtin_ia32_pause();
#endif
"""


@wp.func_native(f"""
    const volatile int* ticket = tickets.data + slot;
    const int before = seen.data[slot];
    for (int look = 0; look < looks && *ticket == before; ++look) {{
        {PAUSE}
    }}
""")
def _look(
    slot: wp.int32,
    looks: wp.int32,
    seen: wp.array(dtype=wp.int32),
    tickets: wp.array(dtype=wp.int32),
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
def wait_kernel() -> Any:
    """Kernel (one thread): return when the ticket of a slot differs from the one seen, or soon."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def wait(
        slot: wp.int32,
        looks: wp.int32,
        seen: wp.array(dtype=wp.int32),
        tickets: wp.array(dtype=wp.int32),
    ):
        _look(slot, looks, seen, tickets)

    return wait


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


class Barrier:
    """Where all workers meet; `record` is part of the graph of every one of them."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self.counts = wp.zeros(LINE * workers, dtype=wp.int32, device="cpu")

    def record(self, worker: int) -> None:
        """This worker goes on when all others are here."""
        inputs = [worker, self.workers, LOOKS, wp.uint64(give_way_address()), self.counts]
        wp.launch(meet_kernel(), dim=1, inputs=inputs, device="cpu")


class _Gate:
    """Lets one waiting thread through for every `open`."""

    def __init__(self, slot: int, tickets: Any, seen: Any) -> None:
        self.slot = slot
        self.lock = threading.Lock()
        self.lock.acquire()
        self.tickets, self.seen = tickets.numpy(), seen.numpy()  # views
        with wp.ScopedCapture(device="cpu", force_module_load=False) as capture:
            wp.launch(wait_kernel(), dim=1, inputs=[slot, LOOKS, seen, tickets], device="cpu")
        self.graph = capture.graph

    def open(self) -> None:
        self.tickets[self.slot] += 1
        self.lock.release()

    def wait(self) -> None:
        if self.tickets[self.slot] == self.seen[self.slot]:
            wp.capture_launch(self.graph)
        self.lock.acquire()
        self.seen[self.slot] += 1


class _Crew:
    """Threads that replay a graph when told to; the caller is worker 0."""

    def __init__(self, workers: int) -> None:
        self.users = 0
        self.busy = threading.Lock()
        self.graphs: list[Any] | None = None
        tickets = wp.zeros(2 * LINE * workers, dtype=wp.int32, device="cpu")
        seen = wp.zeros(2 * LINE * workers, dtype=wp.int32, device="cpu")
        self._arrays = tickets, seen
        self.go = [_Gate(2 * LINE * k, tickets, seen) for k in range(1, workers)]
        self.done = [_Gate(2 * LINE * k + LINE, tickets, seen) for k in range(1, workers)]
        self.threads = []
        for worker in range(1, workers):
            thread = threading.Thread(target=self._work, args=(worker,), daemon=True)
            thread.start()
            self.threads.append(thread)

    def _work(self, worker: int) -> None:
        go, done = self.go[worker - 1], self.done[worker - 1]
        while True:
            go.wait()
            if self.graphs is None:
                return
            wp.capture_launch(self.graphs[worker])
            done.open()

    def replay(self, graphs: list[Any]) -> None:
        """The graph of every worker, once."""
        with self.busy:
            self.graphs = graphs
            for gate in self.go:
                gate.open()
            wp.capture_launch(graphs[0])
            for gate in self.done:
                gate.wait()

    def close(self) -> None:
        """End the threads."""
        self.graphs = None
        for gate in self.go:
            gate.open()
        for thread in self.threads:
            thread.join()


# By number of workers. One crew serves all that are open: its threads, still looking at their
# tickets after one list of graphs, begin the next at once, where others would have to be woken.
_crews: dict[int, _Crew] = {}


class Workers:
    """Replays steps, each worker its own graph of them.

    `graphs`: by number of steps, the graph of every worker; one step is among them.
    """

    def __init__(self, graphs: Mapping[int, list[Any]], workers: int) -> None:
        self.graphs = graphs
        self.workers = workers
        if workers not in _crews:
            _crews[workers] = _Crew(workers)
        self.crew = _crews[workers]
        self.crew.users += 1

    def run(self, steps: int, halted: Callable[[], bool]) -> None:
        """Take up to `steps` steps, looking at `halted` before each graph."""
        most = max(self.graphs)
        while steps > 0 and not halted():
            taken = most if steps >= most else 1
            self.crew.replay(self.graphs[taken])
            steps -= taken

    def close(self) -> None:
        """End the threads, unless others use them."""
        self.crew.users -= 1
        if self.crew.users == 0:
            _crews.pop(self.workers).close()
