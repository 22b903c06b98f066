"""Standard output and standard error that may be closed, and readers that may go away."""

import os
import sys
from contextlib import suppress
from typing import Any


class Tolerant:
    """A text stream whose reader may go away (`| head -1`): the rest of the text is dropped, and the work goes on.

    Any error drops the text that is left. Those that are not `survives` are raised.
    """

    def __init__(self, stream: Any, survives: type[OSError]) -> None:
        self._stream, self._survives = stream, survives

    def write(self, text: str) -> int:
        try:
            return int(self._stream.write(text))
        except OSError as error:
            self._drop(error)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._drop(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _drop(self, error: OSError) -> None:
        # What the stream still holds goes to the null device, also when Python flushes it at the end.
        with suppress(OSError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
        if not isinstance(error, self._survives):
            raise error


def prepare_streams() -> None:
    """Open the standard streams that are closed, on the null device, and let no stream end the command.

    Otherwise the next file that is opened would get the number of the closed stream, and messages of native libraries
    would go into it. Letters that a stream cannot show are written as escapes. What native libraries print to standard
    output goes to standard error, so that results are alone there.
    """
    for number in range(3):
        _open_closed(number)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            stream = open(number, "w" if number else "r", closefd=False)  # noqa: SIM115 - it lives as long as Python
            setattr(sys, name, stream)
        if number:
            stream = _apart(stream) if name == "stdout" else stream
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")
            # Results that cannot be written are an error. Messages have nowhere to say so, and the work is not lost.
            setattr(sys, name, Tolerant(stream, BrokenPipeError if name == "stdout" else OSError))


def _open_closed(number: int) -> None:
    try:
        os.fstat(number)
    except OSError:
        opened = os.open(os.devnull, os.O_RDWR)
        if opened != number:
            os.dup2(opened, number)
            os.close(opened)


def _apart(stream: Any) -> Any:
    """A stream to the same place that has a file number of its own; number 1 goes to standard error from now on."""
    stream.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    return open(kept, "w", buffering=1 if os.isatty(kept) else -1, encoding=stream.encoding)
