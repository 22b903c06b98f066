"""A room and its scene, which the tests of this folder read."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rooms import SMALL, take_photos


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "photos"
    take_photos(folder, 3)
    return folder


@pytest.fixture(scope="session")
def scene(room: Path) -> tuple[Path, dict[str, Any]]:
    """A scene with every third photo held out, and the report that was printed."""
    ply = room.parent / "scene.ply"
    command = [sys.executable, "-m", "querysplat_cli", "reconstruct", str(room), "-o", str(ply)]
    done = subprocess.run(
        [*command, "--holdout-every", "3", "--json", *SMALL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return ply, json.loads(done.stdout)
