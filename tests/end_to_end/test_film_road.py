"""From a film to a scene, through the command line, and on from the scene folder."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rooms import take_photos

from film_files import write_film
from querysplat_cli.cli import run
from querysplat_cli.pipeline.full_size import stored_photos
from querysplat_cli.pipeline.read_scene import read_scene
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.films import film_size
from querysplat_cli.scene.formats.ply import read_ply

MADE = ["--max-size", "144", "--tto", "12", "-q"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A scene of a film that was turned by the phone, each picture shown twice; and its report."""
    folder = tmp_path_factory.mktemp("film")
    pictures = [cv2.imread(str(file))[..., ::-1] for file in take_photos(folder / "photos", 3)]
    lying = [np.rot90(picture, -1) for picture in pictures for _ in range(2)]
    shutil.rmtree(folder / "photos")
    write_film(folder / "walk.mp4", lying, rotation=90)
    ply = folder / "scene.ply"
    made = ["reconstruct", str(folder / "walk.mp4"), "-o", str(ply), "--holdout-every", "3", *MADE]
    assert run(made) == ExitCode.DONE
    return ply, json.loads((folder / "scene" / "report.json").read_text())


def test_the_frames_of_a_film_are_its_photos(scene: tuple[Path, dict[str, Any]]) -> None:
    ply, report = scene
    assert len(read_ply(ply)) == report["gaussians"]
    assert len(report["views"]["used"]) >= 4
    assert all(name.startswith("walk.mp4_000") for name in report["views"]["used"])
    (left_out,) = report["views"]["left_out"]
    assert left_out["name"] == "walk.mp4"
    assert re.fullmatch(r"[78] of its 14 frames: [78] close to those used", left_out["why"])
    assert report["quality"]["heldout"]["psnr"] > 12


def test_the_scene_folder_finds_the_frames_again(scene: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    folder = scene[0].with_suffix("")
    listed = json.loads((folder / "photos.json").read_text())["photos"]
    assert {entry["path"] for entry in listed} == {str(folder.parent / "walk.mp4")}
    assert len({entry["pts"] for entry in listed}) == len(listed)
    stored, _ = read_scene(folder)
    inputs, heldout = stored_photos(stored)
    assert heldout is not None
    assert (inputs.summary().height, inputs.summary().width) == film_size(folder.parent / "walk.mp4")
    large, _ = inputs.at(inputs.summary().width)
    for row in range(len(large)):
        (height, width), small = large.sizes[row], stored.views
        rows, columns = small.sizes[row]
        picture = large.picture(row)[:, :height, :width].permute(1, 2, 0).numpy()
        reduced = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA)
        same = small.picture(row)[:, :rows, :columns].permute(1, 2, 0).numpy()
        assert np.abs(reduced - same).mean() < 0.02


def test_a_film_that_is_gone(
    scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ply = scene[0]
    shutil.copytree(ply.with_suffix(""), tmp_path / "scene")
    shutil.copy(ply, tmp_path / "scene.ply")
    film = ply.parent / "walk.mp4"
    hidden = film.rename(film.with_suffix(".away"))
    try:
        assert run(["tto", str(tmp_path / "scene"), "--quality", "high", "-q"]) == ExitCode.BAD_INPUT
    finally:
        hidden.rename(film)
    assert "photos of this scene are gone" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"no film"], ids=["empty", "text"])
def test_what_is_no_film_is_refused_in_one_line(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "clip.mp4").write_bytes(content)
    assert run(["reconstruct", str(tmp_path / "clip.mp4"), "-o", str(tmp_path / "s.ply"), "-q"]) == ExitCode.BAD_INPUT
    assert "clip.mp4 (" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


@pytest.mark.slow
def test_the_kitchen(real_photos: Path, tmp_path: Path) -> None:
    film = real_photos / "video" / "kitchen.mp4"
    if not film.is_file():
        pytest.skip(f"{film} is missing")
    assert run(["reconstruct", str(film), "-o", str(tmp_path / "s.ply"), "--holdout-every", "5", "-q"]) == ExitCode.DONE
    report = json.loads((tmp_path / "s" / "report.json").read_text())
    assert len(report["views"]["used"]) >= 10
    assert report["quality"]["heldout"]["psnr"] > 20
