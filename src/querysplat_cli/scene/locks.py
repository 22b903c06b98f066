"""Locks of folders. The system frees them when their process ends, however it ends."""

import os
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


class NoLocks(OSError):
    """Windows and the file system of some clusters and containers have no locks: nobody can tell what is in use."""


def lock(folder: Path) -> int | None:
    """A handle that has the lock of a folder until it is closed; None where a living process has it.

    The lock is on the folder itself: filelock would leave a file of its own among the user's. Raises NoLocks where
    there are none, and OSError where the folder cannot be opened.
    """
    if fcntl is None:
        raise NoLocks
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    except OSError as error:
        os.close(handle)
        raise NoLocks from error
    return handle
