"""`querysplat render` of a scene far from the origin of its files."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.transforms import write_transforms
from querysplat_cli.scene.gaussians import SH_0, Gaussians

FAR = 2.0**21
"""Where float32 has steps of a quarter."""


def write_scene(folder: Path, shift: float, listing: str) -> Path:
    """A white ball at (0, 0, 4) and two cameras before it, all of them moved along each axis."""
    means = torch.tensor([[0.0, 0, 4]]) + shift
    turn, sh = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 1, 3), 0.5 / SH_0)
    write_ply(folder / "ball.ply", Gaussians(means, turn, torch.full((1, 3), 0.2), torch.tensor([0.999]), sh))
    cameras = {}
    for name, x in (("left.jpg", -0.1), ("right.jpg", 0.1)):
        w2c = np.eye(4)
        w2c[:3, 3] = -(np.array([x, 0.1, 0]) + shift)
        cameras[name] = PhotoCamera(w2c, (60.0, 60.0), (32.0, 24.0), (0.0, 0.0, 0.0, 0.0), 48, 64)
    (folder / listing).parent.mkdir(exist_ok=True)
    write_transforms(folder / listing, cameras)
    return folder / "ball.ply"


@pytest.mark.parametrize(
    ("listing", "options"),
    [
        ("ball/cameras.json", []),
        ("ball/cameras.json", ["--cameras", "orbit", "--frames", "2"]),
        ("given.json", ["--cameras", "given.json"]),
        ("given.json", ["--frames", "2", "--size", "64x48"]),
    ],
)
def test_a_scene_may_lie_far_from_its_origin(
    listing: str, options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in UTM: cameras stood where float32 has a place."""
    monkeypatch.chdir(tmp_path)
    pictures = []
    for shift in (0.0, FAR):
        scene, out = write_scene(tmp_path, shift, listing), tmp_path / f"frames{shift}"
        assert run(["render", str(scene), "-o", str(out), *options, "-q"]) == 0
        pictures.append([cv2.imread(str(path)) for path in sorted(out.glob("*.png"))])
    assert len(pictures[0]) == 2
    assert max(picture.max() for picture in pictures[0]) > 100
    np.testing.assert_allclose(pictures[0], pictures[1], atol=2)
