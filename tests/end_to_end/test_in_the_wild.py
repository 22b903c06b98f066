"""One, two, five and twenty photos of one place each become a scene (docs/applications.md)."""

import json
import sys
from pathlib import Path

import pytest

from querysplat_cli.cli import run

sys.path.insert(0, str(Path(__file__).parents[1] / "evaluation"))
from evaluation_scenes import write_room


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    home = tmp_path_factory.mktemp("data") / "place"
    write_room(home, 20, size=224)
    return sorted((home / "images_4").iterdir())


SLOW = pytest.mark.slow


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=SLOW), 5, pytest.param(20, marks=SLOW)])
def test_any_number_of_photos_becomes_a_scene(
    count: int, photos: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All photos are placed, and the scene shows them."""
    inputs = [str(photo) for photo in photos[:count]]
    options = ["--quality", "draft", "--tto", "4", "--json", "-q"]
    assert run(["reconstruct", *inputs, "-o", str(tmp_path / "scene.ply"), *options]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["views"]["used"]) == count
    assert report["quality"]["input"]["psnr"] > 18
    assert (tmp_path / "scene.ply").stat().st_size > 10_000
