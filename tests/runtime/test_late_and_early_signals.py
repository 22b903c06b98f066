"""Signals at moments that no handler of ours can cover: a library installs its own, a destructor runs, Python ends."""

import subprocess
import sys

WHILE_PYCOLMAP_IS_IMPORTED = """
import os, signal
from types import ModuleType
from querysplat_cli.runtime import colmap, signals

def with_a_handler_of_its_own(name):
    if name == "pycolmap":
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)
    return ModuleType(name)

colmap.import_module = with_a_handler_of_its_own
signals.catch()
try:
    colmap.load_pycolmap()
except KeyboardInterrupt:
    raise SystemExit(signals.exit_code())
"""
WHILE_TORCH_IS_IMPORTED = """
import os, signal, sys, tempfile, time
from pathlib import Path
from querysplat_cli.runtime import signals

with tempfile.TemporaryDirectory() as folder:
    Path(folder, "torch").mkdir()
    Path(folder, "torch", "__init__.py").touch()
    Path(folder, "torch", "inner.py").write_text("import os; os.kill(os.getpid(), 1); whole = True")
    sys.path.insert(0, folder)
    signals.catch()
    try:
        import torch
        import torch.inner
        time.sleep(20)
    except KeyboardInterrupt:
        raise SystemExit(signals.exit_code() if hasattr(sys.modules.get("torch.inner"), "whole") else 1)
"""
IN_A_DESTRUCTOR = """
import os, signal, time
from querysplat_cli.runtime import signals

class Thing:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)

signals.catch()
try:
    Thing()
    time.sleep(20)
except KeyboardInterrupt:
    raise SystemExit(signals.exit_code())
"""
WHILE_PYTHON_ENDS = """
import atexit, os, signal, sys
from querysplat_cli.cli import main

for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    atexit.register(os.kill, os.getpid(), number)
sys.argv = ["querysplat", "--version"]
main()
"""


def ended(program: str) -> int:
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True)
    assert "Traceback" not in done.stderr
    return done.returncode


def test_sigterm_waits_for_the_import_of_pycolmap() -> None:
    assert ended(WHILE_PYCOLMAP_IS_IMPORTED) == 143


def test_a_signal_waits_for_the_import_of_native_code() -> None:
    """torch's C++ called terminate() for SIGHUP; it and numpy dropped SIGINT, and the command went on to its end."""
    assert ended(WHILE_TORCH_IS_IMPORTED) == 129


def test_sigterm_in_a_destructor_is_not_lost() -> None:
    assert ended(IN_A_DESTRUCTOR) == 143


def test_a_command_that_is_done_keeps_its_exit_code() -> None:
    assert ended(WHILE_PYTHON_ENDS) == 0
