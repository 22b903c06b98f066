"""What carries out the jobs of a long run: one after another here, or on a cluster (`runtime/cluster.py`).

A job is idempotent: its result is in files, and one whose result is there does nothing. So a job whose process was
killed is simply done again, by whichever engine.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, Protocol, runtime_checkable

from querysplat_cli.runtime.progress import Progress

Handler = Callable[[Any], Callable[[Any], None]]
"""`handler(setup)` returns the function that does a job. It is a function of a module, so that other processes can
import it, and is called once in each process."""
Done = Callable[[Any, str | None], None]
"""`done(job, why)` is called after each job; `why` is the reason where its process ended, else None."""
Heard = Callable[[Any, str, float], None]
"""`heard(job, text, fraction)` is called when a job reports its progress."""


def unheard(job: Any, text: str, fraction: float) -> None:
    """For those who do not listen."""


@runtime_checkable
class Engine(Protocol):
    """Runs jobs."""

    def run(self, handler: Handler, setup: Any, jobs: Sequence[Any], done: Done, heard: Heard = unheard) -> None:
        """Do all `jobs`. `setup` and jobs can be pickled.

        Raises what a job raises. On any exception, Ctrl-C included, jobs that are under way are stopped.
        """
        ...


class InProcess:
    """One job after another, in this process."""

    def run(self, handler: Handler, setup: Any, jobs: Sequence[Any], done: Done, heard: Heard = unheard) -> None:
        """See `Engine`."""
        handle = handler(setup)
        for job in jobs:
            with reporting_to(partial(heard, job)):
                handle(job)
            done(job, None)


_listener: ContextVar[Progress | None] = ContextVar("_listener", default=None)


@contextmanager
def reporting_to(listen: Progress) -> Iterator[None]:
    """Inside, `report_progress` calls `listen`."""
    token = _listener.set(listen)
    try:
        yield
    finally:
        _listener.reset(token)


def report_progress(text: str, fraction: float) -> None:
    """Tell the engine that runs this job how far it is."""
    listen = _listener.get()
    if listen:
        listen(text, fraction)
