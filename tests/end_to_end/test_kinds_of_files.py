"""A scene can be written in each format that `convert` writes, and every verb takes it in that format."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import pycolmap
import pytest
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.pipeline.gaussian_files import read_gaussians
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo

pytest.importorskip("gsply")


def stored_report(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "s" / "report.json").read_text())
    return found


def test_a_scene_in_an_spz(tmp_path: Path) -> None:
    photo = str(take_photos(tmp_path / "photos", 3, 1)[0])
    # Rounding makes a scene worse that fits its photo; one without a step may even gain.
    made = ["reconstruct", photo, "--max-size", "96", "--tto", "8", "-q"]
    for name in ("s.spz", "t.ply"):
        assert run([*made, "-o", str(tmp_path / name)]) == ExitCode.DONE
    assert not (tmp_path / "s.ply").exists()
    one, two = (read_gaussians(tmp_path / name) for name in ("s.spz", "t.ply"))
    assert len(one) == len(two)
    assert (one.means - two.means).abs().max() < 1e-3  # y points down in both
    precision = [entry for entry in stored_report(tmp_path)["left_out"] if entry["what"] == "precision"]
    assert len(precision) == 1
    assert 0 < precision[0]["psnr_lost"] < 1
    assert precision[0]["bytes"] == pytest.approx(
        (tmp_path / "t.ply").stat().st_size - (tmp_path / "s.spz").stat().st_size, abs=2000
    )
    for scene in ("s", "s.spz"):
        assert run(["render", str(tmp_path / scene), "-o", str(tmp_path / "frames"), "--force", "-q"]) == ExitCode.DONE
        assert {path.name for path in (tmp_path / "frames").iterdir()} == {"room3_0.png", "cameras.json"}
        assert run(["inspect", str(tmp_path / scene), "--force", "-q"]) == ExitCode.DONE
        assert (tmp_path / "s-inspected").is_dir()
    assert run(["tto", str(tmp_path / "s"), "--steps", "1", "--space", "gaussians", "-q"]) == ExitCode.DONE
    report = stored_report(tmp_path)
    assert [entry["what"] for entry in report["left_out"]].count("precision") == 1  # that of the new file
    assert report["ply"] == str(tmp_path / "s.spz")
    assert not (tmp_path / "s.ply").exists()


def test_a_scene_given_by_a_dot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photo = str(take_photos(tmp_path / "photos", 3, 1)[0])
    assert run(["reconstruct", photo, "--max-size", "96", "--tto", "0", "-q", "-o", str(tmp_path / "s.ply")]) == 0
    for verb in ("inspect", "render", "tto"):  # tto replaces the folder
        monkeypatch.chdir(tmp_path / "s")
        options = ["--steps", "0"] if verb == "tto" else []
        assert run([verb, ".", "-q", *options]) == ExitCode.DONE, verb
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["photos", "s", "s-inspected", "s-renders", "s.ply"]
    monkeypatch.chdir(tmp_path)
    copied = shutil.copytree(tmp_path / "s", tmp_path / "copy")
    shutil.copy(tmp_path / "s.ply", tmp_path / "copy.ply")
    assert run(["tto", "copy/../copy", "--steps", "0", "-q"]) == ExitCode.DONE
    assert json.loads((copied / "report.json").read_text())["ply"] == "copy/../copy.ply"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*names, "copy", "copy.ply"])


def test_colmap_gets_the_photos_of_a_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not its preview, and not the small pictures in its folder where the photos are still there."""
    photos = take_photos(tmp_path / "photos", 3, 2)
    made = ["reconstruct", *map(str, photos), "-o", str(tmp_path / "s.ply"), "--max-size", "96", "--tto", "0", "-q"]
    assert run(made) == ExitCode.DONE
    for name, options in (("s", []), ("turned", ["--up=0.1,-1,0.3", "--scale", "2"])):
        if options:  # the points go along
            assert run(["convert", str(tmp_path / "s.ply"), str(tmp_path / f"{name}.ply"), *options, "-q"]) == 0
        assert run(["convert", str(tmp_path / name), str(tmp_path / "model"), "--force", "-q"]) == ExitCode.DONE
        model = pycolmap.Reconstruction(tmp_path / "model")
        assert len(model.points3D) > 100
        assert model.compute_num_observations() == 2 * len(model.points3D)
        assert model.compute_mean_reprojection_error() < 1  # in pixels of the whole photos
        assert len({tuple(point.color) for point in model.points3D.values()}) > 50
    seen = []

    def colmap(found: list[Photo], seed: int, stages: Stages) -> dict[str, PhotoCamera]:
        seen.append([(photo.name, photo.width) for photo in found])
        raise QuerySplatError("enough")

    monkeypatch.setattr("querysplat_cli.commands.poses.estimate_with_colmap", colmap)
    width = cv2.imread(str(photos[0])).shape[1]
    names = [photo.name for photo in photos]
    for given in ("s", "s/cameras.json"):
        assert run(["poses", str(tmp_path / given), "--colmap"]) == ExitCode.BAD_INPUT
        assert seen.pop() == [(name, width) for name in names]
    (tmp_path / "s" / "photos.json").unlink()
    assert run(["poses", str(tmp_path / "s"), "--colmap"]) == ExitCode.BAD_INPUT
    assert seen.pop() == [(name, 96) for name in names]
    (tmp_path / "s" / "images").rename(tmp_path / "pics")
    content = json.loads((tmp_path / "s" / "cameras.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("images/", "pics/")
    (tmp_path / "listed.json").write_text(json.dumps(content))
    assert run(["poses", str(tmp_path / "listed.json"), "--colmap"]) == ExitCode.BAD_INPUT
    assert seen.pop() == [(name, 96) for name in names]
    (tmp_path / "s" / "preview.png").unlink()
    capsys.readouterr()
    assert run(["poses", str(tmp_path / "s" / "cameras.json"), "--colmap"]) == ExitCode.BAD_INPUT
    message = capsys.readouterr().err
    assert "--colmap needs the photos of" in message
    assert "Put the photos into" in message
