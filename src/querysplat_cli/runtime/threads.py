"""How the threads of torch, numba and COLMAP wait for each other, and how many there are."""

import os
from collections.abc import MutableMapping

from querysplat_cli.runtime import containers

SHORT_WAITING = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "1000", "KMP_BLOCKTIME": "0"}
"""For any OpenMP; turns of the loop in which GNU's waits, 25 ns each on an AMD EPYC; and milliseconds of LLVM's and
Intel's."""
OWN_CHOICES = (*SHORT_WAITING, "KMP_LIBRARY")
"""With any of these variables users choose for themselves how threads wait."""
THREAD_LIMITS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")


def wait_shortly(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let idle OpenMP threads sleep after a moment, unless the environment already has one of `OWN_CHOICES`.

    By default an idle thread spins. Torch, numba and COLMAP each have a pool of such threads. Beside another busy
    program, spinning threads take the cores from those that have work, and everything takes several times as long.
    Threads that sleep at once have to be woken for every small step (docs/speed.md has the times of all three).
    OpenMP reads the environment once, so this has an effect only in front of the first import of those libraries.
    """
    if not any(name in environment for name in OWN_CHOICES):
        environment.update(SHORT_WAITING)


def cores() -> int:
    """The cores that this process may use: those it may run on, or fewer where its container allows fewer."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(usable, containers.cores() or usable)


def limit_threads(environment: MutableMapping[str, str] = os.environ) -> None:
    """Start no more threads than the container allows cores, unless the environment says how many.

    More would be stopped together for most of the time. As above, in front of the first import of the libraries.
    """
    if containers.cores() is not None:
        allowed = str(cores())
        for name in THREAD_LIMITS:
            environment.setdefault(name, allowed)
