"""Errors of several processes that torchrun started: of one that all of them find, the first of each machine tells.

torchrun ends the others as soon as one process has failed. So another process that finds an error waits. Where nobody
ends it, the error is its own, and it tells it.
"""

import os
import time

PATIENCE = 10.0
"""Seconds that a process waits until the first of its machine has told the error."""


class _State:
    """Whether this process has waited, and was ended meanwhile. One for the process, which fails once."""

    waited = False
    ended = False


def is_another() -> bool:
    """Whether torchrun started this process, and another one of this machine first."""
    return "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("LOCAL_RANK", "0") != "0"


def first_tells() -> bool:
    """Whether the first process of this machine tells the error that this one has.

    Call it while the processes are still joined: what parts them is an error of the first one, too. The first call
    waits until torchrun ends this process, or for `PATIENCE`.
    """
    if is_another() and not _State.waited:
        _State.waited = True
        try:
            time.sleep(PATIENCE)
        except KeyboardInterrupt:
            _State.ended = True
    return _State.ended
