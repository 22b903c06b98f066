"""A current folder whose name is no text is refused before native libraries crash on it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform != "linux", reason="names of other systems are text")
def test_a_folder_whose_name_is_not_utf_8(tmp_path: Path) -> None:
    folder = os.fsencode(tmp_path) + b"/f\xe4"
    try:
        os.mkdir(folder)
    except OSError:
        pytest.skip("this file system has no such names")
    command = [sys.executable, "-m", "querysplat_cli", "info", "s.ply"]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60)
    assert found.returncode == 2
    assert "the name of the current folder is not valid UTF-8" in " ".join(found.stderr.split())
