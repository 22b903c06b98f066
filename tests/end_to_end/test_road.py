"""From photos to a scene, through the command line: files, messages, and what must not be left behind."""

import json
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.pipeline import build
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_cameras
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room
from querysplat_cli.tto.policy import TTO_POLICY

PHOTOS = 7
SMALL = ["--max-size", "192", "--tto", "24", "--quiet"]


def take_photos(folder: Path, seed: int, count: int = PHOTOS, *, mirrored: bool = False) -> list[Path]:
    """Photos of a procedural room, 448 × 336. Rooms share patterns, but a mirrored room matches none that is not."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = make_room(seed)
    cameras = walk(scene, count, seed)
    files = [folder / f"room{seed}_{i}.png" for i in range(count)]
    for i, file in enumerate(files):
        picture = (cast(scene, cameras[[i]], samples=1)[0][0] * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
        cv2.imwrite(str(file), picture[:, ::-1] if mirrored else picture)
    return files


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "photos"
    take_photos(folder, 3)
    return folder


@pytest.fixture(scope="module")
def scene(room: Path) -> tuple[Path, dict[str, Any]]:
    """A scene with every third photo held out, and the report that was printed."""
    ply = room.parent / "scene.ply"
    command = [sys.executable, "-m", "querysplat_cli", "reconstruct", str(room), "-o", str(ply)]
    done = subprocess.run(
        [*command, "--holdout-every", "3", "--json", *SMALL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return ply, json.loads(done.stdout)


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
    assert report["seconds"]["total"] == pytest.approx(
        sum(value for stage, value in report["seconds"].items() if stage != "total"), abs=0.1
    )
    heldout = report["quality"]["heldout"]
    assert heldout["cameras"] == "isolated"
    assert heldout["isolated"]["psnr"] == heldout["psnr"]
    assert heldout["joint"]["psnr"] > 18
    assert 0 < heldout["pose_difference"]["degrees"] < 1
    assert 0 < heldout["pose_difference"]["pixels"] < 5
    assert report["quality"]["input"]["psnr"] > 22
    assert report["quality"]["input"]["psnr_grey"] > report["quality"]["input"]["psnr"] - 0.5
    for part in report["left_out"]:
        assert part.keys() == {"what", "why", "saved", "bytes", "seconds", "psnr_lost"}
    pruned = next(part for part in report["left_out"] if part["what"] == "Gaussians")
    assert 0 <= pruned["psnr_lost"] <= 16 * PRUNE_POLICY.psnr_per_step
    gone, everything = (int(number.replace(",", "")) for number in pruned["saved"].split(" of "))
    assert report["gaussians"] - report["backdrop"] == everything - gone == everything // 2
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


def test_tto_optimises_a_stored_scene(scene: tuple[Path, dict[str, Any]], capsys: pytest.CaptureFixture[str]) -> None:
    ply, before = scene
    assert run(["tto", str(ply.with_suffix("")), "--steps", "12", "--json", "-q"]) == 0
    after = json.loads(capsys.readouterr().out)
    assert after == json.loads((ply.with_suffix("") / "report.json").read_text())
    assert after["quality"]["input"]["psnr"] > before["quality"]["input"]["psnr"]
    assert [part["steps"] for part in after["tto"]] == [24, 12]
    assert after["tto"][1]["lr"] < before["tto"][0]["lr"]
    assert run(["tto", str(ply), "--steps", "0", "--json", "-q"]) == 0  # given by the .ply, and without a step
    again = json.loads(capsys.readouterr().out)
    assert again["quality"]["input"]["psnr"] == after["quality"]["input"]["psnr"]


def test_a_scene_is_pruned_to_a_number(
    scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Optimising the scene again does not bring pruned Gaussians back."""
    source, before = scene
    ply = Path(shutil.copy(source, tmp_path / "scene.ply"))
    shutil.copytree(source.with_suffix(""), ply.with_suffix(""))
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
    source, before = scene
    ply = Path(shutil.copy(source, tmp_path / "scene.ply"))
    shutil.copytree(source.with_suffix(""), ply.with_suffix(""))
    count = before["gaussians"] - before["backdrop"]
    target = count + 100
    command = ["tto", str(ply), "--steps", "12", "--densify"]
    assert run([*command, str(target)]) == ExitCode.BAD_INPUT
    assert "Use --space gaussians" in capsys.readouterr().err
    assert run([*command, str(count), "--space", "gaussians"]) == ExitCode.BAD_INPUT
    assert run([*command, str(target), "--space", "gaussians", "--json", "-q"]) == 0
    after = json.loads(capsys.readouterr().out)
    assert after["gaussians"] == target + after["backdrop"] == len(read_ply(ply))
    assert after["tto"][-1]["added"] == 100
    assert after["quality"]["input"]["psnr"] > before["quality"]["input"]["psnr"]


def test_a_scene_can_do_without_a_backdrop(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also after it was optimised further."""
    ply = tmp_path / "a.ply"
    assert run(["reconstruct", str(room), "-o", str(ply), "--no-backdrop", "--json", *SMALL, "--tto", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["backdrop"] == 0
    assert run(["tto", str(ply), "--steps", "2", "--json", "-q"]) == 0
    assert json.loads(capsys.readouterr().out)["backdrop"] == 0


def test_everything_can_be_kept(
    room: Path, scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, usual = scene
    command = ["reconstruct", str(room), "-o", str(tmp_path / "a.ply"), "--holdout-every", "3", "--json", *SMALL]
    assert run([*command, "--keep-everything"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["gaussians"] > 1.5 * usual["gaussians"]
    assert {part["what"] for part in report["left_out"]} == {"LPIPS loss"}


@pytest.mark.parametrize(("steps", "finest"), [("0", True), ("2", False)])
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
    source, before = scene
    ply = Path(shutil.copy(source, tmp_path / "scene.ply"))
    shutil.copytree(source.with_suffix(""), ply.with_suffix(""))
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
    source, before = scene
    ply = Path(shutil.copy(source, tmp_path / "scene.ply"))
    shutil.copytree(source.with_suffix(""), ply.with_suffix(""))
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


@pytest.mark.slow  # structure from motion gives other cameras once in about a hundred runs: CHANGELOG, known gaps
def test_the_same_seed_gives_the_same_file(room: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("one.ply", "two.ply")]
    for file in files:
        assert run(["reconstruct", str(room), "-o", str(file), *SMALL]) == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_known_poses(
    room: Path, scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With cameras.json for poses no structure from motion runs, and the report names photos without a camera."""
    ply, _ = scene
    poses = tmp_path / "transforms.json"
    content = json.loads((ply.with_suffix("") / "cameras.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = Path(frame["file_path"]).name
    del content["heldout_frames"]
    poses.write_text(json.dumps(content))
    command = ["reconstruct", str(room), "-o", str(tmp_path / "a.ply"), "--poses", str(poses), "--json", *SMALL]
    assert run(command) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["views"]["used"] == [f"room3_{i}.png" for i in (1, 2, 4, 5)]
    assert {photo["name"] for photo in report["views"]["left_out"]} == {f"room3_{i}.png" for i in (0, 3, 6)}
    assert any(part["what"] == "structure from motion" for part in report["left_out"])
    assert report["tto"][0]["cameras"] is None
    assert report["quality"]["input"]["psnr"] > 22


def test_known_poses_that_are_wrong_are_refined(
    room: Path, scene: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ply, _ = scene
    content = json.loads((ply.with_suffix("") / "cameras.json").read_text())
    for i, frame in enumerate(content["frames"]):
        frame["file_path"] = Path(frame["file_path"]).name
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(np.radians([0.6 * (-1) ** i, 0.6 * (-1) ** (i // 2), 0.0]))[0]
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ turn).tolist()
    del content["heldout_frames"]
    poses = tmp_path / "transforms.json"
    poses.write_text(json.dumps(content))
    psnr = []
    for name, options in (("a", ["--no-refine-cameras"]), ("b", [])):
        command = ["reconstruct", str(room), "-o", str(tmp_path / f"{name}.ply"), "--poses", str(poses), "--json"]
        assert run([*command, *SMALL, "--tto", "40", *options]) == 0
        report = json.loads(capsys.readouterr().out)
        psnr.append(report["quality"]["input"]["psnr"])
        refined = report["tto"][0]["cameras"]
        assert (refined is None) == bool(options)
    assert refined["degrees"] > 0.2
    assert psnr[1] > psnr[0] + 1


def test_good_photos_are_used_where_some_are_bad(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Grey, transparent, 16-bit and cropped photos are used; a truncated file, a text and an empty file are not."""
    folder = tmp_path / "mixed"
    folder.mkdir()
    for i, file in enumerate(sorted(room.iterdir())):
        (folder / file.name).write_bytes(file.read_bytes())
        picture = cv2.imread(str(file))
        if i == 1:
            cv2.imwrite(str(folder / file.name), cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        if i == 2:
            cv2.imwrite(str(folder / file.name), cv2.cvtColor(picture, cv2.COLOR_BGR2BGRA))
        if i == 3:
            cv2.imwrite(str(folder / file.name), picture.astype(np.uint16) * 257)
        if i == 4:
            cv2.imwrite(str(folder / file.name), picture[:, 60:-60])  # as high as wide
    torn = (folder / "room3_6.png").read_bytes()
    (folder / "room3_6.png").write_bytes(torn[: len(torn) // 3])
    (folder / "notes.jpg").write_text("to do")
    (folder / "empty.jpg").write_bytes(b"")
    assert run(["reconstruct", str(folder), "-o", str(tmp_path / "a.ply"), "--json", *SMALL]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["views"]["used"] == [f"room3_{i}.png" for i in range(6)]
    assert {photo["name"] for photo in report["views"]["left_out"]} == {"room3_6.png", "notes.jpg", "empty.jpg"}
    assert report["quality"]["input"]["psnr"] > 18


def test_two_places_in_one_folder(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The larger place becomes the scene; every photo of the other is named."""
    folder = tmp_path / "two"
    others = take_photos(folder, 5, 4, mirrored=True)
    for file in room.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    assert run(["reconstruct", str(folder), "-o", str(tmp_path / "a.ply"), "--json", *SMALL]) == 0
    report = json.loads(capsys.readouterr().out)
    assert set(report["views"]["used"]) == {file.name for file in room.iterdir()}
    assert {photo["name"] for photo in report["views"]["left_out"]} == {file.name for file in others}


def test_photos_without_overlap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "none"
    folder.mkdir()
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 255, (34, 45, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{seed}.png"), cv2.resize(noise, (448, 336), interpolation=cv2.INTER_CUBIC))
    assert run(["reconstruct", str(folder), "-o", str(tmp_path / "a.ply"), *SMALL]) == ExitCode.IMPOSSIBLE
    assert capsys.readouterr().err.count("error: ") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["none"]


def test_a_scene_of_one_photo_warns_that_depth_is_a_guess(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = sorted(room.iterdir())[0]
    assert run(["reconstruct", str(photo), "-o", str(tmp_path / "a.ply"), "--json", *SMALL]) == 0
    report = json.loads(capsys.readouterr().out)
    assert any("depth is a guess" in doubt for doubt in report["doubts"])
    assert report["quality"]["input"]["psnr"] > 21


def test_a_budget_without_held_out_photos_leaves_no_score_out(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = sorted(room.iterdir())[0]
    command = ["reconstruct", str(photo), "-o", str(tmp_path / "a.ply"), "--budget", "30", "--json", *SMALL]
    assert run(command) == 0
    what = {part["what"] for part in json.loads(capsys.readouterr().out)["left_out"]}
    assert "the other cameras' score" not in what


def test_too_few_photos_to_hold_out(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    two = [str(path) for path in sorted(room.iterdir())[:2]]
    arguments = ["reconstruct", *two, "-o", str(tmp_path / "a.ply"), "--holdout-every", "2", *SMALL]
    assert run(arguments) == ExitCode.BAD_INPUT
    assert "--holdout-every" in capsys.readouterr().err


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["reconstruct", str(room), "-o", str(tmp_path / "a.ply"), "--device", "cuda", *SMALL]
    assert run(arguments) == ExitCode.MISSING_PART
    assert "Use --device cpu." in capsys.readouterr().err


def test_photos_are_never_replaced_by_their_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scene folder would replace the folder of photos; --force may only replace an earlier scene."""
    photos = tmp_path / "photos"
    take_photos(photos, 3, 2)
    for given in (photos, photos / "room3_0.png"):
        assert run(["reconstruct", str(given), "-o", str(tmp_path / "photos.ply"), "--force", *SMALL]) == 2
        assert "would replace" in capsys.readouterr().err
    assert len(list(photos.iterdir())) == 2


def test_a_place_that_cannot_be_written(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    arguments = ["reconstruct", str(room), "-o", str(tmp_path / "file" / "a.ply"), *SMALL]
    assert run(arguments) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err.count("error: ") == 1
    assert (tmp_path / "file").read_text() == "mine"


def test_a_full_disk_leaves_nothing(room: Path, tmp_path: Path) -> None:
    def allow_small_files_only() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 18, 1 << 18))

    arguments = ["reconstruct", str(room), "-o", str(tmp_path / "a.ply"), *SMALL]
    done = subprocess.run(
        [sys.executable, "-m", "querysplat_cli", *arguments],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=allow_small_files_only,
    )
    assert done.returncode == ExitCode.BAD_INPUT, done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("stage", "number"),
    [
        *((stage, signal.SIGINT) for stage in ("photos", "cameras", "depth", "score", "write")),
        ("cameras", signal.SIGTERM),
        ("depth", signal.SIGHUP),
        ("write", signal.SIGTERM),
    ],
)
def test_a_signal_leaves_what_was_there(stage: str, number: int, room: Path, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text("mine")
    arguments = ["reconstruct", str(room), "-o", str(tmp_path / "a.ply"), "--force", *SMALL[:-1]]
    with subprocess.Popen(
        [sys.executable, "-m", "querysplat_cli", *arguments], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        messages = ""
        for line in process.stderr:
            messages += line
            if line.strip() == stage:
                process.send_signal(number)
                break
        messages += process.stderr.read()
    assert process.returncode == 128 + number, messages
    assert "Traceback" not in messages
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    assert (tmp_path / "a.ply").read_text() == "mine"
