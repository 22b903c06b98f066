"""The folder in which a command was started."""

import os

from querysplat_cli.runtime.errors import QuerySplatError


def is_there() -> bool:
    """Whether the current folder still exists; another process may have removed or replaced it."""
    try:
        os.getcwd()
    except OSError:
        return False
    return True


def is_unicode(path: str) -> bool:
    """Whether a path is text. Names of bytes that are not UTF-8 are not, and native libraries crash on them."""
    try:
        path.encode()
    except UnicodeEncodeError:
        return False
    return True


def check_name() -> None:
    """Raise QuerySplatError where the name of the current folder is not valid UTF-8: relative paths lead through it."""
    if is_there() and not is_unicode(os.getcwd()):
        raise QuerySplatError(
            "the name of the current folder is not valid UTF-8, so native libraries cannot open files in it",
            "Rename it, or run the command elsewhere.",
        )
