"""How launches run: captured once, replayed many times, by one worker or several.

A step is a list of launches, each over an index range, some of which repeat until they say that
they are done. A whole step (and a batch of steps) is one graph, on CPU and CUDA alike. Warp itself
runs kernels serially on the CPU: with more workers (CPU only) each has a graph of its own, over its
part of every range or over portions that they take from one another, and they meet after every
launch. No kernel writes where another index reads, so the result is the same to the last bit for
any number of workers.

Limits: nothing may be launched from another thread during a capture (Warp's recording is global).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import warp as wp

from warpfiber.passes.kernel_module import load_modules
from warpfiber.passes.work_stealing import StolenLaunch, stealing_kernel
from warpfiber.passes.worker_choice import WorkerChoice
from warpfiber.passes.workers import Barrier, Workers, crew_kernels, meet_kernel

COMPILERS = min(os.cpu_count() or 1, 4)  # at a time; each takes some hundred MB
BATCH = 16  # steps per graph where looking after every step would cost more than it saves
BATCH_BELOW = 300  # items per step on the CPU; CUDA always batches
WORKER_BATCH = 8  # steps between two looks of several workers: starting them takes 0.05 ms


def load_kernels(kernels: Iterable[Any], device: str) -> None:
    """Compile or load kernels, several at a time, for the block size of `wp.launch`."""
    modules = list(dict.fromkeys(kernel.module for kernel in kernels))
    target = wp.get_device(device)
    if modules and target.is_cpu:
        load_modules(modules, target, COMPILERS)
    elif modules:
        wp.force_load(target, modules=modules, block_dim=256, max_workers=COMPILERS)


@dataclass
class Launch:
    """One kernel over `dim` items; `split` kernels take the offset of their first item first.

    One that `follows` needs from the launch before only what the same worker made of it, so no
    worker waits in between. `stolen`: long enough that workers take portions from one another; it
    neither follows nor is followed.
    """

    name: str
    kernel: Any
    dim: int
    inputs: list[Any]
    split: bool = False
    follows: bool = False
    stolen: bool = False

    def part(self, worker: int, workers: int) -> tuple[int, int]:
        """First item and number of items of one worker."""
        if not self.split:
            return 0, self.dim if worker == 0 else 0
        begin = self.dim * worker // workers
        return begin, self.dim * (worker + 1) // workers - begin

    def run(self, device: str, worker: int = 0, workers: int = 1) -> None:
        """Launch this worker's part."""
        self.run_items(device, *self.part(worker, workers))

    def run_items(self, device: str, begin: int, count: int) -> None:
        """Launch `count` items from `begin` on."""
        if count == 0:
            return
        inputs = [begin, *self.inputs] if self.split else self.inputs
        wp.launch(self.kernel, dim=count, inputs=inputs, device=device)


@dataclass
class Call:
    """What Warp records like a launch but is none: a sort, a scan. The first worker runs it."""

    name: str
    function: Callable[[], None]
    dim: int = 1
    follows: bool = False

    def part(self, worker: int, workers: int) -> tuple[int, int]:
        """First item and number of items of one worker."""
        return 0, self.dim if worker == 0 else 0

    def run(self, device: str, worker: int = 0, workers: int = 1) -> None:
        """Call it if this worker does."""
        if worker == 0:
            self.function()


@dataclass
class Repeat:
    """Launches that repeat while `going[0]` (int32, on the device) is not 0.

    They clear it after `most` repetitions at the latest, and do nothing once it is 0.
    """

    name: str
    launches: list[Launch | Call]
    going: Any
    most: int

    def run(self, device: str) -> None:
        """Record the loop: inside the graph where the device can, else as often as it may run."""

        def body() -> None:
            for launch in flat([self]):
                launch.run(device)

        if device.startswith("cpu") or wp.is_conditional_graph_supported():
            wp.capture_while(self.going, body)
            return
        for _ in range(self.most):
            body()


def flat(items: Iterable[Launch | Call | Repeat]) -> list[Launch | Call]:
    """All launches with items, those that repeat among them."""
    found: list[Launch | Call] = []
    for item in items:
        found += item.launches if isinstance(item, Repeat) else [item]
    return [launch for launch in found if launch.dim > 0]


@dataclass
class StepTimes:
    """Seconds of an empty graph, and of each launch of one step with how often it ran."""

    idle: float
    seconds: dict[str, float]
    replays: dict[str, int]


def median_times(steps: Sequence[StepTimes]) -> dict[str, float]:
    """Median seconds of every launch of the steps.

    The cost of replaying an empty graph is subtracted: it is not paid inside a whole step.
    """

    def median(values: list[float]) -> float:
        return sorted(values)[len(values) // 2]

    if not steps:
        return {}
    idle = median([step.idle for step in steps])
    return {
        name: max(0.0, median([step.seconds[name] - idle * step.replays[name] for step in steps]))
        for name in steps[0].seconds
    }


class Executor:
    """Replays the steps made of `items`; `launches` are all of them, repeated or not.

    `single`: they are replayed once at a time, so no batch of steps is captured; `choice`: asked
    before steps whether all workers take them or the first one alone, without it all do.
    """

    def __init__(
        self,
        items: Sequence[Launch | Call | Repeat],
        device: str,
        workers: int = 1,
        *,
        single: bool = False,
        choice: WorkerChoice | None = None,
    ) -> None:
        self.choice = choice
        self.items = [item for item in items if isinstance(item, Repeat) or item.dim > 0]
        self.launches = flat(items)
        self.device = device
        self.workers = max(1, workers)
        # nothing may be compiled inside a capture
        load_kernels((x.kernel for x in self.launches if isinstance(x, Launch)), device)
        work = sum(launch.dim for launch in self.launches)
        self.batches = work < BATCH_BELOW or not device.startswith("cpu")
        self._pool: Workers | None = None
        self._single: Any = None
        self._batch: Any = None
        self._stolen: dict[int, StolenLaunch] = {}
        self._apart: list[tuple[list[Any], Launch | Call | Repeat]] = []
        if self.workers > 1:
            stolen = [x for x in self.launches if isinstance(x, Launch) and x.stolen]
            needed = [*crew_kernels(), meet_kernel(), *([stealing_kernel()] if stolen else [])]
            load_kernels(needed, device)
            self._barrier = Barrier(self.workers)
            self._stolen = {id(launch): self._portions(launch) for launch in stolen}
            # all before the threads start: nothing may be launched during a capture
            sizes = [1] if single else [1, WORKER_BATCH]
            graphs = {
                steps: [self._capture_worker(steps, k) for k in range(self.workers)]
                for steps in sizes
            }
            self._pool = Workers(graphs, self.workers)
        else:
            self._single = self._capture_steps(1)

    def _portions(self, launch: Launch) -> StolenLaunch:
        return StolenLaunch(launch.dim, self.workers, partial(launch.run_items, self.device))

    def _capture_steps(self, steps: int) -> Any:
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for _ in range(steps):
                for item in self.items:
                    item.run(self.device)
        return capture.graph

    def _capture_worker(self, steps: int, worker: int) -> Any:
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for _ in range(steps):
                self.record(self.items, worker)
        return capture.graph

    def record(
        self,
        items: Sequence[Launch | Call | Repeat],
        worker: int,
        look: Callable[[str | None], None] | None = None,
    ) -> None:
        """This worker's part of the items, and where it waits for the others.

        `look` records what looks at clocks behind a launch of this name, or a barrier (None).
        """
        for k, item in enumerate(items):
            if isinstance(item, Repeat):
                self._record_loop(item, worker, look)
                continue
            if id(item) in self._stolen:
                self._stolen[id(item)].record(worker)
            else:
                item.run(self.device, worker, self.workers)
            if look is not None:
                look(item.name)
            behind = items[k + 1] if k + 1 < len(items) else None
            if not (isinstance(behind, Launch | Call) and behind.follows):
                self._meet(worker, look)

    def _record_loop(
        self, loop: Repeat, worker: int, look: Callable[[str | None], None] | None
    ) -> None:
        """All workers must have looked whether it goes on before any of them may change that."""

        def body() -> None:
            self._meet(worker, look)
            self.record(flat([loop]), worker, look)

        wp.capture_while(loop.going, body)
        self._meet(worker, look)

    def _meet(self, worker: int, look: Callable[[str | None], None] | None) -> None:
        self._barrier.record(worker)
        if look is not None:
            look(None)

    def replay(self, handles: Any) -> None:
        """Other graphs of the workers, once."""
        assert self._pool is not None
        self._pool.crew.replay(handles)

    def run(self, steps: int, halted: Callable[[], bool]) -> None:
        """Replay up to `steps` steps, looking at `halted` after every graph."""
        if self._pool is not None and (self.choice is None or self.choice.shared):
            self._pool.run(steps, halted)
            if any(stolen.failed[0] for stolen in self._stolen.values()):
                raise RuntimeError("a captured portion of a step could not be replayed")
            return
        if self._single is None:
            self._single = self._capture_steps(1)
        batch = BATCH if self.batches else 1
        while steps > 0 and not halted():
            if steps < batch or batch == 1:
                wp.capture_launch(self._single)
                steps -= 1
                continue
            if self._batch is None:
                self._batch = self._capture_steps(batch)
            wp.capture_launch(self._batch)
            steps -= batch

    def time_step(self) -> StepTimes | None:
        """Seconds of every launch over one real step by one worker; None if none could be timed."""
        if not self._apart:
            self._idle = self._capture_apart([])
            self._apart = [(self._capture_apart(flat([item])), item) for item in self.items]
        times = StepTimes(self._time(self._idle)[0], {}, {})
        for graphs, item in self._apart:
            rounds = [self._time(graphs)] if isinstance(item, Launch | Call) else []
            while isinstance(item, Repeat) and item.going.numpy()[0] != 0:
                rounds.append(self._time(graphs))
            for k, launch in enumerate(flat([item])):
                before = times.seconds.get(launch.name, 0.0), times.replays.get(launch.name, 0)
                times.seconds[launch.name] = before[0] + sum(found[k] for found in rounds)
                times.replays[launch.name] = before[1] + len(rounds)
        return times

    def _capture_apart(self, launches: Sequence[Launch | Call]) -> list[Any]:
        """A graph of each launch; an empty one if there are none."""
        graphs = []
        for launch in launches or [None]:
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                if launch is not None:
                    launch.run(self.device)
            graphs.append(capture.graph)
        return graphs

    def _time(self, graphs: Iterable[Any]) -> list[float]:
        """Seconds of each graph."""
        times = []
        for graph in graphs:
            wp.synchronize_device(self.device)
            begin = time.perf_counter()
            wp.capture_launch(graph)
            wp.synchronize_device(self.device)
            times.append(time.perf_counter() - begin)
        return times

    def close(self) -> None:
        """End the extra worker threads."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None
