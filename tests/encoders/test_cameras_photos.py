"""Real photos: every photo gets a camera, and the camera is right where the truth is known."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import CameraRequest, PosedViews
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.search import AUTOMATIC, MatcherChoice
from querysplat_cli.evaluation.cameras import cameras_by_name
from querysplat_cli.evaluation.poses import compare_cameras
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.sim3 import align_cameras
from querysplat_cli.scene.views import Photo

FOLDERS = {"fox": "dl3dv/fox/images_4"}


def photos(data: Path, name: str) -> list[Photo]:
    files = sorted((data / FOLDERS.get(name, f"{name}/images")).iterdir())
    return [Photo(file.name, file, cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)) for file in files]


def place(chosen: list[Photo], choice: MatcherChoice = AUTOMATIC) -> PosedViews:
    return estimate_cameras(chosen, CameraRequest(448, seed=42), silent, choice)


def evenly(items: list[Photo], count: int) -> list[Photo]:
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


@pytest.mark.slow
@pytest.mark.parametrize("part", ["all", "inputs"])
@pytest.mark.parametrize("name", ["fortress", "dtu106", "sceaux", "kermit", "riverview"])
def test_every_photo_is_placed(real_photos: Path, name: str, part: str) -> None:
    everything = photos(real_photos, name)
    chosen = [photo for i, photo in enumerate(everything) if part == "all" or i % 4]
    found = place(chosen)
    assert found.views.names == tuple(photo.name for photo in chosen)
    assert not found.warnings
    assert len(found.points) > 500


@pytest.mark.slow
@pytest.mark.parametrize(("count", "degrees", "extent"), [(12, 0.8, 0.01), (4, 7, 0.06)])
def test_fox_has_the_cameras_of_its_transforms(real_photos: Path, count: int, degrees: float, extent: float) -> None:
    """Bounds on the largest errors. Four photos a quarter turn apart are placed roughly."""
    found = place(evenly(photos(real_photos, "fox"), count))
    assert len(found.views) == count
    frames = json.loads((real_photos / "dl3dv/fox/transforms.json").read_text())["frames"]
    poses = {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in frames}
    c2w = np.stack([poses[Path(name).stem] @ np.diag([1, -1, -1, 1]) for name in found.views.names])
    truth = torch.from_numpy(np.linalg.inv(c2w))
    similarity = align_cameras(found.cameras.w2c.double(), truth)
    cameras = found.cameras.to(torch.float64).transformed(similarity)
    turn = cameras.w2c[:, :3, :3] @ truth[:, :3, :3].mT - torch.eye(3)
    centres = torch.from_numpy(c2w[:, :3, 3])
    assert float(torch.rad2deg(2 * torch.asin(turn.flatten(1).norm(dim=1) / 8**0.5)).max()) < degrees
    assert float(((cameras.centres - centres).norm(dim=1) / torch.pdist(centres).max()).max()) < extent


def test_two_photos_whose_matches_leave_two_poses(real_photos: Path) -> None:
    """Both poses explain the matches; the wrong one, 40° off, costs less."""
    taken = photos(real_photos, "fox")
    found = place([taken[15], taken[27]], MatcherChoice("sift"))
    known = read_known_cameras(real_photos / "dl3dv/fox/transforms.json")
    errors = compare_cameras(cameras_by_name(found), {name: known[name] for name in found.views.names})
    assert abs(float(errors.pair_rotation[0])) < 3
    assert abs(float(errors.pair_translation[0])) < 3


def test_a_photo_that_few_photos_lack_is_searched_again(real_photos: Path) -> None:
    """Enough matches determine the cameras of three. The fourth photo had none, and was left out."""
    taken = photos(real_photos, "fox")
    found = place([taken[i] for i in (3, 11, 27, 36)])
    assert len(found.views) == 4


def test_the_middles_of_photos_keep_the_focal_length_that_exif_states(real_photos: Path) -> None:
    """Whole photos of fortress determine it. The middles of five do not: 1.7 times as much was found."""
    whole = photos(real_photos, "fortress")
    determined = place(whole, MatcherChoice("sift")).photo_cameras
    assert determined
    focal = determined[0].focal[0]
    height, width = whole[0].pixels.shape[:2]
    rows, columns = slice(height // 5, height - height // 5), slice(width // 5, width - width // 5)
    middles = [replace(each, pixels=each.pixels[rows, columns].copy(), focal=focal) for each in evenly(whole, 5)]
    found = place(middles, MatcherChoice("sift"))
    assert found.photo_cameras
    assert len(found.views) == 5
    assert found.photo_cameras[0].focal[0] == pytest.approx(focal, rel=0.03)


@pytest.mark.slow
def test_a_drone_that_looks_straight_down_keeps_the_focal_length_that_exif_states(real_photos: Path) -> None:
    """From above a plain nothing else determines it: without a prior it was found 30 % longer."""
    taken, _ = load_photos(find_photos([real_photos / "highres" / "brighton"]))
    found = place(taken)
    assert len(found.views) == len(taken)
    assert not found.warnings
    assert found.photo_cameras is not None
    for photo, camera in zip(taken, found.photo_cameras, strict=True):
        assert photo.focal is not None
        stated = photo.focal / max(photo.pixels.shape)
        assert camera.focal[0] / max(camera.height, camera.width) == pytest.approx(stated, rel=0.05)
