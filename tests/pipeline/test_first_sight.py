"""Scenes are written upright, around the origin, and with the photos where viewers look from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.pipeline.first_sight import upright_frame
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.formats.transforms import read_cameras, read_working_cameras, write_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import look_at
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.splat.transform import transform_gaussians

MIDDLE = torch.tensor([1.0, 2.0, 3.0])
CAMERA = Cameras(torch.eye(4)[None], torch.tensor([[[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]]), 240, 320)
DEGREES = np.array([-50.0, -20.0, 0.0, 15.0, 60.0])


def ring(degrees: np.ndarray) -> Cameras:
    """Cameras around MIDDLE, all looking at it, a little above it; the world's y points down."""
    a = np.deg2rad(degrees)
    places = np.stack([4 * np.sin(a), np.full_like(a, -1.0), -4 * np.cos(a)], 1) + MIDDLE.numpy()
    return look_at(places, MIDDLE.double().numpy(), np.array([0.0, -1.0, 0.0]), CAMERA)


def cloud(degree: int = 1) -> Gaussians:
    random = torch.Generator().manual_seed(1)
    return Gaussians(
        torch.randn(400, 3, generator=random) * 0.5 + MIDDLE,
        torch.randn(400, 4, generator=random),
        torch.rand(400, 3, generator=random) * 0.1 + 0.02,
        torch.rand(400, generator=random),
        torch.randn(400, (degree + 1) ** 2, 3, generator=random) * 0.3,
    )


def anyhow(seed: int) -> Sim3:
    turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return Sim3(0.5 + seed, turn, torch.tensor([4.0, -seed, 2.0]).double())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_any_frame_becomes_the_same(seed: int) -> None:
    moved = anyhow(seed)
    cameras, scene = ring(DEGREES).transformed(moved), transform_gaussians(cloud(), moved)
    frame = upright_frame(scene, cameras)
    placed, there = cameras.transformed(frame), transform_gaussians(scene, frame)
    middle = there.means[there.opacities >= 0.5].median(0).values
    assert float(middle.norm()) < 0.1
    assert abs(float(placed.centres.norm(dim=1).median()) / PIPELINE_POLICY.first_sight_distance - 1) < 0.05
    assert (placed.w2c[:, 1, 1] > 0.9).all()  # y points down in every picture
    assert placed.w2c[:, 0, 1].abs().max() < 0.01  # and x is level
    x, _, z = placed.centres.numpy().T
    azimuth = np.rad2deg(np.unwrap(np.arctan2(z, x)))
    # The photo at 0° is in the middle of all. The others keep their order around the scene.
    np.testing.assert_allclose(azimuth[2], PIPELINE_POLICY.first_sight_azimuth, atol=3)
    assert (np.diff(azimuth) > 0).all() or (np.diff(azimuth) < 0).all()


def test_photos_that_look_straight_down_stand_below_the_middle_of_their_picture() -> None:
    """The viewer stands where the lower border of the picture is, as the photographer did."""
    down = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 4], [0, 0, 0, 1]])  # looks along −y of a z-up world
    cameras = Cameras(down[None], CAMERA.K, 240, 320)
    placed = cameras.transformed(upright_frame(replace(cloud(), means=cloud().means - MIDDLE), cameras))
    assert placed.w2c.isfinite().all()
    assert abs(float(placed.centres.norm()) / PIPELINE_POLICY.first_sight_distance - 1) < 0.1


def test_cameras_that_all_stand_in_the_middle_have_no_distance_to_it() -> None:
    places = np.zeros((4, 3)) + MIDDLE.numpy()
    around = np.array([[1.0, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])
    cameras = look_at(places, MIDDLE.numpy() + around, np.array([0.0, -1, 0]), CAMERA)
    point = replace(cloud(), means=MIDDLE.expand(400, 3).contiguous())
    frame = upright_frame(point, cameras)
    assert 0 < frame.scale < np.inf
    assert cameras.transformed(frame).w2c.isfinite().all()


def psnr(one: torch.Tensor, other: torch.Tensor) -> float:
    return float(-10 * (one - other).square().mean().log10())


def test_the_files_show_what_the_scene_showed(tmp_path: Path) -> None:
    """Renders agree to 60 dB, spherical harmonics included, and the scene is read back where it was made."""
    cameras, scene = ring(DEGREES).transformed(anyhow(5)), transform_gaussians(cloud(degree=3), anyhow(5))
    frame = upright_frame(scene, cameras)
    write_ply(tmp_path / "s.ply", transform_gaussians(scene, frame))
    empty = torch.zeros(5, 3, 240, 320)
    names = tuple(f"{i}.png" for i in range(5))
    views = Views(empty, torch.ones(5, 240, 320, dtype=torch.bool), names, ((240, 320),) * 5)
    write_cameras(tmp_path / "cameras.json", cameras, views, frame=frame)
    expected = render(scene, cameras).colour
    assert float(expected.std()) > 0.05
    there = read_cameras(tmp_path / "cameras.json")[0].cameras
    assert psnr(render(read_ply(tmp_path / "s.ply"), there).colour, expected) > 60
    back, _, found = read_working_cameras(tmp_path / "cameras.json")
    assert found is not None
    again = transform_gaussians(read_ply(tmp_path / "s.ply"), found.inverse())
    torch.testing.assert_close(again.means, scene.means, atol=1e-4, rtol=1e-5)
    assert psnr(render(again, back.cameras).colour, expected) > 60
