"""Signals at two moments that no handler of ours can cover: while a library installs its own, and while Python ends."""

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
WHILE_PYTHON_ENDS = """
import atexit, os, signal, sys
from querysplat_cli.cli import main

for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    atexit.register(os.kill, os.getpid(), number)
sys.argv = ["querysplat", "--version"]
main()
"""


def ended(program: str) -> int:
    return subprocess.run([sys.executable, "-c", program], check=False, stdout=subprocess.DEVNULL).returncode


def test_sigterm_waits_for_the_import_of_pycolmap() -> None:
    assert ended(WHILE_PYCOLMAP_IS_IMPORTED) == 143


def test_a_command_that_is_done_keeps_its_exit_code() -> None:
    assert ended(WHILE_PYTHON_ENDS) == 0
