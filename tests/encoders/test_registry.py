"""Encoders are imported when they are first used, and do not change the process's signal handlers."""

import os
import signal
import subprocess
import sys

import pytest

TERMINATED = """
import os, signal
from querysplat_cli.encoders.registry import find_encoder
{before}
find_encoder("classical")
os.kill(os.getpid(), signal.SIGTERM)
"""


@pytest.mark.skipif(os.name == "nt", reason="no signals there")
@pytest.mark.parametrize(
    ("before", "code"),
    [("", -signal.SIGTERM), ("signal.signal(signal.SIGTERM, lambda *_: os._exit(7))", 7)],
)
def test_a_schedulers_sigterm_is_left_alone(before: str, code: int) -> None:
    """pycolmap would print a stack trace and replace the handler that was installed before."""
    program = [sys.executable, "-c", TERMINATED.format(before=before)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, "")
