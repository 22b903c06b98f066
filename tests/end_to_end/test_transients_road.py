"""Photos through which somebody walks, through the command line: `--transients auto` and `off`."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from rooms import HEIGHT, PHOTOS, WIDTH, take_photos
from safetensors.torch import load_file

from querysplat_cli.cli import run

WALKERS = {2: 150, 4: 280}
"""Photos that show somebody, and the column of his middle."""


def figure(column: int) -> np.ndarray:
    """255 on somebody of two thirds of the picture's height [height, width]."""
    drawn = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.circle(drawn, (column, 120), 22, 255, -1)
    cv2.rectangle(drawn, (column - 32, 145), (column + 32, 240), 255, -1)
    cv2.rectangle(drawn, (column - 26, 240), (column + 26, HEIGHT), 255, -1)
    return drawn


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for number, file in enumerate(take_photos(tmp_path / "photos", 3)):
        if number in WALKERS:
            picture = cv2.imread(str(file))
            assert picture is not None
            picture[figure(WALKERS[number]) > 0] = (30, 200, 240)
            cv2.imwrite(str(file), picture)
    return tmp_path / "photos"


def made(photos: Path, name: str, *more: str) -> tuple[dict[str, Any], torch.Tensor]:
    """The report of a scene, and where its photos take part."""
    ply = photos.parent / f"{name}.ply"
    options = ["--max-size", "224", "--tto", "6", "--quiet", *more]
    assert run(["reconstruct", str(photos), "-o", str(ply), *options]) == 0
    report: dict[str, Any] = json.loads((photos.parent / name / "report.json").read_text())
    return report, load_file(photos.parent / name / "memories.safetensors")["masks"]


def test_who_walks_through_photos_takes_no_part(photos: Path) -> None:
    report, masks = made(photos, "auto")
    assert len(report["views"]["used"]) == PHOTOS
    (entry,) = [each for each in report["left_out"] if each["what"] == "transients"]
    assert f"in {len(WALKERS)} photos and not in the others" in entry["why"]
    for number, shown in enumerate(masks):
        if number in WALKERS:
            body = torch.from_numpy(cv2.resize(figure(WALKERS[number]), (224, 168)) > 127)
            assert (~shown[:168, :224])[body].float().mean() > 0.9
            assert (~shown[:168, :224])[~body].float().mean() < 0.05
        else:
            assert shown[:168, :224].float().mean() > 0.999


@pytest.mark.slow
def test_with_off_all_of_the_photos_takes_part(photos: Path) -> None:
    report, masks = made(photos, "off", "--transients", "off")
    assert not [each for each in report["left_out"] if each["what"] == "transients"]
    assert masks[:, :160, :220].all()
