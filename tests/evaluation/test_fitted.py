"""Target cameras that are fitted to a frozen scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.evaluation.fitted import fitted_photo_camera
from querysplat_cli.evaluation.protocol import photograph
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.pictures import eight_bit
from querysplat_cli.scene.views import Photo

SIZE = 48, 64


def blobs(unit: float) -> Gaussians:
    """Coloured blobs in front of the origin, `unit` away."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(60, 3, generator=generator) * torch.tensor([1.4, 1.0, 0.6]) + torch.tensor([-0.7, -0.5, 0.8])
    return Gaussians(
        unit * means,
        torch.tensor([1.0, 0, 0, 0]).repeat(60, 1),
        torch.full((60, 3), 0.08 * unit),
        torch.full((60,), 0.95),
        torch.randn(60, 1, 3, generator=generator),
    )


@pytest.mark.parametrize(("unit", "lens"), [(1.0, (0.05, -0.02, 0.0, 0.0)), (40.0, (0.0, 0.0, 0.0, 0.0))])
def test_a_wrong_camera_finds_back(unit: float, lens: tuple[float, float, float, float]) -> None:
    """Through a lens that distorts, and in a scene of another unit. The Gaussians do not change."""
    scene = blobs(unit)
    true = PhotoCamera(np.eye(4), (60.0, 60.0), (32.0, 24.0), lens, *SIZE)
    photo = Photo("a.png", Path("a.png"), eight_bit(photograph(scene, true)))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [1.0, -1.5, 1.0], degrees=True).as_matrix()
    pose[:3, 3] = np.array([0.02, -0.01, 0.02]) * unit
    wrong = replace(true, w2c=pose, focal=(62.0, 62.0))
    before = scene.means.clone()
    found = fitted_photo_camera(scene, wrong, photo, max(SIZE))

    def error(camera: PhotoCamera) -> float:
        return float((photograph(scene, camera) - photograph(scene, true)).square().mean())

    assert error(found) < 0.1 * error(wrong)
    assert found.distortion == lens
    assert torch.equal(scene.means, before)
