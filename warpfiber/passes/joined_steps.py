"""Steps whose end runs in one launch with the begin of the next.

A step begins (drift), has its loads, and ends (kick). Run as begin, middle ..., end, where middle
is everything from the loads of one step to the drift of the next, nodes are read and written once
per step instead of twice. After `run` the last step has ended: what is read or saved then is that
of single steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from warpfiber.passes.executor import Call, Executor, Launch, Repeat, StepTimes

Items = Sequence[Launch | Call | Repeat]


class JoinedSteps(Executor):
    """Replays steps cut into `begin`, `middle` and `end`.

    What halts steps is noticed at the latest in the drift of a step, and lets this step end:
    `middle` is not run once `halted`, `end` is.
    """

    def __init__(
        self,
        begin: Items,
        middle: Items,
        end: Items,
        device: str,
        workers: int,
        halted: Callable[[], bool],
    ) -> None:
        super().__init__(middle, device, workers)
        self.batches = False
        self.halted = halted
        self.begin = Executor(begin, device, workers)
        self.end = Executor(end, device, workers)

    def run(self, steps: int, halted: Callable[[], bool]) -> None:
        """Take up to `steps` steps, the last one to its end, looking at `halted` after each."""
        while steps > 0 and not halted():
            self.begin.run(1, _never)
            steps -= 1
            while steps > 0 and not halted():
                super().run(1, _never)
                steps -= 1
            self.end.run(1, _never)

    def time_step(self) -> StepTimes | None:
        """Seconds of every launch of a middle, taken in two steps; None if the first one halted."""
        self.begin.run(1, _never)
        times = None if self.halted() else super().time_step()
        self.end.run(1, _never)
        return times

    def close(self) -> None:
        """End the extra worker threads."""
        for executor in (self.begin, self.end):
            executor.close()
        super().close()


def _never() -> bool:
    return False
