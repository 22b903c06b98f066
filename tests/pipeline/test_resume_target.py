"""A scene whose file cannot be written again is refused before anything is optimised."""

from pathlib import Path

import pytest
from stored_scene import a_report

from querysplat_cli.pipeline.resume import optimise_scene
from querysplat_cli.pipeline.resume_settings import ResumeSettings
from querysplat_cli.pipeline.scene_folder import StoredScene, write_scene
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.gaussians import Gaussians


def test_levels_of_detail_are_not_optimised(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    """`convert scene.ply small.lod` writes the folder `small` beside it."""
    write_scene(tmp_path / "small.ply", *stored, a_report())
    (tmp_path / "small.ply").unlink()
    (tmp_path / "small.lod").mkdir()
    with pytest.raises(QuerySplatError, match="levels of detail are not written here"):
        optimise_scene(ResumeSettings(tmp_path / "small.lod"))
