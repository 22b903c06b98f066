"""Jobs on several processes or machines, by Dask (the extra `cluster`)."""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from shutil import which
from typing import Any
from uuid import uuid4

from querysplat_cli.runtime.engine import Done, Engine, Handler, Heard, InProcess, reporting_to, unheard
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.runtime.optional_parts import install_command
from querysplat_cli.runtime.words import counted
from querysplat_cli.runtime.workers import shared_cores

KINDS = "local:N, tcp://HOST:PORT or slurm:N"
PROGRESS = "querysplat-progress"
RETRIES = 2
"""How often a job is done again after an error that is not the user's. Dask gives jobs of lost workers to others."""
ANSWER_SECONDS = 15
"""How long a scheduler may take to answer."""
LEAST_PROGRESS = 0.01
"""Smaller steps of a job are not reported."""


def read_cluster(text: str) -> str:
    """The value of --cluster, checked. Raises QuerySplatError where it means nothing."""
    kind, _, rest = text.partition(":")
    if kind in ("local", "slurm") and rest.isdecimal() and 1 <= int(rest) <= 10_000:
        return text
    if kind in ("tcp", "tls", "ucx") and rest.startswith("//") and rest[2:]:
        return text
    raise QuerySplatError(f"--cluster {text!r}: no such cluster", f"Use {KINDS}.")


def find_engine(
    cluster: str | None, otherwise: Engine | None = None, say: Callable[[str], None] = lambda text: None
) -> Engine:
    """The engine of a value of --cluster; without one, `otherwise`, or this process.

    `say` gets the number of workers and the link to Dask's page. Raises MissingPart where a package is not installed.
    """
    if cluster is None:
        return otherwise or InProcess()
    if not find_spec("distributed"):
        raise MissingPart(f"--cluster {cluster} needs Dask", install_command("cluster"))
    return Dask(cluster, say)


def check_cluster(cluster: str) -> None:
    """Raise QuerySplatError where no scheduler answers, and MissingPart where a part is missing; worth doing first."""
    find_engine(cluster)
    kind = cluster.partition(":")[0]
    if kind == "slurm":
        _check_slurm()
    elif kind != "local":
        _scheduler(cluster).close()


class Dask:
    """Jobs on the workers of a Dask cluster, one at a time on each."""

    def __init__(self, cluster: str, say: Callable[[str], None] = lambda text: None) -> None:
        self._cluster, self._say = cluster, say

    def run(self, handler: Handler, setup: Any, jobs: Sequence[Any], done: Done, heard: Heard = unheard) -> None:
        """See `Engine`. A job whose worker is lost goes to another one; `why` of `done` says that too many were."""
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        run = uuid4().hex[:8]
        names = {f"querysplat-{run}-{number}": job for number, job in enumerate(jobs)}
        with _client(self._cluster) as client:
            if not client.scheduler_info()["workers"]:
                self._say(f"waiting for the first worker, {client.dashboard_link}")
                client.wait_for_workers(1)
            workers = counted(len(client.scheduler_info()["workers"]), "worker")
            self._say(f"{workers}, {client.dashboard_link}")
            client.subscribe_topic(PROGRESS, lambda event: _pass_on(names, heard, event[1]))
            futures = [
                client.submit(_do, handler, setup, job, run, name, key=name, retries=RETRIES, pure=False)
                for name, job in names.items()
            ]
            try:
                for future in as_completed(futures):
                    why = None
                    try:
                        wrong = future.result()
                    except KilledWorker:
                        wrong, why = None, "its worker was lost again and again; the machine may be out of memory"
                    if wrong is not None:
                        raise wrong
                    done(names[future.key], why)
            finally:
                client.cancel(futures, force=True)


_one = threading.Lock()
_handlers: dict[str, Callable[[Any], None]] = {}


def _do(handler: Handler, setup: Any, job: Any, run: str, name: str) -> QuerySplatError | None:
    """Do a job on a worker. An error that is the user's is returned, so that Dask does not try again."""
    from distributed import get_worker

    worker, last = get_worker(), -1.0

    def listen(text: str, fraction: float) -> None:
        nonlocal last
        if not 0 <= fraction - last < LEAST_PROGRESS:
            last = fraction
            worker.log_event(PROGRESS, (name, text, fraction))

    with _one, reporting_to(listen):
        try:
            if run not in _handlers:
                _handlers.clear()
                _handlers[run] = handler(setup)
            _handlers[run](job)
        except QuerySplatError as error:
            return error
    return None


def _pass_on(names: dict[str, Any], heard: Heard, event: tuple[str, str, float]) -> None:
    name, text, fraction = event
    if name in names:
        heard(names[name], text, fraction)


@contextmanager
def _client(cluster: str) -> Iterator[Any]:
    import dask.config
    from distributed import Client

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # a lost worker is no news for users
    kind, _, rest = cluster.partition(":")
    with ExitStack() as stack:
        # No job waits at a worker: if that one is lost again and again, only the job that it does is blamed.
        stack.enter_context(dask.config.set({"distributed.scheduler.worker-saturation": 1.0}))
        if kind == "local":
            stack.enter_context(shared_cores(int(rest)))
            yield stack.enter_context(Client(stack.enter_context(_local(int(rest)))))
        elif kind == "slurm":
            yield stack.enter_context(Client(stack.enter_context(_slurm(int(rest)))))
        else:
            yield stack.enter_context(_scheduler(cluster))


def _scheduler(address: str) -> Any:
    """A client of the scheduler at this address."""
    from distributed import Client

    try:
        return Client(address, timeout=ANSWER_SECONDS)
    except (OSError, ValueError) as error:
        raise QuerySplatError(
            f"--cluster {address}: no scheduler answers there", "Start one with `dask scheduler`."
        ) from error


def _local(workers: int) -> Any:
    """Processes on this machine, with the environment of this one."""
    import dask.config
    from distributed import LocalCluster

    with dask.config.set({"distributed.nanny.pre-spawn-environ": {}}):  # Dask has limits of threads of its own
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,
            dashboard_address="127.0.0.1:0" if find_spec("bokeh") else None,
            silence_logs=logging.CRITICAL,
        )


def _check_slurm() -> None:
    """Raise MissingPart where jobs cannot be submitted from here."""
    if not find_spec("dask_jobqueue"):
        raise MissingPart("--cluster slurm needs dask-jobqueue", install_command("cluster"))
    if not which("sbatch"):
        raise MissingPart(
            "--cluster slurm: there is no sbatch here", "Run the command where jobs of Slurm are submitted."
        )


def _slurm(jobs: int) -> Any:
    """Jobs of Slurm, each one worker, with the resources of ~/.config/dask/jobqueue.yaml."""
    _check_slurm()
    from dask_jobqueue import SLURMCluster

    try:
        cluster = SLURMCluster(processes=1)
    except ValueError as error:  # no cores, or no memory
        raise QuerySplatError(
            "--cluster slurm: how many cores and how much memory a job has is not known",
            "Write them into ~/.config/dask/jobqueue.yaml: jobqueue: {slurm: {cores: 4, memory: 16GB}}",
        ) from error
    cluster.scale(jobs=jobs)
    return cluster
