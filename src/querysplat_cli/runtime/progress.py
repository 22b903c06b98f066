"""The stages of a command: their progress, and the seconds that each took."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

Progress = Callable[[str, float], None]
"""Called with a text about the current work, and the finished fraction of the stage."""


def silent(text: str, fraction: float) -> None:
    """Progress that nobody sees."""


@runtime_checkable
class Watcher(Protocol):
    """What shows a scene while it is made. Both calls must be quick, and change nothing that they are given."""

    def listen(self, stage: str, text: str, fraction: float) -> None:
        """As the listener of `Stages`."""

    def look(self, gaussians: Any, views: Any, cameras: Any) -> None:
        """Called with the Gaussians of each step of an optimisation, and the photos that they are optimised on."""


class StageProgress:
    """The progress of one stage: a `Progress` that passes on the Gaussians of the stage, too, where someone watches."""

    def __init__(self, listen: Progress, watcher: Watcher | None) -> None:
        self._listen, self._watcher = listen, watcher

    def __call__(self, text: str, fraction: float) -> None:
        self._listen(text, fraction)

    def look(self, gaussians: Any, views: Any, cameras: Any) -> None:
        """Show the state of the scene, which is in the frame of the cameras."""
        if self._watcher:
            self._watcher.look(gaussians, views, cameras)


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
        self._listener = listen
        self._watcher: Watcher | None = None
        self._started = time.perf_counter() if started is None else started

    def elapsed(self) -> float:
        """Seconds since the command began."""
        return time.perf_counter() - self._started

    def say(self, text: str) -> None:
        """Show a text that belongs to no stage."""
        self._listen(text, "", 0.0)
        self._listen(text, "", 1.0)

    def watch(self, watcher: Watcher) -> None:
        """Let `watcher` see everything that follows."""
        self._watcher = watcher

    @contextmanager
    def __call__(self, stage: str) -> Iterator[StageProgress]:
        start = time.perf_counter()
        self._listen(stage, "", 0.0)
        try:
            yield StageProgress(lambda text, fraction: self._listen(stage, text, fraction), self._watcher)
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
        self._listen(stage, "", 1.0)

    def _listen(self, stage: str, text: str, fraction: float) -> None:
        self._listener(stage, text, fraction)
        if self._watcher:
            self._watcher.listen(stage, text, fraction)
