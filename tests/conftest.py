"""Shared fixtures. Every jaxtyping annotation outside compiled code is checked while the tests run."""

import os
import signal
from pathlib import Path

import hypothesis
import pytest
from jaxtyping import install_import_hook

from common.locations import FIXTURES, PHOTOS, location, missing

# Before torch is imported: with a process for each core, spinning threads made the tests take three times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
SOURCE = Path(__file__).resolve().parents[1] / "src"
# numba compiles plain functions only: its modules keep out of the hook's reach, and packages with them.
install_import_hook(
    [
        ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        for path in SOURCE.glob("querysplat_cli/**/[a-z]*.py")
        if "import numba" not in path.read_text()
    ],
    "beartype.beartype",
)

# Where `CI` is set, pytest works out the whole difference of two values, which takes hours for those of two files.
for variable in ("CI", "BUILD_NUMBER"):
    os.environ.pop(variable, None)

hypothesis.settings.register_profile("querysplat", deadline=None, derandomize=True)
hypothesis.settings.load_profile("querysplat")

# `nohup` starts programs with SIGHUP ignored, a shell those in the background with SIGINT, and programs leave it so.
# Tests of these signals need them as they usually are.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)


def _found(variable: str) -> Path:
    reason = missing(variable)
    if reason:
        pytest.skip(reason)
    return location(variable)


@pytest.fixture(scope="session")
def real_photos() -> Path:
    """The folder of real photo sets, which is not part of the repository."""
    return _found(PHOTOS)


@pytest.fixture(scope="session")
def golden() -> Path:
    """The folder of fixtures of the released arithmetic, which is not part of the repository."""
    return _found(FIXTURES)
