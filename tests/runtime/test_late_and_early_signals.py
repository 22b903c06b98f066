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


def test_sigterm_in_a_destructor_is_not_lost() -> None:
    assert ended(IN_A_DESTRUCTOR) == 143


def test_a_command_that_is_done_keeps_its_exit_code() -> None:
    assert ended(WHILE_PYTHON_ENDS) == 0
