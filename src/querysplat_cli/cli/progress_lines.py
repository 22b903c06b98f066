"""Progress where there is no terminal: a line when a stage begins, and a line now and then while it works."""

import threading
from collections.abc import Callable
from time import perf_counter

QUIET_SECONDS = 10.0
"""After so long without a line, one says what the command is doing."""
LEAST_FRACTION = 0.02
"""Of a stage, before the time left is worth saying."""


def time_left(elapsed: float, fraction: float) -> str:
    """The time that is left of a stage, in words; nothing where it cannot be told yet, or there is none."""
    if not LEAST_FRACTION <= fraction < 1:
        return ""
    seconds = elapsed / fraction - elapsed
    return f"{seconds:.0f} s left" if seconds < 100 else f"{seconds / 60:.0f} min left"


class ProgressLines:
    """Prints the progress of stages by `say`. A thread of its own speaks up when a stage reports nothing."""

    def __init__(self, say: Callable[[str], None], quiet_seconds: float = QUIET_SECONDS) -> None:
        self._say, self._quiet_seconds = say, quiet_seconds
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._stage: str | None = None
        self._text, self._fraction = "", 0.0
        self._began = self._spoke = perf_counter()

    def __enter__(self) -> "ProgressLines":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        self._thread.join()

    def show(self, stage: str, text: str, fraction: float) -> None:
        """What `Stages` calls at the start of a stage, at each report, and at its end."""
        with self._lock:
            starts = fraction == 0.0 and not text
            if starts:
                self._began = perf_counter()
                self._say(stage)
            self._stage = stage if fraction < 1 else None
            self._text, self._fraction = text, fraction
            if starts:
                self._spoke = perf_counter()

    def _watch(self) -> None:
        while not self._ended.wait(self._quiet_seconds / 10):
            with self._lock:
                now = perf_counter()
                if self._stage and now - self._spoke >= self._quiet_seconds:
                    self._spoke = now
                    self._say(self._line(now - self._began))

    def _line(self, elapsed: float) -> str:
        share = f"{self._fraction:.0%}" if self._fraction else ""
        parts = (share, f"{elapsed:.0f} s", time_left(elapsed, self._fraction), self._text)
        return f"  {self._stage}: {', '.join(part for part in parts if part)}"
