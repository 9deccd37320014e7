"""Steps whose end runs in one launch with the begin of the next.

A step begins (drift), has its loads, and ends (kick). Run as begin, middle ..., end, where middle
is everything from the loads of one step to the drift of the next, nodes are read and written once
per step instead of twice. After `run` the last step has ended: what is read or saved then is that
of single steps.

What halts steps is noticed at the latest in the drift of a step, and lets this step end: a gate
behind `begin` and `middle` halts all that is queued, `end` opens it unless a fiber tore.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import EXPIRED, HALT, TORN
from warpfiber.passes.executor import Call, Executor, Launch, Repeat, StepTimes
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.worker_choice import WorkerChoice

Items = Sequence[Launch | Call | Repeat]


@cache
def make_gates(module: str = "unique") -> tuple[Any, Any]:
    """Kernels `shut_gate` and `open_gate` (one thread)."""

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def shut_gate(status: wp.array(dtype=wp.int32)):
        if status[wp.static(EXPIRED)] + status[wp.static(TORN)] != 0:
            status[wp.static(HALT)] = 1

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def open_gate(status: wp.array(dtype=wp.int32)):
        if status[wp.static(TORN)] == 0:
            status[wp.static(HALT)] = 0

    return shut_gate, open_gate


class JoinedSteps(Executor):
    """Replays steps cut into `begin`, `middle` and `end`; `status` are the words of the state."""

    def __init__(
        self,
        begin: Items,
        middle: Items,
        end: Items,
        device: str,
        workers: int,
        status: Any,
        choice: WorkerChoice | None = None,
    ) -> None:
        gates = make_gates(kernel_module("gates"))
        shut, opened = (Launch("gate", kernel, 1, [status]) for kernel in gates)
        super().__init__([*middle, shut], device, workers, choice=choice)
        self.status = status
        self.begin = Executor([*begin, shut], device, workers, single=True, choice=choice)
        self.end = Executor([opened, *end], device, workers, single=True, choice=choice)

    def run(self, steps: int, halted: Callable[[], bool]) -> None:
        """Take up to `steps` steps, the last one to its end, looking at `halted` after graphs."""
        if steps <= 0 or halted():
            return
        self.begin.run(1, _never)
        super().run(steps - 1, halted)
        self.end.run(1, _never)

    def time_step(self) -> StepTimes | None:
        """Seconds of every launch of a middle, taken in two steps; None if the first one halted."""
        self.begin.run(1, _never)
        times = None if self.status.numpy()[HALT] else super().time_step()
        self.end.run(1, _never)
        return times

    def close(self) -> None:
        """End the extra worker threads."""
        for executor in (self.begin, self.end):
            executor.close()
        super().close()


def _never() -> bool:
    return False
