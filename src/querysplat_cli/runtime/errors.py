"""Errors a user can do something about."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Process exit codes, as documented in docs/cli.md."""

    DONE = 0
    BUG = 1
    BAD_INPUT = 2
    IMPOSSIBLE = 3
    MISSING_PART = 4
    INTERRUPTED = 130


MAKE_AGAIN = "Run `querysplat reconstruct` again."
"""The hint of errors in a stored scene that nothing else mends."""


class QuerySplatError(Exception):
    """An error that a user can act on: `message` is what is wrong, and `hint` what to do, each in one line.

    The command line prints both and exits with `code`. No code may depend on the wording.
    """

    def __init__(self, message: str, hint: str = "", code: int = ExitCode.BAD_INPUT) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.code = code


class ImpossibleScene(QuerySplatError):
    """The input is sound, but no scene can be made of it (no overlap, too few views)."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message, hint, ExitCode.IMPOSSIBLE)


class MissingPart(QuerySplatError):
    """Weights, an optional package or a device that the request needs is not there."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message, hint, ExitCode.MISSING_PART)


NO_MEMORY = ("can't allocate memory", "Insufficient memory", "bad_alloc", "not enough memory", "Cannot allocate memory")
"""What torch, OpenCV and native libraries say in errors that are no MemoryError."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether there was too little memory for what failed."""
    return isinstance(error, MemoryError) or any(words in str(error) for words in NO_MEMORY)
