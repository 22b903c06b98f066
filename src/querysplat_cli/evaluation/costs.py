"""What a piece of work costs: seconds, and the most memory held meanwhile."""

import resource
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Cost:
    """Wall-clock seconds, and the process's peak memory in GiB while they passed.

    Where the system cannot forget an older peak (anywhere but Linux), the peak is the process's so far.
    """

    seconds: float
    peak_gib: float


def measured(work: Callable[[], Answer]) -> tuple[Answer, Cost]:
    """What `work` returns, and what it cost."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # proc(5): the peak starts again at what is held now
    start = time.perf_counter()
    answer = work()
    return answer, Cost(time.perf_counter() - start, _peak_gib())


def _peak_gib() -> float:
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
