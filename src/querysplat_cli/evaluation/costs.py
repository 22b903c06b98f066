"""What a piece of work costs: seconds, and the most memory held meanwhile."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from querysplat_cli.runtime.device import peak_gib, reset_peak_memory

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Cost:
    """Wall-clock seconds, and the process's peak memory in GiB while they passed.

    Where the system cannot forget an older peak (`reset_peak_memory`), the peak is the process's so far.
    """

    seconds: float
    peak_gib: float


def measured(work: Callable[[], Answer]) -> tuple[Answer, Cost]:
    """What `work` returns, and what it cost."""
    reset_peak_memory()
    start = time.perf_counter()
    answer = work()
    return answer, Cost(time.perf_counter() - start, peak_gib())
