"""Settings of SuperSplat's viewer state the camera in the middle of the list."""

import json
import math
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.scene.cameras import Cameras, project_points
from querysplat_cli.scene.formats.supersplat import TURNED, write_supersplat
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.transform import transform_gaussians

SIZES = ((200, 300), (300, 200), (300, 300))
TURN = torch.from_numpy(Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix())
PLACE = Sim3(2.5, TURN, torch.tensor([4.0, -1, 2]).double())


def scene(depth: float = 5.0) -> tuple[Gaussians, Cameras]:
    """Three cameras in one place with a principal point that is not in the middle, and one Gaussian before them."""
    w2c = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    w2c[:, :3, :3] = TURN
    w2c[:, :3, 3] = torch.tensor([0.3, -0.2, 1.0])
    K = torch.tensor([[400.0, 0, 130], [0, 410, 170], [0, 0, 1]], dtype=torch.float64).repeat(3, 1, 1)
    place = TURN.T @ (torch.tensor([0.5, 0.5, depth]).double() - w2c[0, :3, 3])
    one = Gaussians(
        place[None].float(), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1), torch.zeros(1, 1, 3)
    )
    return one, Cameras(w2c, K, 300, 300)


def written(path: Path, middle: int, frame: Sim3 | None = None, depth: float = 5.0) -> dict[str, torch.Tensor]:
    gaussians, cameras = scene(depth)
    write_supersplat(path, gaussians, cameras, tuple(SIZES[(middle - 1 + row) % 3] for row in range(3)), frame)
    pose = json.loads(path.read_text())["cameras"][0]["initial"]
    return {key: torch.tensor(value, dtype=torch.float64) for key, value in pose.items()}


@pytest.mark.parametrize("middle", range(3))
def test_the_viewer_looks_through_the_middle_of_the_picture(middle: int, tmp_path: Path) -> None:
    pose, (_, cameras) = written(tmp_path / "s.json", middle), scene()
    height, width = SIZES[middle]
    torch.testing.assert_close(TURNED * pose["position"], cameras.centres[1])
    target = (TURNED * pose["target"])[None]
    assert project_points(target, cameras.w2c[1], cameras.K[1])[0].tolist() == pytest.approx([width / 2, height / 2])
    assert float(cameras.local(target, 1)[0, 2]) == pytest.approx(5)
    longer, focal = (width, 400) if width > height else (height, 410)
    assert float(pose["fov"]) == pytest.approx(math.degrees(2 * math.atan(longer / 2 / focal)))


def test_the_frame_of_the_file_is_that_of_the_settings(tmp_path: Path) -> None:
    gaussians, cameras = scene()
    found = written(tmp_path / "s.json", 0, PLACE)
    there = transform_gaussians(gaussians, PLACE), cameras.transformed(PLACE)
    write_supersplat(tmp_path / "moved.json", *there, (SIZES[2], SIZES[0], SIZES[1]), None)
    moved = json.loads((tmp_path / "moved.json").read_text())["cameras"][0]["initial"]
    for key, value in found.items():
        assert value.tolist() == pytest.approx(moved[key], rel=1e-5)


@pytest.mark.parametrize("depth", [-5.0, 0.0])
def test_a_scene_behind_the_camera_still_has_a_view(depth: float, tmp_path: Path) -> None:
    pose, (_, cameras) = written(tmp_path / "s.json", 0, depth=depth), scene()
    assert float(cameras.local((TURNED * pose["target"])[None], 1)[0, 2]) > 0
