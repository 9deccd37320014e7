"""How launches run: captured once, replayed many times, by one worker or several.

A step is a list of phases, a phase one launch over an index range. With one worker a whole step
(and a batch of steps) is one graph, on CPU and CUDA alike. With more workers (CPU only) every
worker owns one graph per phase over its part of the range, and the phases are handed over by locks:
Warp itself runs kernels serially on the CPU. No kernel writes where another index reads, so the
result is the same to the last bit for any number of workers.

Limits: nothing may be launched from another thread during a capture (Warp's recording is global).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from warpfiber.passes.workers import Workers, wait_kernel

BATCH = 16  # steps per graph where looking after every step would cost more than it saves
BATCH_BELOW = 300  # items per step on the CPU; CUDA always batches


def load_kernels(kernels: Iterable[Any], device: str) -> None:
    """Compile or load kernels, several at a time, for the block size of `wp.launch`."""
    modules = list(dict.fromkeys(kernel.module for kernel in kernels))
    target = wp.get_device(device)
    if modules:
        wp.force_load(target, modules=modules, block_dim=1 if target.is_cpu else 256)


@dataclass
class Launch:
    """One kernel over `dim` items; `split` kernels take the offset of their first item first.

    One that `follows` needs from the launch before only what the same worker made of it, so no
    worker waits in between.
    """

    name: str
    kernel: Any
    dim: int
    inputs: list[Any]
    split: bool = False
    follows: bool = False

    def part(self, worker: int, workers: int) -> tuple[int, int]:
        """First item and number of items of one worker."""
        if not self.split:
            return 0, self.dim if worker == 0 else 0
        begin = self.dim * worker // workers
        return begin, self.dim * (worker + 1) // workers - begin

    def run(self, device: str, worker: int = 0, workers: int = 1) -> None:
        """Launch this worker's part."""
        begin, count = self.part(worker, workers)
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


class Executor:
    """Replays the steps made of `launches`."""

    def __init__(self, launches: Sequence[Launch | Call], device: str, workers: int = 1) -> None:
        self.launches = [launch for launch in launches if launch.dim > 0]
        self.device = device
        self.workers = max(1, workers)
        # nothing may be compiled inside a capture
        load_kernels((x.kernel for x in self.launches if isinstance(x, Launch)), device)
        items = sum(launch.dim for launch in self.launches)
        self.batches = items < BATCH_BELOW or not device.startswith("cpu")
        self._pool: Workers | None = None
        if self.workers > 1:
            groups: list[list[Launch | Call]] = []
            for launch in self.launches:
                if launch.follows and groups:
                    groups[-1].append(launch)
                else:
                    groups.append([launch])
            phases = [self._capture_phase(group) for group in groups]
            load_kernels([wait_kernel()], device)
            self._pool = Workers(phases, self.workers)
        else:
            self._single = self._capture_steps(1)
            self._batch: Any = None

    def _capture_steps(self, steps: int) -> Any:
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for _ in range(steps):
                for launch in self.launches:
                    launch.run(self.device)
        return capture.graph

    def _capture_phase(self, group: list[Launch | Call]) -> list[Any]:
        graphs: list[Any] = []
        for worker in range(self.workers):
            if all(launch.part(worker, self.workers)[1] == 0 for launch in group):
                graphs.append(None)
                continue
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                for launch in group:
                    launch.run(self.device, worker, self.workers)
            graphs.append(capture.graph)
        return graphs

    def run(self, steps: int, halted: Callable[[], bool]) -> None:
        """Replay up to `steps` steps, looking at `halted` after every graph."""
        if self._pool is not None:
            self._pool.run(steps, halted)
            return
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

    def time_launches(self, steps: int, halted: Callable[[], bool]) -> dict[str, float]:
        """Seconds per step of every launch, over up to `steps` real steps by one worker.

        The cost of replaying an empty graph is subtracted: it is not paid inside a whole step.
        """
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            pass
        graphs = [("", capture.graph)]
        for launch in self.launches:
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                launch.run(self.device)
            graphs.append((launch.name, capture.graph))
        best: dict[str, list[float]] = {name: [] for name, _ in graphs}
        for _ in range(steps):
            if halted():
                break
            for name, graph in graphs:
                wp.synchronize_device(self.device)
                begin = time.perf_counter()
                wp.capture_launch(graph)
                wp.synchronize_device(self.device)
                best[name].append(time.perf_counter() - begin)
        median = {name: sorted(t)[len(t) // 2] if t else 0.0 for name, t in best.items()}
        idle = median.pop("")
        return {name: max(0.0, value - idle) for name, value in median.items()}

    def close(self) -> None:
        """End the extra worker threads."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None
