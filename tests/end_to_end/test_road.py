"""From photos to a scene, through the command line: what is made, stored, scored and optimised further."""

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from rooms import SMALL

from querysplat_cli.cli import run
from querysplat_cli.pipeline import build
from querysplat_cli.pipeline.resume import optimise_scene
from querysplat_cli.pipeline.resume_settings import ResumeSettings
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_cameras
from querysplat_cli.tto.policy import TTO_POLICY


def test_what_is_written(scene: tuple[Path, dict[str, Any]]) -> None:
    ply, report = scene
    assert report == json.loads((ply.with_suffix("") / "report.json").read_text())
    assert {path.name for path in ply.with_suffix("").iterdir()} == {
        "cameras.json",
        "curve.png",
        "images",
        "memories.safetensors",
        "photos.json",
        "points.safetensors",
        "preview.png",
        "report.json",
        "supersplat.json",
    }
    assert sorted(path.name for path in ply.parent.iterdir()) == ["photos", "scene", "scene.ply"]
    gaussians = read_ply(ply)
    assert len(gaussians) == report["gaussians"]
    inputs, heldout = read_cameras(ply.with_suffix("") / "cameras.json")
    assert list(inputs.names) == report["views"]["used"] == [f"room3_{i}.png" for i in (1, 2, 4, 5)]
    assert heldout is not None
    assert heldout.names == tuple(f"room3_{i}.png" for i in (0, 3, 6))
    preview = cv2.imread(str(ply.with_suffix("") / "preview.png"))
    assert preview.shape[1] == 2 * 192 + 6


def test_what_is_reported(scene: tuple[Path, dict[str, Any]]) -> None:
    _, report = scene
    assert {"ply", "scene", "views", "gaussians", "seconds", "quality", "left_out"} <= report.keys()
    assert report["views"]["left_out"] == []
    stages = sum(value for stage, value in report["seconds"].items() if stage != "total")
    assert stages < report["seconds"]["total"] < stages + 30  # imports are in no stage
    heldout = report["quality"]["heldout"]
    assert heldout["cameras"] == "isolated"
    assert heldout["psnr"] > 18
    assert 0 < heldout["pose_difference"]["degrees"] < 1
    assert 0 < heldout["pose_difference"]["pixels"] < 5
    assert report["quality"]["input"]["psnr"] > 22
    assert report["quality"]["input"]["psnr_grey"] > report["quality"]["input"]["psnr"] - 0.5
    for part in report["left_out"]:
        assert part.keys() == {"what", "why", "saved", "bytes", "seconds", "psnr_lost"}
    pruned = next(part for part in report["left_out"] if part["what"] == "Gaussians")
    assert 0 <= pruned["psnr_lost"] <= 16 * PRUNE_POLICY.psnr_per_step
    gone, everything = (int(number.replace(",", "")) for number in pruned["saved"].split(" of "))
    assert report["gaussians"] - report["backdrop"] == everything - gone
    assert 0.4 * everything < everything - gone <= everything // 2  # half of them, less the fog
    assert report["backdrop"] > 100


def test_the_score_is_that_of_the_files(scene: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """Renders of the .ply from cameras.json have the reported PSNR, computed here independently."""
    ply, report = scene
    assert run(["render", str(ply), "-o", str(tmp_path / "frames"), "-q"]) == 0
    for name, quality in report["quality"]["input"]["views"].items():
        photo = cv2.imread(str(ply.with_suffix("") / "images" / name)).astype(float)
        picture = cv2.imread(str(tmp_path / "frames" / f"{Path(name).stem}.png")).astype(float)
        inside = (photo > 0).any(2)
        psnr = 10 * np.log10(255**2 / np.mean((photo - picture)[inside] ** 2))
        assert psnr == pytest.approx(quality["psnr"], abs=0.1)


def copied(scene: tuple[Path, dict[str, Any]], folder: Path) -> tuple[Path, dict[str, Any]]:
    """A copy of the scene in `folder`, which a test may change, and its report."""
    source, report = scene
    ply = Path(shutil.copy(source, folder / "scene.ply"))
    shutil.copytree(source.with_suffix(""), ply.with_suffix(""))
    return ply, report


def test_tto_optimises_a_stored_scene(
    scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ply, before = copied(scene, tmp_path)
    assert run(["tto", str(ply.with_suffix("")), "--steps", "12", "--json", "-q"]) == 0
    after = json.loads(capsys.readouterr().out)
    assert after == json.loads((ply.with_suffix("") / "report.json").read_text())
    assert after["quality"]["input"]["psnr"] > before["quality"]["input"]["psnr"]
    assert [part["steps"] for part in after["tto"]] == [24, 12]
    assert after["tto"][1]["lr"] < before["tto"][0]["lr"]
    assert run(["tto", str(ply), "--steps", "0", "--json", "-q"]) == 0  # given by the .ply, and without a step
    again = json.loads(capsys.readouterr().out)
    assert again["quality"]["input"]["psnr"] == after["quality"]["input"]["psnr"]


def test_tto_keeps_where_held_out_cameras_come_from_and_forgets_what_an_earlier_run_went_on_with(
    scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ply, before = copied(scene, tmp_path)
    file = ply.with_suffix("") / "report.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "resumed": ["cameras are those of an earlier run"]}))
    assert run(["tto", str(ply), "--steps", "0", "--json", "-q"]) == 0
    after = json.loads(capsys.readouterr().out)
    for key in ("cameras", "pose_difference"):
        assert after["quality"]["heldout"][key] == before["quality"]["heldout"][key]
    assert after["resumed"] == []


def test_the_whole_time_is_that_of_the_clock(scene: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """Regions that several processes make at the same time are not added."""
    ply, _ = copied(scene, tmp_path)
    report = optimise_scene(ResumeSettings(ply, steps=0), Stages(started=time.perf_counter() - 1000))
    assert 1000 < report.seconds["total"] < 1100


def test_a_scene_of_a_checkpoint_file_is_taken_further_in_another_folder(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(resources.files("querysplat_cli") / "weights" / "compact.safetensors", tmp_path / "my.safetensors")
    monkeypatch.chdir(tmp_path)
    photo = str(next(room.iterdir()))
    assert run(["reconstruct", photo, "--preset", "my.safetensors", "--max-size", "96", "--tto", "0", "-q"]) == 0
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert run(["tto", "../scene", "--steps", "0", "-q"]) == 0
    assert run(["inspect", "../scene", "-q"]) == 0


def test_a_cluster_that_one_region_does_not_use_is_mentioned(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = str(next(room.iterdir()))
    made = ["reconstruct", photo, "--max-size", "96", "--tto", "0", "-o", str(tmp_path / "s.ply")]
    assert run([*made, "--cluster", "local:2"]) == 0
    assert capsys.readouterr().err.count("--cluster is not used") == 1


def test_a_scene_is_pruned_to_a_number(
    scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Optimising the scene again does not bring pruned Gaussians back."""
    ply, before = copied(scene, tmp_path)
    target = (before["gaussians"] - before["backdrop"]) // 2
    assert run(["tto", str(ply), "--steps", "0", "--prune", str(target), "--json", "-q"]) == 0
    after = json.loads(capsys.readouterr().out)
    assert after["gaussians"] == target + after["backdrop"] == len(read_ply(ply))
    lost = [part["psnr_lost"] for part in after["left_out"] if part["what"] == "Gaussians"][-1]
    assert lost > 0
    assert run(["tto", str(ply), "--steps", "2", "--json", "-q"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["gaussians"] == target + again["backdrop"]
    assert run(["inspect", str(ply.with_suffix("")), "-o", str(tmp_path / "inspected"), "-q"]) == 0


def test_gaussians_are_split_up_to_a_number(
    scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ply, before = copied(scene, tmp_path)
    count = before["gaussians"] - before["backdrop"]
    target = count + 100
    command = ["tto", str(ply), "--steps", "12", "--densify"]
    assert run([*command, str(target)]) == ExitCode.BAD_INPUT
    assert "Use --space gaussians" in capsys.readouterr().err
    assert run([*command, str(count), "--space", "gaussians"]) == ExitCode.BAD_INPUT
    assert run([*command, "90", "--prune", "100", "--space", "gaussians"]) == ExitCode.BAD_INPUT
    assert "--densify 90: the scene has 100 Gaussians already" in capsys.readouterr().err
    assert run([*command, str(target), "--space", "gaussians", "--json", "-q"]) == 0
    after = json.loads(capsys.readouterr().out)
    assert after["gaussians"] == target + after["backdrop"] == len(read_ply(ply))
    assert after["tto"][-1]["added"] == 100
    assert after["quality"]["input"]["psnr"] > before["quality"]["input"]["psnr"]


@pytest.mark.slow
def test_a_scene_can_do_without_a_backdrop(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also after it was optimised further."""
    ply = tmp_path / "a.ply"
    assert run(["reconstruct", str(room), "-o", str(ply), "--no-backdrop", "--json", *SMALL, "--tto", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["backdrop"] == 0
    assert run(["tto", str(ply), "--steps", "2", "--json", "-q"]) == 0
    assert json.loads(capsys.readouterr().out)["backdrop"] == 0


@pytest.mark.slow
def test_everything_can_be_kept(
    room: Path, scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, usual = scene
    command = ["reconstruct", str(room), "-o", str(tmp_path / "a.ply"), "--holdout-every", "3", "--json", *SMALL]
    assert run([*command, "--keep-everything"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["gaussians"] > 1.5 * usual["gaussians"]
    assert {part["what"] for part in report["left_out"]} == {"LPIPS loss"}


@pytest.mark.parametrize(("steps", "finest"), [("0", True), pytest.param("2", False, marks=pytest.mark.slow)])
def test_scenes_to_be_optimised_have_no_more_queries_than_there_is_time_for(
    room: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    steps: str,
    finest: bool,
) -> None:
    monkeypatch.setattr(build, "TTO_POLICY", replace(TTO_POLICY, queries=300))
    command = ["reconstruct", str(room), "-o", str(tmp_path / "a.ply"), "--max-size", "192", "--json", "-q"]
    assert run([*command, "--tto", steps]) == 0
    report = json.loads(capsys.readouterr().out)
    (queries,) = (part for part in report["left_out"] if part["what"] == "queries")
    assert ("blocks of 6 pixels" in queries["why"]) == finest


def test_gaussians_that_were_optimised_themselves_are_not_decoded_again(
    scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ply, before = copied(scene, tmp_path)
    assert run(["tto", str(ply), "--steps", "8", "--space", "both", "--json", "-q"]) == 0
    both = json.loads(capsys.readouterr().out)
    assert [(part["space"], part["steps"]) for part in both["tto"][-2:]] == [("features", 4), ("gaussians", 4)]
    assert both["quality"]["input"]["psnr"] > before["quality"]["input"]["psnr"]
    assert run(["tto", str(ply), "--steps", "0", "--json", "-q"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["tto"][-1]["space"] == "gaussians"
    assert again["quality"]["input"]["psnr"] == pytest.approx(both["quality"]["input"]["psnr"], abs=0.01)
    assert run(["tto", str(ply), "--space", "features"]) == ExitCode.BAD_INPUT


def _wait_for_work(process: int, seconds: float) -> None:
    """Until the process has computed for so long, however busy the machine is."""
    watched = psutil.Process(process)
    end = watched.cpu_times().user + seconds
    while watched.is_running() and watched.cpu_times().user < end:
        time.sleep(0.2)


def test_ctrl_c_keeps_what_optimisation_reached(scene: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    ply, before = copied(scene, tmp_path)
    command = [sys.executable, "-m", "querysplat_cli", "tto", str(ply), "--steps", "100000"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert any(line.strip() == "tto" for line in process.stderr)
        _wait_for_work(process.pid, 12)
        process.send_signal(signal.SIGINT)
        messages = process.stderr.read()
    assert process.returncode == ExitCode.INTERRUPTED, messages
    after = json.loads((ply.with_suffix("") / "report.json").read_text())
    assert after["tto"][-1]["interrupted"]
    assert 0 < len(after["tto"][-1]["curve"]) < 100_000
    assert after["quality"]["input"]["psnr"] > before["quality"]["input"]["psnr"]


def test_the_same_seed_gives_the_same_file(room: Path, scene: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """Also in another process, and where one of the two prints JSON."""
    again = tmp_path / "again.ply"
    assert run(["reconstruct", str(room), "-o", str(again), "--holdout-every", "3", *SMALL]) == 0
    assert again.read_bytes() == scene[0].read_bytes()
