"""The kernel against the float64 reference on a real scene."""

from dataclasses import replace
from pathlib import Path

import pytest
from splat_scenes import assert_agree

from querysplat_cli.cli import run
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_cameras


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fortress", "kermit"])
def test_kernel_agrees_on_a_real_scene(name: str, real_photos: Path, tmp_path: Path) -> None:
    """A window of 32 × 24 pixels in the middle of the second photo, and the gradients of all visible Gaussians."""
    ply = tmp_path / "scene.ply"
    photos = str(real_photos / name / "images")
    assert run(["reconstruct", photos, "-o", str(ply), "--tto", "10", "--max-size", "240", "-q"]) == 0
    cameras = read_cameras(ply.with_suffix("") / "cameras.json")[0].cameras[[1]]
    K = cameras.K.clone()
    K[:, 0, 2] -= (cameras.width - 32) / 2
    K[:, 1, 2] -= (cameras.height - 24) / 2
    assert_agree(read_ply(ply), replace(cameras, K=K, width=32, height=24), depth=False)
