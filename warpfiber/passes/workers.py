"""Threads that replay graphs side by side on the CPU, and how they hand over to one another.

A phase is one graph per worker, or a loop of phases while a word says so. Locks decide who may go
on; because waking a sleeping thread takes longer than many a phase, a thread that waits first looks
at a ticket for some microseconds in a native loop, which leaves the interpreter to the others. The
ticket only says when to look at the lock; it decides nothing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import warp as wp

LOOKS = 4000  # some 50 us; longer waits sleep
LINE = 16  # tickets are this far apart: a cache line each


@wp.func_native("""
    const volatile int* ticket = tickets.data + slot;
    const int before = seen.data[slot];
    for (int look = 0; look < looks && *ticket == before; ++look) {
#if defined(__x86_64__) || defined(__i386__)
        __builtin_ia32_pause();
#endif
    }
""")
def _look(
    slot: wp.int32,
    looks: wp.int32,
    seen: wp.array(dtype=wp.int32),
    tickets: wp.array(dtype=wp.int32),
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


@dataclass
class Loop:
    """Phases that repeat while `going[0]` is not 0."""

    phases: list[Phase]
    going: Any  # int32, view of what the phases write


# The graph of every worker, or None where it has nothing to do.
Phase: TypeAlias = "list[Any] | Loop"


class Workers:
    """Threads that replay their graph of a phase when told to; the caller is worker 0."""

    def __init__(self, phases: list[Phase], workers: int) -> None:
        self.phases = phases
        self.phase: list[Any] | None = None
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
            if self.phase is None:
                return
            graph = self.phase[worker]
            if graph is not None:
                wp.capture_launch(graph)
            done.open()

    def run(self, steps: int, halted: Callable[[], bool]) -> None:
        """Replay all phases up to `steps` times, looking at `halted` before each."""
        for _ in range(steps):
            if halted():
                return
            self._replay(self.phases)

    def _replay(self, phases: list[Phase]) -> None:
        for phase in phases:
            if isinstance(phase, Loop):
                while phase.going[0] != 0:
                    self._replay(phase.phases)
                continue
            if all(graph is None for graph in phase[1:]):
                wp.capture_launch(phase[0])
                continue
            self.phase = phase
            for gate in self.go:
                gate.open()
            if phase[0] is not None:  # fewer items than workers: the last ones have them
                wp.capture_launch(phase[0])
            for gate in self.done:
                gate.wait()

    def close(self) -> None:
        """End the threads."""
        self.phase = None
        for gate in self.go:
            gate.open()
        for thread in self.threads:
            thread.join()
