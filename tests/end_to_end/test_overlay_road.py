"""Photos with text over them through the command line: `--overlays auto` and `off`."""

import json
from pathlib import Path
from typing import Any

import cv2
import pytest
from rooms import HEIGHT, PHOTOS, SMALL, WIDTH, take_photos

from querysplat_cli.cli import run
from querysplat_cli.scene.masks import Overlay

TEXT = {"fontFace": cv2.FONT_HERSHEY_SIMPLEX, "fontScale": 0.77, "lineType": cv2.LINE_AA}


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A room, and in all photos the same text, white in a black outline, over the middle and at the bottom."""
    for file in take_photos(tmp_path / "photos", 3):
        picture = cv2.imread(str(file))
        for place in ((28, 126), (105, 224)):
            for colour, thickness in (((0, 0, 0), 6), ((255, 255, 255), 2)):
                cv2.putText(picture, "2024-05-01 12:30", place, color=colour, thickness=thickness, **TEXT)  # type: ignore[call-overload]
        cv2.imwrite(str(file), picture)
    return tmp_path / "photos"


def made(photos: Path, name: str, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, Any]:
    ply = photos.parent / f"{name}.ply"
    assert run(["reconstruct", str(photos), "-o", str(ply), "--json", *SMALL, "--tto", "6", *more]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


def test_text_over_photos_takes_no_part(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    auto = made(photos, "auto", capsys)
    off = made(photos, "off", capsys, "--overlays", "off", "--max-size", "96", "--tto", "0")
    assert len(auto["views"]["used"]) == PHOTOS
    (entry,) = [each for each in auto["left_out"] if each["what"] == "overlays"]
    assert f"{PHOTOS} photos" in entry["why"]
    assert not [each for each in off["left_out"] if each["what"] == "overlays"]

    listed, without = (
        json.loads((photos.parent / each / "photos.json").read_text())["photos"] for each in ("auto", "off")
    )
    assert len(listed) == PHOTOS
    for each in listed:
        hidden = ~Overlay(tuple(map(tuple, each["overlay"]["boxes"]))).shown(HEIGHT, WIDTH)
        assert hidden[109:126, 32:220].mean() > 0.85
        assert hidden[207:224, 109:297].mean() > 0.85
        assert hidden[:91].mean() < 0.01
    assert not any("overlay" in each for each in without)
