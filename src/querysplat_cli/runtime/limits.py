"""Limits of memory that are known in advance, so that a command says what it needs before it starts."""

import psutil

from querysplat_cli.runtime import containers
from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.threads import cores

GIB = 2**30
BUSY = ("reconstruct", "demo", "evaluate", "train", "tto", "inspect", "poses", "convert --mesh")
ADDRESS_SPACE = {**dict.fromkeys(BUSY, 2.2), "weights": 0.9}
"""GiB of address space that a verb takes with small pictures, for one core and beside what every core takes."""
OTHER_ADDRESS_SPACE = 1.5
CORE_ADDRESS_SPACE = 0.15
"""GiB of address space for each core that this process may use: stacks and pools of its threads."""


def check_address_space(verb: str) -> None:
    """Raise MissingPart when `ulimit -v` is so low that native libraries would crash."""
    limit = _limit()
    needed = ADDRESS_SPACE.get(verb, OTHER_ADDRESS_SPACE) + CORE_ADDRESS_SPACE * cores()
    if limit is not None and limit < needed * GIB:
        raise MissingPart(
            f"the limit of the address space (ulimit -v) is {limit / GIB:.1f} GiB, and about {needed:.1f} are needed",
            f"Raise it to at least {int(needed * 2**20):,} KiB, or take it away.",
        )


def more_memory() -> str:
    """What to do where memory is too small."""
    limit = _limit()
    raised = "" if limit is None else f"Raise the limit of the address space (ulimit -v), {limit / GIB:.1f} GiB; or u"
    return f"{raised or 'U'}se smaller pictures, fewer photos, or a larger machine."


def free_memory() -> int:
    """Bytes of memory that this process can still take, by the machine, its container and `ulimit -v`."""
    free, contained, limit = int(psutil.virtual_memory().available), containers.free_memory(), _limit()
    free = free if contained is None else min(free, contained)
    return free if limit is None else max(0, min(free, limit - psutil.Process().memory_info().vms))


def require_memory(needed: int, what: str) -> None:
    """Raise MissingPart unless `needed` bytes are free. `what` needs them, for instance "pictures of 9 × 9 pixels"."""
    free = free_memory()
    if needed > free:
        raise MissingPart(
            f"{what} take about {needed / GIB:,.1f} GiB of memory, and {free / GIB:.1f} are free", "Ask for less."
        )


def _limit() -> int | None:
    """The address space that this process may have, in bytes; None where there is no limit."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit
