"""Whether steps are worth several workers just now, by the time that they take.

Workers wait for one another in every step: where other programs take cores away, each pause of one
is a pause of all, and a single worker can be several times faster. So a window of steps is now and
then taken by the other kind, and the faster kind goes on. Results are the same to the last bit, so
nothing but time depends on it.
Limits: looks cost a few percent of the first second and about one percent later.
"""

from __future__ import annotations

WINDOW = 0.03  # seconds of steps that are compared
FIRST_LOOK = 16  # windows until the other kind is tried; twice as many whenever it was slower
LAST_LOOK = 128
GAIN = 0.9  # of the time, that the other kind must need less to take over


class WorkerChoice:
    """Kind of the coming steps: `shared` by all workers, or taken by one."""

    def __init__(self) -> None:
        self.shared = True
        self._looking = False
        self._usual = 0.0  # seconds per step of the kind in use
        self._patience = self._left = FIRST_LOOK
        self._begin()

    def _begin(self) -> None:
        self._steps, self._seconds = 0, 0.0

    def note(self, steps: int, seconds: float) -> None:
        """So long took the last steps, lists and all."""
        self._steps += steps
        self._seconds += seconds
        if self._steps == 0 or self._seconds < WINDOW:
            return
        cost = self._seconds / self._steps
        self._begin()
        if self._looking:
            self._judge(cost)
            return
        self._usual = cost
        self._left -= 1
        if self._left == 0:
            self._looking, self.shared = True, not self.shared

    def _judge(self, cost: float) -> None:
        """Stay with the kind that was tried if it is faster than the last window before."""
        self._looking = False
        if cost < GAIN * self._usual:
            self._patience = FIRST_LOOK
        else:
            self.shared = not self.shared
            self._patience = min(2 * self._patience, LAST_LOOK)
        self._left = self._patience
