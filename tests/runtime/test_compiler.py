"""Kernels are compiled ahead by other processes, with the types that they are called with; a cached copy gives the same
bits."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import pytest
import torch
from numba.core.registry import CPUDispatcher

import querysplat_cli
from querysplat_cli.model.local_attention import attend_near
from querysplat_cli.model.memories import Memory, Neighbours
from querysplat_cli.runtime import compiler
from querysplat_cli.runtime.compiler import (
    DEPTH_KERNELS,
    SCENE_KERNELS,
    compile_here,
    kernels,
    start_compiling,
    wait_until_compiled,
)
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import photometric_loss
from scenes import camera, cloud


def signatures(*modules: str) -> list[list[object]]:
    return [list(function.signatures) for module in modules for function, _ in kernels(module)]


def test_nothing_of_a_scene_is_left_to_compile() -> None:
    for module in SCENE_KERNELS:
        compile_here(module)
    before = signatures(*SCENE_KERNELS)
    assert all(before)
    cameras = camera(20, 30, views=2)
    leaves = cloud(0, 30, cameras).to(torch.float32).map(lambda field: field.requires_grad_())
    picture = render(leaves, cameras).colour
    photometric_loss(picture, torch.rand(2, 3, 20, 30), torch.ones(2, 20, 30, dtype=torch.bool)).backward()
    query, keys, values = (torch.rand(5, 2, 4, requires_grad=True) for _ in range(3))
    near = Neighbours(torch.tensor([[0, 1, 2]] * 5), torch.zeros(5, 3))
    attend_near(query, Memory(keys, values, near)).sum().backward()
    assert signatures(*SCENE_KERNELS) == before


def test_what_is_compiled_needs_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler, "is_compiled", lambda module: True)
    monkeypatch.setattr(compiler, "_running", {})
    start_compiling(*DEPTH_KERNELS)
    assert not compiler._running


def test_a_process_that_failed_holds_nothing_up(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    process = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])
    process.wait()
    monkeypatch.setattr(compiler, "_running", {"some": process})
    wait_until_compiled("some", "other", progress=lambda text, fraction: said.append(text))
    assert not said


def test_waiting_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)

    def announced(text: str, fraction: float) -> None:
        assert process.stdin
        said.append(text)
        process.stdin.close()

    monkeypatch.setattr(compiler, "_running", {"some": process, "other": process})
    wait_until_compiled("some", "other", progress=announced)
    assert said == ["compiling for this machine, the first time only"]


@pytest.mark.slow
def test_another_process_fills_the_cache(tmp_path: Path) -> None:
    """With an empty cache a process starts, once; when it has ended, the cache has all kernels."""
    program = """
from querysplat_cli.runtime import compiler
from querysplat_cli.runtime.compiler import DEPTH_KERNELS, SCENE_KERNELS, kernels, start_compiling, wait_until_compiled
modules = *DEPTH_KERNELS, *SCENE_KERNELS
start_compiling(*DEPTH_KERNELS)
start_compiling(*modules)
assert len(set(compiler._running.values())) == 2
wait_until_compiled(*modules)
assert all(process.returncode == 0 for process in compiler._running.values())
for module in modules:
    for function, signature in kernels(module):
        function.compile(signature)
        assert function.stats.cache_hits and not function.stats.cache_misses, function
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)


def test_reordered_sums_are_inlined() -> None:
    """A compiling process calls a function's own machine code, and one that loads its caller from the cache the
    caller's copy. Where `fastmath` lets the two round differently, the first run would give another scene."""
    modules = [module.name for module in walk_packages(querysplat_cli.__path__, "querysplat_cli.")]
    functions = {
        function.py_func: function.targetoptions
        for module in modules
        if not module.endswith("__main__")
        for function in vars(import_module(module)).values()
        if isinstance(function, CPUDispatcher)
    }
    helpers = {
        f: options for f, options in functions.items() if options.get("fastmath") and not options.get("parallel")
    }
    assert len(helpers) > 5
    for function, options in helpers.items():
        assert options.get("forceinline") or options.get("inline") == "always", function


@pytest.mark.slow
def test_a_first_run_gives_what_later_ones_give(tmp_path: Path) -> None:
    program = """
import torch
from scenes import FIELDS, camera, cloud
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import photometric_loss
cameras = camera(96, 128, views=2)
leaves = cloud(0, 2000, cameras).to(torch.float32).map(lambda field: field.requires_grad_())
target = torch.rand(2, 3, 96, 128, generator=torch.Generator().manual_seed(0))
photometric_loss(render(leaves, cameras).colour, target, torch.ones(2, 96, 128, dtype=torch.bool)).backward()
print(*(getattr(leaves, name).grad.numpy().tobytes().hex() for name in FIELDS))
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", program]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout for _ in range(2)
    )
    assert any(tmp_path.iterdir())
    assert first == second
