"""Where data lies that is not part of the repository: environment variables, and folders beside the checkout."""

import os
from pathlib import Path

PHOTOS = "QUERYSPLAT_DATA"
"""Names the folder of the real photo sets."""
FIXTURES = "QUERYSPLAT_GOLDEN"
"""Names the folder of the fixtures of the released arithmetic."""
BESIDE = Path(__file__).resolve().parents[3] / "shared"
DEFAULTS = {PHOTOS: BESIDE / "data", FIXTURES: BESIDE / "golden"}
"""Where each of them lies unless the variable is set: in `shared`, beside the checkout."""


def location(variable: str) -> Path:
    """The folder that the environment names, or the default; it need not exist."""
    named = os.environ.get(variable)
    return Path(named) if named else DEFAULTS[variable]


def missing(variable: str) -> str | None:
    """Why the folder cannot be used, or None where it is there."""
    folder = location(variable)
    return None if folder.is_dir() else f"no folder {folder}: let {variable} name the one to read"
