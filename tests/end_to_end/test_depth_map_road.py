"""Photos with depth maps through the command line: in a folder, and listed by a transforms.json."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rooms import PHOTOS, SMALL, take_photos

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode

FIRST = ["--tto", "0", "--max-size", "128"]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    take_photos(tmp_path / "photos", 3)
    return tmp_path / "photos"


def made(photos: Path, name: str, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, Any]:
    ply = photos.parent / f"{name}.ply"
    assert run(["reconstruct", str(photos), "-o", str(ply), "--json", *SMALL, *FIRST, *more]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


def centres(file: Path) -> np.ndarray:
    return np.array([frame["transform_matrix"] for frame in json.loads(file.read_text())["frames"]])[:, :3, 3]


def test_the_maps_of_another_scene_of_the_same_photos_are_used(
    photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`render --float-depth` writes maps that `--depth-maps` reads, and a file of their cameras can list them."""
    plain = made(photos, "plain", capsys)
    assert plain["depth_maps"] is None
    maps = photos.parent / "maps"
    scene = photos.parent / "plain.ply"
    assert run(["render", str(scene), "-o", str(maps), "--cameras", "inputs", "--float-depth", "-q"]) == 0
    for file in maps.glob("*_depth.npy"):
        np.save(file, 12.5 * np.load(file))
    found = made(photos, "found", capsys, "--depth-maps", str(maps), "--scale", "depth")
    assert found["depth_maps"]["given"] == found["depth_maps"]["used"] == PHOTOS
    assert found["depth_maps"]["difference"] < 0.03
    assert found["quality"]["input"]["psnr"] > plain["quality"]["input"]["psnr"] - 0.5

    assert found["scale"]["source"] == "depth"
    one, other = (centres(scene.parent / name / "cameras.json") for name in ("plain", "found"))
    ratio = np.linalg.norm(other[1:] - other[0], axis=1) / np.linalg.norm(one[1:] - one[0], axis=1)
    np.testing.assert_allclose(ratio, 12.5, rtol=0.02)

    cameras = json.loads((maps / "cameras.json").read_text())
    for frame in cameras["frames"]:
        frame["depth_file_path"] = f"{Path(frame['file_path']).stem}_depth.npy"
    (maps / "transforms.json").write_text(json.dumps(cameras))
    listed = made(photos, "listed", capsys, "--poses", str(maps / "transforms.json"))
    assert listed["depth_maps"]["used"] == PHOTOS


def test_maps_of_nothing_are_named_and_not_used(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps = photos / "depth"
    maps.mkdir()
    chance = np.random.default_rng(0)
    for file in photos.glob("*.png"):
        cv2.imwrite(str(maps / f"{file.stem}.png"), chance.integers(1, 60000, (30, 40), np.uint16))
    report = made(photos, "wrong", capsys, "--depth-maps", str(maps), "--scale", "depth")
    assert report["depth_maps"] == {"given": PHOTOS, "used": 0, "difference": None, "per_unit": None}
    assert report["views"]["left_out"] == []
    assert report["scale"] is None
    assert "the depth maps have no common unit, so lengths are not in metres" in report["warnings"]
    assert any("depth maps that do not fit what the photos show" in warning for warning in report["warnings"])


def test_folders_without_maps_and_encoders_with_depth_of_their_own_are_refused(
    photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reconstruct", str(photos), "-o", str(photos.parent / "a.ply"), "--depth-maps"]
    assert run([*command, str(photos.parent)]) == ExitCode.BAD_INPUT
    assert "no map of any of the" in capsys.readouterr().err
    assert run([*command, str(photos.parent / "none")]) == ExitCode.BAD_INPUT
    assert "no such folder" in capsys.readouterr().err
    assert run([*command[:-1], "--scale", "depth"]) == ExitCode.BAD_INPUT
    assert "there are no depth maps" in capsys.readouterr().err
    assert not (photos.parent / "a.ply").exists()
