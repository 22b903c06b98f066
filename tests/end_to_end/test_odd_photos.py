"""Photos and places that are not as they should be, through the command line: messages, and what must not be left
behind."""

import json
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from rooms import SMALL, take_photos

from querysplat_cli.cli import run
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.runtime.errors import ExitCode


@pytest.mark.slow
def test_photos_that_lie_in_a_file_make_the_same_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = take_photos(tmp_path / "photos", 3, 3)
    made = ["reconstruct", *map(str, photos), "--max-size", "96", "--tto", "2", "--quality", "draft", "-q", "-o"]
    assert run([*made, str(tmp_path / "a.ply")]) == 0
    policy = replace(PIPELINE_POLICY, pixel_bytes=photos[0].stat().st_size)  # only the first stays in memory, if any
    monkeypatch.setattr("querysplat_cli.pipeline.reconstruct.PIPELINE_POLICY", policy)
    assert run([*made, str(tmp_path / "b.ply")]) == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "a.ply", "b", "b.ply", "photos"]


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


@pytest.mark.slow
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


@pytest.mark.slow
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


def strangers(folder: Path, count: int) -> Path:
    folder.mkdir()
    for seed in range(count):
        noise = np.random.default_rng(seed).integers(0, 255, (34, 45, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{seed}.png"), cv2.resize(noise, (448, 336), interpolation=cv2.INTER_CUBIC))
    return folder


def test_photos_without_overlap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = strangers(tmp_path / "none", 5)
    assert run(["reconstruct", str(folder), "-o", str(tmp_path / "a.ply"), *SMALL]) == ExitCode.IMPOSSIBLE
    assert capsys.readouterr().err.count("error: ") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["none"]


def test_two_photos_without_overlap_make_a_scene_of_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = strangers(tmp_path / "two", 2)
    assert run(["reconstruct", str(folder), "-o", str(tmp_path / "a.ply"), "--json", *SMALL]) == 0
    views = json.loads(capsys.readouterr().out)["views"]
    assert [len(views["used"]), len(views["left_out"])] == [1, 1]


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


def test_a_failed_run_leaves_no_folder_that_it_made_for_its_scene(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    command = ["reconstruct", str(tmp_path / "empty"), "-o", str(tmp_path / "new" / "sub" / "scene.ply")]
    assert run(command) == ExitCode.BAD_INPUT
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


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
        *((stage, signal.SIGINT) for stage in ("photos", "write")),
        *(pytest.param(stage, signal.SIGINT, marks=pytest.mark.slow) for stage in ("cameras", "depth", "score")),
        ("cameras", signal.SIGTERM),
        ("depth", signal.SIGHUP),
        pytest.param("write", signal.SIGTERM, marks=pytest.mark.slow),
    ],
)
def test_a_signal_leaves_what_was_there(stage: str, number: int, room: Path, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text("mine")
    photos = [str(file) for file in sorted(room.iterdir())[:3]]
    arguments = ["reconstruct", *photos, "-o", str(tmp_path / "a.ply"), "--force", "--max-size", "192", "--tto", "4"]
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
