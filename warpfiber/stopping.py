"""Requests to stop a run: Ctrl-C, SIGTERM, SIGUSR1 and a wall-time limit.

The first request only sets a reason that the loop reads after its step; a second Ctrl-C aborts.
"""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType
from typing import Any

_SIGNALS = [s for s in ("SIGINT", "SIGTERM", "SIGUSR1") if hasattr(signal, s)]


class Stopper:
    """Context in which stop requests are collected instead of killing the process."""

    def __init__(self, max_wall: float | None = None) -> None:
        self._reason = ""
        self._deadline = None if max_wall is None else time.monotonic() + max_wall
        self._old: dict[int, Any] = {}

    def __enter__(self) -> Stopper:
        if threading.current_thread() is threading.main_thread():
            for name in _SIGNALS:
                number = getattr(signal, name)
                self._old[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _take(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self._reason and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._reason = signal.Signals(number).name

    @property
    def reason(self) -> str:
        """Why to stop; empty while nothing asked for it."""
        if not self._reason and self._deadline is not None and time.monotonic() > self._deadline:
            self._reason = "--max-wall"
        return self._reason

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, else 143."""
        return 130 if self._reason == "SIGINT" else 143
