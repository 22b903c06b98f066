"""Shared fixtures. Every jaxtyping annotation of the package is checked while the tests run."""

from pathlib import Path

import hypothesis
import pytest
from jaxtyping import install_import_hook

install_import_hook("querysplat_cli", "beartype.beartype")

hypothesis.settings.register_profile("querysplat", deadline=None, derandomize=True)
hypothesis.settings.load_profile("querysplat")

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def real_photos() -> Path:
    """The folder of real photo sets, which is not part of the repository."""
    if not DATA.is_dir():
        pytest.skip(f"no real photos at {DATA}")
    return DATA
