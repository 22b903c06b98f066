"""Idle threads soon sleep, unless the user chose otherwise."""

import os
import subprocess
import sys

import pytest

from querysplat_cli.runtime.threads import OWN_CHOICES, SHORT_WAITING, wait_shortly


def test_idle_threads_soon_sleep() -> None:
    environment: dict[str, str] = {}
    wait_shortly(environment)
    assert environment == SHORT_WAITING


@pytest.mark.parametrize("name", OWN_CHOICES)
def test_the_choice_of_the_user_stays(name: str) -> None:
    environment = {name: "own"}
    wait_shortly(environment)
    assert environment == {name: "own"}


@pytest.mark.parametrize("module", ["querysplat_cli", "querysplat_cli.cli", "querysplat_cli.splat.render"])
def test_the_choice_is_made_in_front_of_the_import_of_torch(module: str) -> None:
    """An audit hook looks at the environment when torch or numba is imported, or when the program ends."""
    code = f"""
import importlib, os, sys
seen = []
def hook(event, arguments):
    if event == "import" and arguments[0] in ("torch", "numba"):
        seen.append(os.environ.get("OMP_WAIT_POLICY"))
sys.addaudithook(hook)
importlib.import_module("{module}")
assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
assert set(seen) <= {{"PASSIVE"}}, seen
assert seen or "{module}" != "querysplat_cli.splat.render"
"""
    environment = {name: value for name, value in os.environ.items() if name not in OWN_CHOICES}
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=environment)
