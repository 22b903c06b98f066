"""COLMAP's Python package, loaded without its handler of SIGTERM."""

import signal
import threading
from importlib import import_module
from typing import Any


def load_pycolmap() -> Any:
    """The module `pycolmap`. When it is imported first, it installs a SIGTERM handler that prints a stack dump."""
    before = signal.getsignal(signal.SIGTERM)
    module = import_module("pycolmap")
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)
    return module
