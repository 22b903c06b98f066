"""A scene that `convert` cut has a report, a preview and memories of its own, which the other verbs go on with."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.pipeline.gaussian_files import read_gaussians
from querysplat_cli.runtime.errors import ExitCode


def report_in(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return found


@pytest.mark.parametrize("kind", [".ply", pytest.param(".spz", marks=pytest.mark.slow)])
def test_its_report_is_that_of_the_gaussians_that_are_left(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if kind == ".spz":
        pytest.importorskip("gsply")
    photos = [str(path) for path in take_photos(tmp_path / "photos", 2, 2, size=(480, 640))]
    made = ["reconstruct", *photos, "--max-size", "96", "--tto", "0", "-q", "-o", str(tmp_path / f"s{kind}")]
    assert run(made) == ExitCode.DONE
    whole = report_in(tmp_path / "s")
    target, most = tmp_path / f"cut{kind}", whole["backdrop"] + (whole["gaussians"] - whole["backdrop"]) // 8
    capsys.readouterr()
    cut = ["convert", str(tmp_path / f"s{kind}"), str(target), "--scale", "2", "--prune", str(most), "--json", "-q"]
    assert run(cut) == ExitCode.DONE
    said, report = json.loads(capsys.readouterr().out), report_in(tmp_path / "cut")
    assert said["psnr"]["lost"] > 1
    assert (report["ply"], report["scene"]) == (str(target), str(tmp_path / "cut"))
    assert (report["gaussians"], report["bytes"]) == (most, target.stat().st_size)
    assert report["quality"]["input"]["psnr"] == pytest.approx(said["psnr"]["after"], abs=0.01)
    pruned = report["left_out"][-1 if kind == ".ply" else -2]
    assert (pruned["why"], pruned["psnr_lost"]) == ("convert --prune", said["steps"][0]["lost"])
    assert sum(entry["what"] == "precision" for entry in report["left_out"]) == (kind == ".spz")
    assert (tmp_path / "cut" / "preview.png").read_bytes() != (tmp_path / "s" / "preview.png").read_bytes()
    assert report["settings"] == whole["settings"]
    starts = [json.loads((tmp_path / name / "supersplat.json").read_text())["cameras"][0] for name in ("s", "cut")]
    first, twice = (start["initial"]["position"] for start in starts)
    assert twice == pytest.approx([2 * x for x in first])
    assert (tmp_path / "cut" / "curve.png").is_file() == (tmp_path / "s" / "curve.png").is_file()
    before = read_gaussians(target)
    assert run(["tto", str(tmp_path / "cut"), "--steps", "0", "-q"]) == ExitCode.DONE
    for field in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(read_gaussians(target), field), getattr(before, field))
    further = report_in(tmp_path / "cut")
    again = further["quality"]
    assert (further["gaussians"], further["backdrop"]) == (report["gaussians"], report["backdrop"])
    assert not any(entry["what"] == "SH bands" for entry in further["left_out"])
    assert again["before"]["input"] == report["quality"]["input"]["psnr"]
    assert again["input"]["psnr"] == pytest.approx(again["before"]["input"], abs=0.001)


@pytest.mark.slow
def test_a_scene_of_nothing_but_its_backdrop_is_not_optimised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = [str(path) for path in take_photos(tmp_path / "photos", 3, 2)]
    scene = tmp_path / "s.ply"
    assert run(["reconstruct", *photos, "--max-size", "96", "--tto", "0", "-q", "-o", str(scene)]) == ExitCode.DONE
    assert run(["convert", str(scene), str(tmp_path / "far.ply"), "--prune", "9", "-q"]) == ExitCode.DONE
    for further in ([], ["--quality", "standard"]):
        assert run(["tto", str(tmp_path / "far"), "-q", *further]) == ExitCode.BAD_INPUT
        assert "nothing but its backdrop is left" in capsys.readouterr().err


@pytest.mark.parametrize("space", ["features", pytest.param("gaussians", marks=pytest.mark.slow)])
def test_a_cut_copy_in_place_of_the_scenes_own_file_is_not_optimised(
    space: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = [str(path) for path in take_photos(tmp_path / "photos", 3, 2)]
    scene, cut = tmp_path / "s.ply", tmp_path / "cut.ply"
    made = ["reconstruct", *photos, "--max-size", "96", "--tto", "1", "--tto-space", space, "-q", "-o", str(scene)]
    assert run(made) == ExitCode.DONE
    assert run(["convert", str(scene), str(cut), "--no-backdrop", "-q"]) == ExitCode.DONE
    whole, part = scene.read_bytes(), cut.read_bytes()
    scene.write_bytes(part)
    assert run(["tto", str(tmp_path / "s"), "--steps", "0", "-q"]) == ExitCode.BAD_INPUT
    assert "Put the scene's own file back" in capsys.readouterr().err
    assert scene.read_bytes() == part
    scene.write_bytes(whole)
    assert run(["tto", str(tmp_path / "s"), "--steps", "0", "-q"]) == ExitCode.DONE
    assert run(["tto", str(cut), "--steps", "0", "-q"]) == ExitCode.DONE


@pytest.mark.parametrize(
    ("option", "metres"), [("--scale=2", False), pytest.param("--no-backdrop", True, marks=pytest.mark.slow)]
)
def test_a_scene_in_metres_that_is_scaled_is_in_metres_no_more(option: str, metres: bool, tmp_path: Path) -> None:
    photos = [str(path) for path in take_photos(tmp_path / "photos", 3, 2)]
    apart = f"{Path(photos[0]).name},{Path(photos[1]).name}=0.5"
    scene = tmp_path / "s.ply"
    made = ["reconstruct", *photos, "--scale", apart, "--max-size", "96", "--tto", "0", "-q", "-o", str(scene)]
    assert run(made) == ExitCode.DONE
    assert report_in(tmp_path / "s")["scale"]
    assert run(["convert", str(scene), str(tmp_path / "c.ply"), option, "-q"]) == ExitCode.DONE
    assert bool(report_in(tmp_path / "c")["scale"]) == metres


def test_a_damaged_folder_goes_along_without_its_report_and_a_line_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = [str(path) for path in take_photos(tmp_path / "photos", 3, 2)]
    scene, copy = str(tmp_path / "s.ply"), tmp_path / "c.ply"
    assert run(["reconstruct", *photos, "--max-size", "96", "--tto", "0", "-q", "-o", scene]) == ExitCode.DONE

    def warnings() -> list[str]:
        capsys.readouterr()
        assert run(["convert", scene, str(copy), "--scale", "2", "--json", "--force"]) == ExitCode.DONE
        printed = capsys.readouterr()
        found: list[str] = json.loads(printed.out)["warnings"]
        assert all(f"warning: {each}" in printed.err for each in found)
        return found

    assert warnings() == []
    for name in ("memories.safetensors", "report.json"):
        (tmp_path / "s" / name).write_bytes(b"{")
        (one,) = warnings()
        assert one.startswith("the new folder has no report and no memories: ")
        assert name in one
        assert not (tmp_path / "c" / "report.json").exists()
