"""Photos of other exposures through the command line: `--exposure auto` and `off`, and a scene that is resumed."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from querysplat_cli.cli import run
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

SMALL = ["--max-size", "192", "--tto", "16", "--quiet", "--json", "--holdout-every", "3", "--holdout-cameras", "joint"]
GAINS = (1.0, 0.75, 1.2, 1.0, 0.8, 1.15, 1.0)
"""Of each photo, in sRGB. Photos 0, 3 and 6 are held out."""


def photos(folder: Path, gains: tuple[float, ...] = (1.0,) * 7) -> Path:
    """Seven photos of a procedural room that is not brighter than 0.8, 448 × 336."""
    folder.mkdir(parents=True)
    room = make_room(3)
    cameras = walk(room, 7, 3)
    for i, gain in enumerate(gains):
        picture = cast(room, cameras[[i]], samples=1)[0][0].permute(1, 2, 0).numpy()[..., ::-1] * 0.8 * gain
        cv2.imwrite(str(folder / f"{i}.png"), (picture * 255).round().clip(0, 255).astype(np.uint8))
    return folder


def made(folder: Path, name: str, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[Path, dict[str, Any]]:
    ply = folder.parent / f"{name}.ply"
    assert run(["reconstruct", str(folder), "-o", str(ply), *SMALL, *more]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return ply, report


@pytest.mark.slow
def test_photos_that_agree_need_no_transforms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scene is then the same, byte for byte, as without the comparison."""
    folder = photos(tmp_path / "photos")
    auto, report = made(folder, "auto", capsys, "--tto", "2")
    off, without = made(folder, "off", capsys, "--exposure", "off", "--tto", "2")
    assert report["exposure"]["corrected"] is False
    assert report["exposure"]["disagreement"] < 0.03
    assert without["exposure"] is None
    assert auto.read_bytes() == off.read_bytes()
    assert not (auto.with_suffix("") / "exposures.json").exists()


def test_photos_that_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = photos(tmp_path / "photos", GAINS)
    auto, report = made(folder, "auto", capsys)
    _, without = made(folder, "off", capsys, "--exposure", "off")
    assert report["exposure"]["corrected"] is True
    with_, off = (found["quality"]["heldout"] for found in (report, without))
    assert with_["psnr_cc"] > off["psnr_cc"] + 0.3
    assert report["quality"]["input"]["psnr_cc"] > report["quality"]["input"]["psnr"] + 3

    stored = json.loads((auto.with_suffix("") / "exposures.json").read_text())["photos"]
    assert [entry["name"] for entry in stored] == report["views"]["used"]
    gains = np.array([np.array(entry["matrix"])[:, :3].sum(1).mean() for entry in stored])
    expected = np.array([GAINS[int(Path(entry["name"]).stem)] for entry in stored])
    np.testing.assert_allclose(gains, expected / expected.mean(), atol=0.08)

    shutil.copytree(auto.with_suffix(""), tmp_path / "again")
    shutil.copy(auto, tmp_path / "again.ply")
    assert run(["tto", str(tmp_path / "again.ply"), "--steps", "6", "--json", "-q"]) == 0
    resumed = json.loads(capsys.readouterr().out)
    assert resumed["quality"]["input"]["psnr_cc"] > report["quality"]["input"]["psnr_cc"] - 0.05
    assert (tmp_path / "again" / "exposures.json").exists()

    assert run(["tto", str(tmp_path / "again.ply"), "--steps", "6", "--exposure", "off", "--json", "-q"]) == 0
    dropped = json.loads(capsys.readouterr().out)
    assert dropped["exposure"]["corrected"] is False
    assert not (tmp_path / "again" / "exposures.json").exists()
