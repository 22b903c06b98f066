"""A scene of known cameras stands in their frame and their units, in every file and picture."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.pipeline.read_scene import read_scene, read_scene_gaussians
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_cameras, working_frame
from querysplat_cli.scene.formats.transforms_frame import opengl_from_opencv
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.training.photographer import walk
from querysplat_cli.training.rooms import make_room

COUNT = 4
MOVED = Sim3(
    30.0,
    quaternion_to_matrix(torch.tensor([[0.8, 0.1, -0.5, 0.3]], dtype=torch.float64) / 0.99**0.5)[0],
    torch.tensor([100.0, -40.0, 700.0], dtype=torch.float64),
)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Photos of a room with their true cameras, which are scaled, turned and shifted; and the centres of these."""
    folder = tmp_path_factory.mktemp("given")
    take_photos(folder / "photos", 3, COUNT)
    cameras = walk(make_room(3), COUNT, 3)
    moved = cameras.to(torch.float64).transformed(MOVED)
    frames = [
        {
            "file_path": f"room3_{i}.png", "w": cameras.width, "h": cameras.height,
            "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2]),
            "transform_matrix": opengl_from_opencv(w2c.numpy()).tolist(),
        }
        for i, (K, w2c) in enumerate(zip(cameras.K, moved.w2c, strict=True))
    ]  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder, moved.centres.numpy()


@pytest.fixture(scope="module")
def scene(given: tuple[Path, np.ndarray]) -> tuple[Path, dict[str, Any]]:
    folder, _ = given
    command = ["reconstruct", str(folder / "photos"), "-o", str(folder / "s.ply"), "-q", "--max-size", "160"]
    assert run([*command, "--poses", str(folder / "transforms.json"), "--tto", "4", "--no-refine-cameras"]) == 0
    return folder / "s.ply", json.loads((folder / "s" / "report.json").read_text())


def centres(ply: Path) -> np.ndarray:
    frames = json.loads((ply.with_suffix("") / "cameras.json").read_text())["frames"]
    return np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]


def test_the_cameras_are_the_given_ones(given: tuple[Path, np.ndarray], scene: tuple[Path, dict[str, Any]]) -> None:
    wanted, found = given[1], centres(scene[0])
    extent = np.linalg.norm(wanted - wanted.mean(0), axis=1).max()
    assert np.abs(found - wanted).max() < 1e-4 * extent
    frame = working_frame(scene[0].with_suffix("") / "cameras.json")
    assert frame is not None
    assert frame.scale > 5
    stored, _ = read_scene(scene[0])
    torch.testing.assert_close(stored.cameras.w2c[0], torch.eye(4), atol=1e-5, rtol=0)  # where numerics want it


def test_renders_of_the_files_have_the_reported_score(scene: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    ply, report = scene
    assert run(["render", str(ply), "-o", str(tmp_path / "frames"), "--depth", "-q"]) == 0
    depth = []
    for name, quality in report["quality"]["input"]["views"].items():
        photo = cv2.imread(str(ply.with_suffix("") / "images" / name)).astype(float)
        picture = cv2.imread(str(tmp_path / "frames" / f"{Path(name).stem}.png")).astype(float)
        psnr = 10 * np.log10(255**2 / np.mean((photo - picture) ** 2))
        assert psnr == pytest.approx(quality["psnr"], abs=0.1)
        depth.append(cv2.imread(str(tmp_path / "frames" / f"{Path(name).stem}_depth.png"), cv2.IMREAD_UNCHANGED))
    inputs = read_cameras(ply.with_suffix("") / "cameras.json")[0].cameras
    means = read_ply(ply).means
    z = torch.einsum("vj,nj->vn", inputs.w2c[:, 2, :3], means) + inputs.w2c[:, 2, 3:]
    ahead = z[z > 0]
    measured = np.stack(depth)
    measured = measured[(measured > 0) & (measured < 65535)] / 1000
    assert 0.5 < np.median(measured) / min(65.5, float(ahead.median())) < 2  # in the units of the given cameras


def test_tto_keeps_the_frame(
    given: tuple[Path, np.ndarray], scene: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """Optimised in features and then in Gaussian space, which reads the .ply; the copy is what the report names."""
    ply = Path(shutil.copy(scene[0], tmp_path / "copy.ply"))
    shutil.copytree(scene[0].with_suffix(""), ply.with_suffix(""))
    before = scene[1]["quality"]["input"]["psnr"]
    for space in ("features", "gaussians", "gaussians"):
        assert run(["tto", str(ply), "--space", space, "--steps", "2", "-q"]) == 0
    np.testing.assert_allclose(centres(ply), centres(scene[0]), rtol=1e-5)
    report = json.loads((ply.with_suffix("") / "report.json").read_text())
    assert (report["ply"], report["scene"]) == (str(ply), str(ply.with_suffix("")))
    assert report["quality"]["input"]["psnr"] > before - 0.1
    stored, _ = read_scene(ply)
    near = read_scene_gaussians(ply, stored).means
    assert near.median(0).values.norm() < 5 < read_ply(ply).means.median(0).values.norm()


def test_one_camera_is_enough(given: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    folder, wanted = given
    command = ["reconstruct", str(folder / "photos" / "room3_1.png"), "-o", str(tmp_path / "one.ply"), "-q"]
    assert run([*command, "--poses", str(folder / "transforms.json"), "--tto", "0", "--max-size", "96"]) == 0
    np.testing.assert_allclose(centres(tmp_path / "one.ply")[0], wanted[1], rtol=1e-6)
