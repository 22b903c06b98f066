"""`--quality`, for photos and for a stored scene, through the command line."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.pipeline.resume_settings import COARSE
from querysplat_cli.prune import bands
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.tto import full_size_plan
from querysplat_cli.tto.full_size_policy import LevelPolicy

SMALL = ["--max-size", "160", "--tto", "4", "--quiet"]
QUICK = replace(
    full_size_plan.FULL_SIZE_POLICY,
    levels={
        "standard": LevelPolicy(320, 70_000, (0.5, 0.0), 14.0, 70_000, 60.0),
        "high": LevelPolicy(320, 200_000, (0.8, 0.0), 50.0, 200_000, 30.0),
    },
    fewest_passes=0.2,
)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(full_size_plan, "FULL_SIZE_POLICY", QUICK)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five photos of a procedural room, 448 × 336."""
    folder = tmp_path_factory.mktemp("room") / "photos"
    take_photos(folder, 3, 5)
    return folder


@pytest.fixture(scope="module")
def standard(photos: Path) -> Path:
    ply = photos.parent / "standard.ply"
    assert run(["reconstruct", str(photos), "-o", str(ply), "--holdout-every", "4", *SMALL]) == 0
    return ply


@pytest.fixture
def scene(standard: Path, tmp_path: Path) -> Path:
    """A copy of a finished scene."""
    shutil.copytree(standard.with_suffix(""), tmp_path / "scene")
    shutil.copy(standard, tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def taken_further(ply: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert run(["tto", str(ply), "--quality", "high", "--json", "-q"]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert report == json.loads((ply.with_suffix("") / "report.json").read_text())
    return report


def test_a_finished_scene_is_taken_further(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = json.loads((scene.with_suffix("") / "report.json").read_text())
    report = taken_further(scene, capsys)
    assert report["full_size"]["level"] == "high"
    assert report["full_size"]["ended"] == "every planned step was taken"
    assert report["gaussians"] == report["full_size"]["gaussians"] + report["backdrop"] == len(read_ply(scene))
    assert [run["space"] for run in report["tto"]] == ["features", "gaussians"]
    assert report["tto"][1]["max_size"] == report["quality"]["full_size"]["max_size"] == 320
    assert report["tto"][1]["loss_after"] < report["tto"][1]["loss_before"]
    assert set(report["quality"]["full_size"]["heldout"]["views"]) == {"room3_0.png", "room3_4.png"}
    assert report["quality"]["input"]["psnr"] != before["quality"]["input"]["psnr"]
    again = taken_further(scene, capsys)  # the photos are found again from what was written back
    assert len(again["tto"]) == 3


def test_a_scene_of_large_photos_is_taken_further_on_them_unless_an_option_says_otherwise(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Steps on the small pictures would take the detail of the large ones."""
    taken_further(scene, capsys)
    for options, size in (["--steps", "1"], None), (["--steps", "0"], None), ([], 320):
        assert run(["tto", str(scene), *options, "--json", "-q"]) == ExitCode.DONE
        report = json.loads(capsys.readouterr().out)
        assert report["tto"][-1]["space"] == "gaussians"
        assert report["tto"][-1].get("max_size") == size
        assert (COARSE in report["warnings"]) == (size is None)
    assert report["full_size"]["level"] == "high"


def test_small_pictures_do_not_decide_on_the_bands_of_a_scene_of_large_photos(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken_further(scene, capsys)
    before = read_ply(scene)
    assert before.sh_degree == 1
    monkeypatch.setattr(bands, "PRUNE_POLICY", replace(bands.PRUNE_POLICY, psnr_of_bands=100.0))
    assert run(["tto", str(scene), "--steps", "0", "--prune", str(len(before) // 2), "-q"]) == ExitCode.DONE
    assert len(read_ply(scene)) < len(before)
    assert read_ply(scene).sh_degree == 1


def test_the_same_seed_gives_the_same_bytes(standard: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = []
    for name in ("one", "two"):
        shutil.copytree(standard.with_suffix(""), tmp_path / name)
        shutil.copy(standard, tmp_path / f"{name}.ply")
        taken_further(tmp_path / f"{name}.ply", capsys)
        files.append((tmp_path / f"{name}.ply").read_bytes())
    assert files[0] == files[1]
    assert files[0] != standard.read_bytes()


def test_photos_that_are_gone(scene: Path, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listing = scene.with_suffix("") / "photos.json"
    listing.write_text(listing.read_text().replace(str(photos.resolve()), str(tmp_path / "moved")))
    before = scene.read_bytes()
    assert run(["tto", str(scene), "--quality", "high", "-q"]) == ExitCode.BAD_INPUT
    message = capsys.readouterr().err
    assert message.count("error: ") == 1
    assert "of this scene are gone" in message
    listing.unlink()
    assert run(["tto", str(scene), "--quality", "high", "-q"]) == ExitCode.BAD_INPUT
    assert "does not say where" in capsys.readouterr().err
    assert scene.read_bytes() == before


@pytest.mark.parametrize("options", [["--steps", "3"], ["--lr", "0.1"], ["--densify", "9"], ["--prune", "auto"]])
def test_options_that_the_quality_decides_are_refused(
    options: list[str], scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["tto", str(scene), "--quality", "high", *options]) == ExitCode.BAD_INPUT
    assert options[0] in capsys.readouterr().err


def test_reconstruct_goes_on_to_the_large_photos(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reconstruct", str(photos), "-o", str(tmp_path / "a.ply"), "--quality", "high", "--json", *SMALL]
    assert run([*command, "--holdout-every", "4"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["full_size"]["level"] == "high"
    assert report["settings"]["quality"] == "high"
    assert report["quality"]["full_size"]["heldout"]["psnr"] > 15
    assert {"full size", "full size score"} <= report["seconds"].keys()
    assert "joint" not in report["quality"]["heldout"]
    assert report["gaussians"] == len(read_ply(tmp_path / "a.ply"))


def test_the_default_goes_on_in_gaussian_space(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The plan of the first run is automatic."""
    command = ["reconstruct", str(photos), "-o", str(tmp_path / "a.ply"), "--max-size", "160", "--json", "--quiet"]
    assert run([*command, "--holdout-every", "4"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["full_size"]["level"] == report["settings"]["quality"] == "standard"
    assert [each["space"] for each in report["tto"]] == ["features", "gaussians"]
    assert report["tto"][1]["max_size"] == report["quality"]["full_size"]["max_size"] == 320
    assert report["gaussians"] == len(read_ply(tmp_path / "a.ply"))


def test_photos_no_larger_than_the_working_pictures_are_scored_once(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for photo in sorted(photos.iterdir())[:2]:
        cv2.imwrite(str(tmp_path / photo.name), cv2.resize(cv2.imread(str(photo)), (224, 168)))
    assert run(["reconstruct", str(tmp_path), "-o", str(tmp_path / "out" / "a.ply"), "--json", "--quiet"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["tto"][1]["max_size"] == 224
    assert "full_size" not in report["quality"]


@pytest.mark.parametrize(
    "options",
    [
        ["--quality", "draft", "--max-views", "2"],
        ["--tto", "4"],
        pytest.param(["--keep-everything", "--max-views", "2"], marks=pytest.mark.slow),
    ],
)
def test_draft_and_given_steps_stay_in_feature_space(
    options: list[str], photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reconstruct", str(photos), "-o", str(tmp_path / "a.ply"), "--max-size", "160", "--json", "--quiet"]
    assert run([*command, *options]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["full_size"] is None
    assert "full_size" not in report["quality"]
    assert [each["space"] for each in report["tto"]] == ["features"]
