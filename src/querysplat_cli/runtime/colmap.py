"""COLMAP's Python package, loaded without its handler of SIGTERM."""

import signal
import sys
import threading
from importlib import import_module
from typing import Any

from querysplat_cli.runtime import signals


def load_pycolmap() -> Any:
    """The module `pycolmap`. When it is imported first, it installs a SIGTERM handler that prints a stack dump.

    SIGTERM waits until that handler is gone again. A thread of another library could still receive it meanwhile, so a
    command calls this before there are such threads: they are started by torch, which is imported here as well.
    """
    if "pycolmap" in sys.modules or threading.current_thread() is not threading.main_thread():
        return import_module("pycolmap")
    before = signal.getsignal(signal.SIGTERM)
    with signals.blocked(signal.SIGTERM):
        import_module("torch")
        module = import_module("pycolmap")
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)
    return module
