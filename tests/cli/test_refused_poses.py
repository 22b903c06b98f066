"""`querysplat poses` refuses what cannot be compared."""

import json
from pathlib import Path

import numpy as np
import pytest

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode


@pytest.fixture
def given(tmp_path: Path) -> Path:
    """A transforms.json of two cameras."""
    frames = [{"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(2)]
    file = tmp_path / "a.json"
    file.write_text(json.dumps({"w": 64, "h": 48, "fl_x": 50, "frames": frames}))
    return file


def test_a_plot_that_cannot_be_written_is_refused_ahead_of_colmap(
    given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["poses", str(given), "--colmap", "--plot", str(given / "a.svg")]) == ExitCode.BAD_INPUT
    assert "a file is where a folder is needed" in capsys.readouterr().err  # not that photos for COLMAP are missing
    assert run(["poses", str(given), "--colmap", "--plot", str(tmp_path / "new" / "a.svg")]) == ExitCode.BAD_INPUT
    assert not (tmp_path / "new").exists()


def test_gaussians_in_place_of_cameras_are_refused_in_words(
    given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply")
    assert run(["poses", str(given), str(tmp_path / "a.ply")]) == ExitCode.BAD_INPUT
    assert "a.ply has Gaussians, and no cameras" in capsys.readouterr().err
