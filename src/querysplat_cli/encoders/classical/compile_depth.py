"""Compile the kernels of the depth in a process of their own, while the cameras are searched.

The first time on a machine this takes some 25 seconds of one core. Numba compiles one function at a time in a process,
so a thread would have to wait for the splatter's. The process leaves its results in numba's cache on disk.
"""

import atexit
import subprocess
import sys

from numba import boolean, float32, float64, int64, uint8, uint16

from querysplat_cli.encoders.classical.consistency import _carve_view, _lend, _vote
from querysplat_cli.encoders.classical.patchmatch import _improve
from querysplat_cli.encoders.classical.semiglobal import _best_planes, _two_passes
from querysplat_cli.encoders.classical.sweep import _sweep
from querysplat_cli.runtime.caches import is_cached
from querysplat_cli.runtime.progress import Progress

F2, F3, F4 = float32[:, ::1], float32[:, :, ::1], float32[:, :, :, ::1]
D1, D2, D3, L1 = float64[::1], float64[:, ::1], float64[:, :, ::1], int64[::1]
SIGNATURES = (
    (_sweep, (F2, F3, F4, uint8[:, :, ::1])),
    (_two_passes, (uint8[:, :, ::1], F2, uint16[:, :, :, ::1])),
    (_best_planes, (uint16[:, :, ::1], F2)),
    (_improve, (F3, int64, int64, F2, F3, F2, F3, F3, F2, float32, float32)),
    (_vote, (F2, F3, F2, L1, D3, D2, D1)),
    (_lend, (F2, F3, F2, F2, F3, D2, D1)),
    (_carve_view, (F2, boolean[:, ::1], F3, F3, F3, F4, L1, D3, D2, float64)),
)
"""The kernels that the depth calls, with their types, in the order of their first call."""
LONGEST_WAIT = 120.0
"""Seconds after which the kernels are compiled by this process, too."""


def start_compiling() -> "subprocess.Popen[bytes] | None":
    """The process that compiles what numba's cache lacks, or None where it lacks nothing."""
    if all(is_cached(function) for function, _ in SIGNATURES):
        return None
    command, nowhere = [sys.executable, "-m", __name__], subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere)
    atexit.register(process.kill)
    return process


def wait_until_compiled(process: "subprocess.Popen[bytes]", progress: Progress) -> None:
    """Return when the process has ended. If it failed, the kernels are compiled when they are called."""
    if process.poll() is None:
        progress("compiling for this machine, the first time only", 0.0)
    try:
        process.wait(LONGEST_WAIT)
    except subprocess.TimeoutExpired:
        process.kill()


def _compile() -> None:
    for function, signature in SIGNATURES:
        function.compile(signature)


if __name__ == "__main__":
    _compile()
