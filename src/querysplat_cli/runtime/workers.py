"""Jobs in parallel worker processes. A job that crashes its process does not affect the others."""

import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from querysplat_cli.runtime import signals
from querysplat_cli.runtime.engine import Done, Handler, Heard, reporting_to, unheard
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.threads import THREAD_LIMITS, cores

Job = TypeVar("Job")
STOP_SECONDS = 5.0
"""How long a stopped worker may take to remove its unfinished files."""


class Workers:
    """An engine (`runtime/engine.py`) of `count` processes of this machine, without anything to install.

    Each process runs many jobs, and is restarted after a crash. The machine's cores are shared out
    among them, unless the user has set a limit of threads.
    """

    def __init__(self, count: int) -> None:
        self._count = count

    def run(self, handler: Handler, setup: Any, jobs: Sequence[Any], done: Done, heard: Heard = unheard) -> None:
        """See `Engine`. Neither `done` nor `heard` is called while one of them runs.

        On an exception, all processes are stopped; Ctrl-C and a scheduler's SIGTERM are one. Call it from the main
        thread.
        """
        _Pool(self._count, handler, setup).run(jobs, done, heard)


@dataclass(frozen=True)
class _Word(Generic[Job]):
    """What a process says of a job: its progress, or else that it ended.

    `wrong` is the error that the job raised; `why` is the reason where the process ended with it.
    """

    job: Job
    progress: tuple[str, float] | None = None
    wrong: QuerySplatError | None = None
    why: str | None = None


class _Pool(Generic[Job]):
    """Processes that call `handler(setup)(job)`."""

    def __init__(self, count: int, handler: Callable[[Any], Callable[[Job], None]], setup: Any) -> None:
        self._count, self._handler, self._setup = count, handler, setup
        self._running: list[Any] = []
        self._stopped = False
        self._starting = threading.Lock()

    def run(self, jobs: Sequence[Job], done: Done, heard: Heard) -> None:
        before = signal.signal(signal.SIGTERM, signals.interrupt)
        waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
        for job in jobs:
            waiting.put(job)
        words: queue.SimpleQueue[_Word[Job]] = queue.SimpleQueue()
        threads = [
            threading.Thread(target=self._drive, args=(waiting, words), daemon=True)
            for _ in range(min(self._count, len(jobs)))
        ]
        with shared_cores(len(threads)):
            try:
                for thread in threads:
                    thread.start()
                ended = 0
                while ended < len(jobs):
                    word = words.get()
                    if word.progress:
                        heard(word.job, *word.progress)
                    elif word.wrong:
                        raise word.wrong
                    else:
                        ended += 1
                        done(word.job, word.why)
                for thread in threads:
                    thread.join()
            finally:
                self._stop()
                for thread in threads:
                    if thread.ident:  # was started
                        thread.join()
                signal.signal(signal.SIGTERM, before or signal.SIG_DFL)

    def _drive(self, waiting: "queue.SimpleQueue[Job]", words: "queue.SimpleQueue[_Word[Job]]") -> None:
        worker = None
        while not self._stopped:
            try:
                job = waiting.get_nowait()
            except queue.Empty:
                break
            try:
                worker = worker or self._start()
            except Exception as error:  # no process, or nothing that it could be sent; `run` waits for a word
                words.put(_Word(job, why=f"no process could be started for it: {error}"))
                continue
            if worker is None:
                break
            process, pipe = worker
            try:
                pipe.send(job)
                while isinstance(said := pipe.recv(), tuple):
                    words.put(_Word(job, said))
                words.put(_Word(job, wrong=said))
            except (EOFError, OSError):
                process.join()
                worker = None
                words.put(_Word(job, why=_last_words(process.exitcode)))
        if worker:
            worker[1].close()
            worker[0].join()

    def _start(self) -> tuple[Any, Connection] | None:
        context = get_context("spawn")
        with self._starting:  # so that none starts while all are being stopped
            if self._stopped:
                return None
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, self._handler, self._setup), daemon=True)
            process.start()
            theirs.close()
            self._running.append(process)
        return process, ours

    def _stop(self) -> None:
        with self._starting:
            self._stopped = True
        for process in self._running:
            if process.is_alive():
                process.terminate()
        for process in self._running:
            process.join(STOP_SECONDS)
            if process.is_alive():
                process.kill()
                process.join()


def _serve(pipe: Connection, handler: Callable[[Any], Callable[[Any], None]], setup: Any) -> None:
    # Ctrl-C reaches every process of a terminal. The main process stops the workers, so they ignore it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    handle = None
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        wrong = None
        try:
            with reporting_to(lambda text, fraction: pipe.send((text, fraction))):
                handle = handle or handler(setup)
                handle(job)
        except QuerySplatError as error:
            wrong = error
        pipe.send(wrong)


def _leave(*_: object) -> None:
    """End this process. A scheduler signals every process, and the main one passes it on: the second is no news."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + signal.SIGTERM)


def _end_with_parent() -> None:
    """End this process as soon as the main one was killed: nobody waits for its results any more."""
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _last_words(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        killed = "; the machine may be out of memory: use fewer --workers" if name == "SIGKILL" else ""
        return f"its process was ended by {name}{killed}"
    return f"its process ended with code {code}"


@contextmanager
def shared_cores(workers: int) -> Iterator[None]:
    """Inside this context, new processes are limited to their share of the cores, unless the user has set a limit.

    The limits are variables of this process's own environment, and Numba refuses to compile while they differ from
    the number of its running threads. So the environment is as it was afterwards, without all that Dask adds.
    """
    before, all_cores = dict(os.environ), cores()
    share = str(max(1, all_cores // max(1, workers)))
    if workers > 1:
        unlimited = [name for name in THREAD_LIMITS if before.get(name) in (None, str(all_cores))]
        os.environ.update(dict.fromkeys(unlimited, share))
    try:
        yield
    finally:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        os.environ.update(before)
