"""The official presets, with tiny random weights under the official names: all but the quality is tested."""

import json
from pathlib import Path
from typing import Any

import pytest
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.formats.ply import read_ply
from tiny_weights import MODEL, write_weights

SIZE = 112  # whole patches of 14 and of 16 pixels


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    take_photos(folder / "photos", 3, 4)
    write_weights(folder / "weights")
    return folder


def command(room: Path, ply: Path, *more: str) -> list[str]:
    weights = ["--weights", str(room / "weights"), "--max-size", str(SIZE), "-q", "--json"]
    return ["reconstruct", str(room / "photos"), "-o", str(ply), "--preset", "official-8192", *weights, *more]


def reported(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> dict[str, Any]:
    assert run(arguments) == ExitCode.DONE
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


@pytest.mark.parametrize(
    ("more", "degree"),
    [
        ([], 1),
        (["--preset", "official-paper"], 0),
        (["--encoder", "vggt"], 1),
        (["--fit", "pad", "--depth"], 1),
        (["--precision", "bf16"], 1),
    ],
)
def test_photos_become_a_scene(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], degree: int
) -> None:
    report = reported(capsys, command(room, tmp_path / "a.ply", *more))
    gaussians = read_ply(tmp_path / "a.ply")
    assert len(gaussians) == report["gaussians"] == MODEL.query_count * MODEL.gaussians_per_query
    assert gaussians.sh_degree == degree
    assert gaussians.means.isfinite().all()
    assert len(report["views"]["used"]) == 4
    assert report["memory_estimate_gib"] > 0
    assert any(part["what"] == "depth" for part in report["left_out"]) == ("--depth" not in more)


def test_the_whole_photo_is_seen_where_it_is_not_cropped(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reported(capsys, command(room, tmp_path / "a.ply", "--fit", "pad"))
    camera = json.loads((tmp_path / "a" / "cameras.json").read_text())
    assert (camera["frames"][0]["w"], camera["frames"][0]["h"]) == (112, 96)  # 4 : 3 and the next whole patch


def test_fewer_queries_are_the_first(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = reported(capsys, command(room, tmp_path / "a.ply", "--queries", "5"))
    assert report["gaussians"] == 5 * MODEL.gaussians_per_query
    assert run(command(room, tmp_path / "b.ply", "--queries", "25")) == ExitCode.BAD_INPUT
    assert "24 learned queries" in capsys.readouterr().err


def test_fewer_views_are_evenly_spaced(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = reported(capsys, command(room, tmp_path / "a.ply", "--max-views", "2"))
    assert report["views"]["used"] == ["room3_0.png", "room3_3.png"]
    assert [photo["name"] for photo in report["views"]["left_out"]] == ["room3_1.png", "room3_2.png"]
    assert "limit of 2 views" in report["views"]["left_out"][0]["why"]


def test_the_memories_can_be_optimised_later(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = reported(capsys, command(room, tmp_path / "a.ply", "--queries", "5", "--precision", "bf16"))
    after = reported(capsys, ["tto", str(tmp_path / "a"), "--steps", "3", "--lr", "0.05", "-q", "--json"])
    assert after["gaussians"] == before["gaussians"]
    assert after["tto"][1]["loss_after"] < after["tto"][1]["loss_before"]
    again = reported(capsys, ["tto", str(tmp_path / "a"), "--steps", "0", "-q", "--json"])
    assert again["quality"]["input"]["psnr"] == pytest.approx(after["quality"]["input"]["psnr"], abs=0.01)
    usual = reported(capsys, ["tto", str(tmp_path / "a"), "-q", "--json"])["tto"][-1]
    assert (usual["steps"], usual["lr"], usual["views_per_step"]) == (20, 0.005, None)


def test_held_out_photos_do_not_enter_the_scene(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scene has the same bits as one made of the input photos alone."""
    held = reported(capsys, command(room, tmp_path / "held.ply", "--holdout-every", "2"))
    assert held["views"]["used"] == ["room3_1.png", "room3_3.png"]
    (tmp_path / "some").mkdir()
    for name in held["views"]["used"]:
        (tmp_path / "some" / name).write_bytes((room / "photos" / name).read_bytes())
    arguments = command(room, tmp_path / "alone.ply")
    arguments[1] = str(tmp_path / "some")
    reported(capsys, arguments)
    assert (tmp_path / "held.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()


@pytest.mark.parametrize(
    ("more", "code", "said"),
    [
        (["--preset", "compact", "--encoder", "vggt_omega"], ExitCode.BAD_INPUT, "the model reads"),
        (["--encoder", "vggt", "--max-size", "518"], ExitCode.BAD_INPUT, "patches of 16"),
        (["--encoder", "dino"], ExitCode.BAD_INPUT, "classical"),
        (["--holdout-every", "2", "--holdout-cameras", "joint"], ExitCode.BAD_INPUT, "--holdout-cameras isolated"),
        (["--weights", "nowhere"], ExitCode.MISSING_PART, "hf download inspatio/querysplat"),
    ],
)
def test_what_cannot_be_done_is_said(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], code: ExitCode, said: str
) -> None:
    assert run(command(room, tmp_path / "a.ply", *more)) == code
    printed = capsys.readouterr().err
    assert said in printed
    assert len(printed.splitlines()) == 2
    assert list(tmp_path.iterdir()) == []


def test_poses_are_refused(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reported(capsys, command(room, tmp_path / "a.ply"))
    poses = ["--poses", str(tmp_path / "a" / "cameras.json")]
    assert run(command(room, tmp_path / "b.ply", *poses)) == ExitCode.BAD_INPUT
    assert "can take none" in capsys.readouterr().err


def test_too_little_memory_is_said_before_any_work(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("querysplat_cli.pipeline.reconstruct.free_bytes", lambda device: 2**20)
    assert run(command(room, tmp_path / "a.ply")) == ExitCode.BAD_INPUT
    assert "GiB" in capsys.readouterr().err


def test_features_can_be_optimised_instead(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both targets of optimisation start at the same scene, lower the loss, differ, and can be resumed."""
    losses = {}
    for target in ("kv", "features"):
        made = command(room, tmp_path / f"{target}.ply", "--tto", "4", "--tto-target", target)
        report = reported(capsys, made)
        losses[target] = report["tto"][0]["loss_before"], report["tto"][0]["loss_after"]
        assert losses[target][1] < losses[target][0]
        again = reported(capsys, ["tto", str(tmp_path / target), "--steps", "0", "-q", "--json"])
        assert again["quality"]["input"]["psnr"] == pytest.approx(report["quality"]["input"]["psnr"], abs=0.02)
    assert losses["kv"][0] == losses["features"][0]
    assert losses["kv"][1] != losses["features"][1]
