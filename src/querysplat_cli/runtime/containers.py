"""What a container lets a program have: the limits of Linux's control groups (cgroups), versions 1 and 2.

Inside a container the machine's own figures, which psutil and `os.cpu_count` give, are those of the whole host.
"""

import math
from collections.abc import Iterator
from pathlib import Path

MOUNTED = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")
DROPPABLE = ("inactive_file ", "total_inactive_file ")
"""Pages of files that the system drops when memory is needed, in `memory.stat` of both versions."""


def free_memory() -> int | None:
    """Bytes that this process may still take by its groups; None where these have no limit."""
    free = [
        limit - used + _droppable(group / "memory.stat")
        for group in _groups("memory")
        for most, now in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
        if (limit := _number(group / most)) is not None and (used := _number(group / now)) is not None
    ]
    return max(0, min(free)) if free else None


def cores() -> int | None:
    """The cores that this process may keep busy by its groups, rounded up; None where these have no limit."""
    found = []
    for group in _groups("cpu"):
        quota, period = (*_words(group / "cpu.max"), "", "")[:2]
        quota, period = quota or _first(group / "cpu.cfs_quota_us"), period or _first(group / "cpu.cfs_period_us")
        if quota.isdigit() and period.isdigit() and int(period) > 0:  # else "max" or −1
            found.append(max(1, math.ceil(int(quota) / int(period))))
    return min(found, default=None)


def _groups(controller: str) -> Iterator[Path]:
    """The groups of this process, from its own one to that of all."""
    for line in _lines(OWN):
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        root = MOUNTED / controller if controllers else MOUNTED
        own = root / path.lstrip("/")
        yield from (group for group in (own, *own.parents) if group.is_relative_to(root))


def _droppable(file: Path) -> int:
    return sum(int(line.split()[1]) for line in _lines(file) if line.startswith(DROPPABLE))


def _number(file: Path) -> int | None:
    text = _first(file)
    return int(text) if text.isdigit() else None


def _first(file: Path) -> str:
    return (*_words(file), "")[0]


def _words(file: Path) -> list[str]:
    return " ".join(_lines(file)).split()


def _lines(file: Path) -> list[str]:
    try:
        return file.read_text().splitlines()
    except OSError:
        return []
