"""CPU seconds, which other work on the machine does not stretch as it does seconds by the clock."""

import os


def children_cpu_seconds() -> float:
    """Of all processes that this one started and that have ended: user and system time, over all cores."""
    times = os.times()
    return times.children_user + times.children_system
