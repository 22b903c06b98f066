"""What a piece of work costs: seconds, and the most memory held meanwhile."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from querysplat_cli.device import forget_peak, peak_gib

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Cost:
    """Wall-clock seconds, and the process's peak memory in GiB while they passed.

    Where the system cannot forget an older peak (`forget_peak`), the peak is the process's so far.
    """

    seconds: float
    peak_gib: float


def measured(work: Callable[[], Answer]) -> tuple[Answer, Cost]:
    """What `work` returns, and what it cost."""
    forget_peak()
    start = time.perf_counter()
    answer = work()
    return answer, Cost(time.perf_counter() - start, peak_gib())
