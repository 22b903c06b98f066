"""The kernels of the depth are compiled by another process, with the types with which they are called."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import arc, photographs, room

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical.compile_depth import (
    SIGNATURES,
    _compile,
    start_compiling,
    wait_until_compiled,
)
from querysplat_cli.encoders.classical.encoder import ClassicalEncoder
from querysplat_cli.encoders.classical.search import AUTOMATIC


def silent(text: str, fraction: float) -> None:
    """Progress that nobody sees."""


def test_nothing_is_left_to_compile() -> None:
    _compile()
    before = [list(function.signatures) for function, _ in SIGNATURES]
    assert all(before)
    encoder = ClassicalEncoder(AUTOMATIC)
    posed = encoder.estimate_cameras(photographs(room(), arc(4)), CameraRequest(128, 0, None), silent)
    encoder.estimate_geometry(posed, seed=0, progress=silent)
    assert [list(function.signatures) for function, _ in SIGNATURES] == before
    assert start_compiling() is None


def test_a_process_that_fails_or_is_done_holds_nothing_up() -> None:
    said: list[str] = []
    process = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])
    process.wait()
    wait_until_compiled(process, lambda text, fraction: said.append(text))
    assert not said


def test_waiting_is_announced() -> None:
    said: list[str] = []
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    wait_until_compiled(process, lambda text, fraction: (said.append(text), process.stdin.close())[0])  # type: ignore[union-attr,func-returns-value]
    assert said == ["compiling for this machine, the first time only"]


@pytest.mark.slow
def test_another_process_fills_the_cache(tmp_path: Path) -> None:
    """With an empty cache a process starts; when it has ended, the cache has all kernels."""
    program = """
from querysplat_cli.encoders.classical.compile_depth import SIGNATURES, start_compiling
process = start_compiling()
assert process and process.wait() == 0
assert start_compiling() is None
for function, signature in SIGNATURES:
    function.compile(signature)
    assert function.stats.cache_hits and not function.stats.cache_misses, function
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)
