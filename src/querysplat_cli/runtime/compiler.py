"""Kernels are compiled by processes of their own, the first time on a machine, while this one does other work.

Numba compiles one function at a time in a process, so a thread would hold up the kernels that are needed first. A
process leaves what it compiled in numba's cache on disk.

A module of kernels has `KERNELS`: functions with the types that they are called with, in the order of their first call.
"""

import atexit
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from querysplat_cli.runtime.caches import is_cached
from querysplat_cli.runtime.progress import Progress, silent

DEPTH_KERNELS = ("querysplat_cli.encoders.classical.kernels",)
SCENE_KERNELS = ("querysplat_cli.queries.kernels", "querysplat_cli.model.kernels", "querysplat_cli.splat.kernels")
"""The modules of kernels, by what needs them first: the depth, or queries and optimisation."""
LONGEST_WAIT = 120.0
"""Seconds after which this process compiles the kernels, too."""
_running: dict[str, "subprocess.Popen[bytes]"] = {}
"""The process that compiles a module's kernels, by the module's name."""


def start_compiling(*modules: str) -> None:
    """Start a process that compiles the kernels of `modules`, one after another, or none if numba's cache has them."""
    lacking = [name for name in modules if name not in _running and not is_compiled(name)]
    if not lacking:
        return
    nowhere = subprocess.DEVNULL
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, *lacking], stdin=nowhere, stdout=nowhere, stderr=nowhere
    )
    atexit.register(process.kill)
    _running.update(dict.fromkeys(lacking, process))


def wait_until_compiled(*modules: str, progress: Progress = silent) -> None:
    """Return when the processes that were started for `modules` have ended.

    What a failed one left out is compiled when it is called.
    """
    for process in {_running[name] for name in modules if name in _running}:
        if process.poll() is None:
            progress("compiling for this machine, the first time only", 0.0)
        try:
            process.wait(LONGEST_WAIT)
        except subprocess.TimeoutExpired:
            process.kill()


def is_compiled(module: str) -> bool:
    """Whether numba's cache has all kernels of the module."""
    return all(is_cached(function) for function, _ in kernels(module))


def kernels(module: str) -> Sequence[tuple[Any, tuple[Any, ...]]]:
    """`KERNELS` of the module of this name."""
    found: Sequence[tuple[Any, tuple[Any, ...]]] = import_module(module).KERNELS
    return found


def compile_here(module: str) -> None:
    """Compile the kernels of the module in this process, or load what an earlier run compiled."""
    for function, signature in kernels(module):
        function.compile(signature)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        compile_here(name)
