"""Panoramas, fisheye photos, masks and metres, each from photos to a scene through the command line."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

pytestmark = pytest.mark.slow
SEED = 3
MADE = ["--max-size", "192", "--tto", "24", "--quality", "draft", "-q"]
FACE = 256
TURNS = ((0, 0), (0, 90), (0, 180), (0, 270), (90, 0), (-90, 0))
"""Degrees about x, then about y, of the faces of a cube."""


def wide(place: Cameras, directions: np.ndarray) -> np.ndarray:
    """The picture [height, width, 3] whose pixels look along `directions` [height, width, 3] from one camera, in BGR.

    Six square photos around the camera are resampled.
    """
    K = torch.tensor([[FACE / 2, 0, FACE / 2], [0, FACE / 2, FACE / 2], [0, 0, 1]])
    picture = np.zeros(directions.shape, np.float32)
    for lift, turn in TURNS:
        rotation = cv2.Rodrigues(np.radians([lift, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.radians([0.0, turn, 0.0]))[0]
        w2c = torch.eye(4, dtype=torch.float64)
        w2c[:3, :3] = torch.from_numpy(rotation)
        camera = Cameras((w2c @ place.w2c[0].double()).float()[None], K[None], FACE, FACE)
        face = cast(make_room(SEED), camera, samples=1)[0][0].permute(1, 2, 0).numpy()
        x, y, z = np.moveaxis(directions @ rotation.T, -1, 0)
        inside = (z > 0) & (np.maximum(abs(x), abs(y)) <= z * 1.001)
        ahead = np.where(inside, z, 1.0)
        places = ((part / ahead + 1) * FACE / 2 - 0.5 for part in (x, y))
        found = cv2.remap(
            face, *(part.astype(np.float32) for part in places), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
        )
        picture[inside] = found[inside]
    return np.rint(picture[..., ::-1] * 255).astype(np.uint8)


def made(folder: Path, photos: Path, *more: str) -> dict[str, Any]:
    ply = folder / "scene.ply"
    assert run(["reconstruct", str(photos), "-o", str(ply), *MADE, *more]) == ExitCode.DONE
    report: dict[str, Any] = json.loads((folder / "scene" / "report.json").read_text())
    return report


def test_panoramas(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    u, v = np.meshgrid((np.arange(800) + 0.5) / 800 * 2 - 1, (np.arange(400) + 0.5) / 400 - 0.5)
    turn, lift = u * np.pi, -v * np.pi
    directions = np.dstack([np.sin(turn) * np.cos(lift), -np.sin(lift), np.cos(turn) * np.cos(lift)])
    cameras = walk(make_room(SEED), 4, SEED)
    for number in range(4):
        cv2.imwrite(str(photos / f"{number}.png"), wide(cameras[[number]], directions))
    report = made(tmp_path, photos, "--lens", "equirectangular")
    assert len({name.split(".")[0][:1] for name in report["views"]["used"]}) >= 3
    assert len(report["views"]["used"]) >= 12
    assert report["quality"]["input"]["psnr"] > 18


def test_fisheye_photos_with_known_cameras(tmp_path: Path) -> None:
    photos, height, width, focal = tmp_path / "photos", 240, 320, 130.0
    photos.mkdir()
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    radius = np.hypot(x, y)
    angle = radius / focal  # an equidistant lens: all coefficients are 0
    directions = np.dstack([x / radius * np.sin(angle), y / radius * np.sin(angle), np.cos(angle)])
    cameras = walk(make_room(SEED), 7, SEED)
    frames = []
    for number in range(7):
        cv2.imwrite(str(photos / f"{number}.png"), wide(cameras[[number]], directions))
        pose = cameras[[number]].c2w[0].numpy() @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    content = {"camera_model": "OPENCV_FISHEYE", "w": width, "h": height, **lens, "frames": frames}
    poses = tmp_path / "transforms.json"
    poses.write_text(json.dumps(content))
    report = made(tmp_path, photos, "--poses", str(poses), "--holdout-every", "3")
    assert len(report["views"]["used"]) == 4
    assert report["quality"]["heldout"]["psnr"] > 18


def test_masks_and_metres(tmp_path: Path) -> None:
    """A white block is pasted into every photo and masked: the scene does not show it. Two cameras are 2 m apart."""
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    masks.mkdir()
    files = take_photos(photos, SEED)
    for number, file in enumerate(files):
        picture = cv2.imread(str(file))
        block = slice(120, 200), slice(40 + 45 * number, 130 + 45 * number)
        picture[block] = 255
        cv2.imwrite(str(file), picture)
        mask = np.full(picture.shape[:2], 255, np.uint8)
        mask[block] = 0
        cv2.imwrite(str(masks / f"{file.name}.png"), mask)
    report = made(tmp_path, photos, "--scale", f"{files[0].name},{files[-1].name}=2")
    assert report["scale"]["source"] == "distances"
    assert len(report["views"]["used"]) == 7
    assert report["quality"]["input"]["psnr"] > 20
    cameras = json.loads((tmp_path / "scene" / "cameras.json").read_text())["frames"]
    ends = [np.array(frame["transform_matrix"])[:3, 3] for frame in (cameras[0], cameras[-1])]
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(2, rel=1e-3)
