"""Signals that end a command: SIGTERM and SIGHUP are interruptions as Ctrl-C is."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SOON = 0.01
"""Seconds after which a signal that Python swallowed, or that came during an import, is sent again."""
UNBROKEN = {"torch", "numpy", "scipy", "pycolmap", "cv2", "numba", "av", "PIL", "matplotlib"}
"""Packages whose imports are not broken off: native code drops an error that Python raises in it, or aborts."""
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class _State:
    """What arrived last, whether it waits, and what is kept. One for the process, as handlers are."""

    received: int | None = None
    kept = ""
    holding = 0
    waiting = False


def catch() -> None:
    """Let every ending signal raise KeyboardInterrupt in the main thread. What is ignored (`nohup`) stays ignored."""
    _State.kept = ""
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, interrupt)
    sys.unraisablehook = _send_again


def _send_again(swallowed: "sys.UnraisableHookArgs") -> None:
    """Send a signal again that arrived in a destructor or a callback: Python drops exceptions there."""
    if swallowed.exc_type is not KeyboardInterrupt or _State.received is None:
        sys.__unraisablehook__(swallowed)
        return
    _come_again(_State.received)


def _come_again(number: int) -> None:
    timer = threading.Timer(SOON, os.kill, (os.getpid(), number))
    timer.daemon = True
    timer.start()


def interrupt(number: int, frame: object = None) -> None:
    """A handler: raises KeyboardInterrupt, now, at the end of `held`, or soon after an import of one of `UNBROKEN`."""
    _State.received = number
    if _State.holding:
        _State.waiting = True
    elif _is_half_imported():
        _come_again(number)
    else:
        raise KeyboardInterrupt


def _is_half_imported() -> bool:
    """Whether a module of `UNBROKEN` is being imported."""
    ours = (module for name, module in tuple(sys.modules.items()) if name.partition(".")[0] in UNBROKEN)
    # Not by getattr: some modules have a __getattr__ of their own, which may do anything.
    specs = (getattr(module, "__dict__", {}).get("__spec__") for module in ours)
    return any(getattr(spec, "_initializing", False) for spec in specs)


@contextmanager
def held() -> Iterator[None]:
    """Inside, an ending signal waits. For steps that belong together and take no time, such as two renames."""
    _State.holding += 1
    try:
        yield
    finally:
        _State.holding -= 1
    if _State.waiting and not _State.holding:
        _State.waiting = False
        raise KeyboardInterrupt


@contextmanager
def blocked(number: int) -> Iterator[None]:
    """Inside, the system keeps the signal back from this thread, and from threads that start here, for good."""
    mask = getattr(signal, "pthread_sigmask", None)
    before = mask(signal.SIG_BLOCK, {number}) if mask else set()
    try:
        yield
    finally:
        if mask:
            mask(signal.SIG_SETMASK, before)


def ignore() -> None:
    """Let no ending signal change the exit code of a command that is done. Python takes a moment to end."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def keep(what: str) -> None:
    """Note for the user what a command that is stopped now leaves behind on purpose."""
    _State.kept = what


def kept() -> str:
    """The last note of `keep`; empty where there is none."""
    return _State.kept


def caught() -> bool:
    """Whether an ending signal has arrived."""
    return _State.received is not None


def exit_code() -> int:
    """128 + the number of the signal that ended the command; that of Ctrl-C where none was caught."""
    return 128 + (_State.received or signal.SIGINT)
