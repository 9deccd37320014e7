"""Where a run stands: a bar on a terminal (with tqdm), else a line every ten seconds."""

from __future__ import annotations

import sys
import time
from typing import Any

LINE_EVERY = 10.0  # s


def make_progress(quiet: bool) -> Any:
    """A progress display, or None with `--quiet`."""
    if quiet:
        return None
    if sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ImportError:
            return Lines()
        return Bar(tqdm)
    return Lines()


def _goal(job: Any) -> tuple[str, float, float]:
    """Name, present value and end of what the stages are measured by, over the whole run."""
    stages = job.stages
    ends = [stage.end_strain for stage in stages]
    if job.scene.flow is not None and all(end is not None for end in ends):
        return "strain", job.simulation.strain, float(sum(ends))
    times = [stage.end_time or stage.time_limit or 0.0 for stage in stages]
    return "time", job.simulation.time - job.simulation.origin[1], float(sum(times))


def _values(job: Any) -> dict[str, str]:
    row = job.record.last_row
    shown = {}
    for key, label in (("a11", "A_xx"), ("overlap_max", "overlap")):
        if key in row:
            shown[label] = f"{row[key]:.3f}"
    return shown


class Bar:
    """tqdm bar: strain, steps per second, time left, A_xx, largest overlap in radii."""

    def __init__(self, tqdm: Any) -> None:
        self._tqdm, self._bar = tqdm, None
        self._steps, self._clock = 0, time.monotonic()

    def update(self, job: Any) -> None:
        """Show the present state of `job`."""
        name, value, end = _goal(job)
        if self._bar is None:
            layout = "{l_bar}{bar}| {n:.2f}/{total:.2f} [{elapsed}<{remaining}{postfix}]"
            self._bar = self._tqdm(
                total=end, initial=value, desc=name, bar_format=layout, file=sys.stderr
            )
            self._steps, self._clock = job.simulation.step_count, time.monotonic()
            return
        steps, now = job.simulation.step_count, time.monotonic()
        rate = (steps - self._steps) / max(now - self._clock, 1e-9)
        self._bar.set_postfix({"steps/s": f"{rate:.0f}"} | _values(job), refresh=False)
        self._bar.update(min(value, end) - self._bar.n)

    def close(self) -> None:
        """Leave the finished bar on the screen."""
        if self._bar is not None:
            self._bar.close()


class Lines:
    """One line every ten seconds, for logs and pipes."""

    def __init__(self) -> None:
        self._begin = self._last = time.monotonic()
        self._from: float | None = None

    def update(self, job: Any) -> None:
        """Print the present state of `job` if the last line is old enough."""
        name, value, end = _goal(job)
        now = time.monotonic()
        if self._from is None:
            self._from, self._begin = value, now
        if now - self._last < LINE_EVERY:
            return
        self._last = now
        done = value - self._from
        left = (now - self._begin) * max(end - value, 0.0) / done if done > 0.0 else None
        words = [f"{name} {value:.3f} of {end:g}", f"{job.summary.step_rate:.0f} steps/s"]
        words += [] if left is None else [f"{left:.0f} s left"]
        words += [f"{key} {shown}" for key, shown in _values(job).items()]
        print(", ".join(words), file=sys.stderr)

    def close(self) -> None:
        """Nothing to leave behind."""
