"""All functions that rendering and its loss use are compiled ahead, and a cached copy gives the same bits."""

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
from querysplat_cli.splat.compile_ahead import SIGNATURES, compile_ahead
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import photometric_loss
from scenes import camera, cloud


def test_nothing_is_left_to_compile() -> None:
    thread = compile_ahead()
    thread.join()
    before = [list(function.signatures) for function, _ in SIGNATURES]
    assert all(before)
    cameras = camera(20, 30, views=2)
    leaves = cloud(0, 30, cameras).to(torch.float32).map(lambda field: field.requires_grad_())
    picture = render(leaves, cameras).colour
    photometric_loss(picture, torch.rand(2, 3, 20, 30), torch.ones(2, 20, 30, dtype=torch.bool)).backward()
    assert [list(function.signatures) for function, _ in SIGNATURES] == before


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
