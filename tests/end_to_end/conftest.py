"""A room and its scene, which the tests of this folder read."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from rooms import SMALL, take_photos


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """A folder that all processes of a test run see."""
    own = tmp_path_factory.getbasetemp()
    return own if worker_id == "master" else own.parent


@pytest.fixture(scope="session")
def room(shared: Path) -> Path:
    folder = shared / "room" / "photos"
    with FileLock(shared / "photos.lock"):
        if not folder.is_dir():
            take_photos(folder, 3)
    return folder


@pytest.fixture(scope="session")
def scene(room: Path, shared: Path) -> tuple[Path, dict[str, Any]]:
    """A scene with every third photo held out, and the report that was printed."""
    ply, printed = room.parent / "scene.ply", shared / "printed.json"
    with FileLock(shared / "scene.lock"):
        if not printed.is_file():
            printed.write_text(_made(room, ply))
    return ply, json.loads(printed.read_text())


def _made(room: Path, ply: Path) -> str:
    command = [sys.executable, "-m", "querysplat_cli", "reconstruct", str(room), "-o", str(ply)]
    done = subprocess.run(
        [*command, "--holdout-every", "3", "--json", *SMALL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout
