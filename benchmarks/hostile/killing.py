"""Sends a signal to a running command. How long the command takes is measured first, in its very situation."""

import contextlib
import os
import random
import resource
import signal
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hostile.attempt import SLOW, STUCK, Outcome, attempt
from hostile.case import Case

import psutil

LAST = 0.95
"""Share of a command's length in which it is ended. The same command takes a little more or less the next time."""
TRIES = 6
"""How often a signal is drawn for a case, each time an earlier one, until the command is there to be ended."""
SERVED = 8.0
"""Seconds in which a server is ended, by the clock: it waits, and computes nothing."""
REST = 5.0
"""Seconds without computing after which a process is not waited for any longer."""


@dataclass(frozen=True)
class Length:
    """CPU seconds, of workers too, in which a command catches signals. When it is done, it ignores them."""

    start: float
    end: float


def attempt_kill(case: Case, scratch: Path, lengths: dict[str, Length]) -> Outcome:
    """Run one case of a kill, with earlier and earlier signals until one reaches the command while it runs.

    `lengths` are what is known of the situations. They are added to, and mended where a command was done sooner.
    """
    place, situation = case.place, case.place["situation"]
    if situation not in lengths:
        lengths[situation] = Length(0.0, SERVED) if place["server"] else _measured(case, scratch)
    drawn, share, instants = random.Random(case.what), place["share"], []
    while True:
        length = lengths[situation]
        instants.append(round(length.start + share * (LAST * length.end - length.start), 2))
        killer = _Killer(place, instants[-1])
        outcome = attempt(replace(case, place={"ending": killer}), scratch)
        if killer.reached or outcome.faults or len(instants) == TRIES:
            return replace(outcome, reached=killer.reached, instants=instants)
        lengths[situation] = replace(length, end=min(length.end, killer.watched.end))
        share *= drawn.uniform(0.3, 0.9)


def _measured(case: Case, scratch: Path) -> Length:
    """How long the command takes when no signal comes."""
    found = Length(0.0, 0.0)

    def watch(process: "subprocess.Popen[bytes]") -> tuple[int, list[str]]:
        nonlocal found
        found = _watched(process, STUCK, server=False)
        return process.wait(STUCK), []

    outcome = attempt(replace(case, place={"ending": watch}), scratch)
    if outcome.code != 0:
        raise RuntimeError(f"{case.place['situation']} fails: {outcome}")
    return found


class _Killer:
    """Ends a process. It was `reached` when it ended by the signal, which came while it caught signals."""

    def __init__(self, place: dict[str, Any], instant: float) -> None:
        self._place, self._instant = place, instant
        self.reached, self.watched = False, Length(0.0, 0.0)

    def __call__(self, process: "subprocess.Popen[bytes]") -> tuple[int, list[str]]:
        """The exit code, and what is wrong with the end: it came late, or as if there had been no signal."""
        number, server = self._place["signal"], self._place["server"]
        before = _of_ended()
        self.watched = _watched(process, self._instant, server=server)
        spent, workers = _spent(process.pid), _workers(process.pid)
        running = process.poll() is None and _catches(process.pid)
        if running:
            (os.killpg if self._place["group"] else os.kill)(process.pid, number)
        code = process.wait(STUCK)
        psutil.wait_procs(workers, SLOW)
        self.reached = running and (code in (-9, 128 + number) or (server and code == 0))
        late = _of_ended() - before - spent
        return code, [f"went on for {late:.1f} CPU s"] if running and (late > SLOW or not self.reached) else []


def _watched(process: "subprocess.Popen[bytes]", seconds: float, *, server: bool) -> Length:
    """Return when the process has computed for so long (a server: has been there), and catches signals, or is done.

    A process that computes no more is not waited for. Returns from when on it caught signals, and what it took.
    """
    began = moved = time.perf_counter()
    start, end = None, 0.0
    while process.poll() is None and time.perf_counter() < began + STUCK:
        now = time.perf_counter()
        spent, catches = now - began if server else _spent(process.pid), _catches(process.pid)
        if start is not None and not catches:
            break
        if spent > end:
            end, moved = spent, now
        start = spent if start is None and catches else start
        if start is not None and (spent >= seconds or (seconds < STUCK and now > moved + REST)):
            break
        time.sleep(0.02)
    return Length(start or 0.0, end)


def _catches(pid: int) -> bool:
    """Whether the process handles SIGTERM: it has loaded the command line, and is not done."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("SigCgt:"):
                return bool(int(line.split()[1], 16) >> (signal.SIGTERM - 1) & 1)
    return False


def _spent(pid: int) -> float:
    """CPU seconds of a process and its workers, of those that ended too."""
    total = 0.0
    with contextlib.suppress(psutil.NoSuchProcess):
        for process in (psutil.Process(pid), *_workers(pid)):
            total += sum(process.cpu_times()[:4])
    return total


def _workers(pid: int) -> list[psutil.Process]:
    with contextlib.suppress(psutil.NoSuchProcess):
        return list(psutil.Process(pid).children(recursive=True))
    return []


def _of_ended() -> float:
    """CPU seconds of all children of this process that ended, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
