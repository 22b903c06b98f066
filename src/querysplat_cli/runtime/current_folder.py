"""The folder in which a command was started."""

import os


def is_there() -> bool:
    """Whether the current folder still exists; another process may have removed or replaced it."""
    try:
        os.getcwd()
    except OSError:
        return False
    return True
