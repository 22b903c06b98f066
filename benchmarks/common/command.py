"""`querysplat reconstruct` as a user runs it, in a process of its own, with what it takes."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def reconstructed(inputs: Iterable[Path], ply: Path, *options: str) -> dict[str, Any]:
    """The report of the scene `ply` with its seconds by the clock, `wall`, and `cpu_seconds`; or `error` and `code`.

    The program is that of the package that this process imports. Seconds of the processor are those of all cores, user
    and system; other work on the machine does not stretch them as it does seconds by the clock.
    """
    command = [sys.executable, "-m", "querysplat_cli", "reconstruct", *map(str, inputs), "-o", str(ply)]
    before, start = children_cpu_seconds(), time.perf_counter()
    done = subprocess.run([*command, *options, "--json", "--quiet", "--force"], capture_output=True, text=True)
    took = {"wall": time.perf_counter() - start, "cpu_seconds": children_cpu_seconds() - before}
    if done.returncode:
        return {"error": next(iter(done.stderr.strip().splitlines()), "no message"), "code": done.returncode}
    return {**json.loads(done.stdout), **took}


def children_cpu_seconds() -> float:
    """Of all processes that this one started and that have ended."""
    times = os.times()
    return times.children_user + times.children_system
