"""The stages of a command: their progress, and the seconds that each took."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float], None]
"""Called with a text about the current work, and the finished fraction of the stage."""


class Stages:
    """Times named stages, and reports the progress of each to a listener.

    `listen(stage, text, fraction)` is called at the start of a stage (0.0), at each report, and at its end (1.0).
    `seconds` has the total of each stage, which may run more than once. `started` is when the command began, by
    `time.perf_counter`; now by default.
    """

    def __init__(
        self,
        listen: Callable[[str, str, float], None] = lambda stage, text, fraction: None,
        started: float | None = None,
    ) -> None:
        self.seconds: dict[str, float] = {}
        self._listen = listen
        self._started = time.perf_counter() if started is None else started

    def elapsed(self) -> float:
        """Seconds since the command began."""
        return time.perf_counter() - self._started

    @contextmanager
    def __call__(self, stage: str) -> Iterator[Progress]:
        start = time.perf_counter()
        self._listen(stage, "", 0.0)
        try:
            yield lambda text, fraction: self._listen(stage, text, fraction)
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
        self._listen(stage, "", 1.0)
