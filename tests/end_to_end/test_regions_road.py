"""Photos in regions, through the command line: one scene, which a stopped run goes on with."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from common.street_photos import take_street
from querysplat_cli.cli import run
from querysplat_cli.pipeline.regions import build
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.formats.ply import read_ply

COUNT = 10
SMALL = ["--max-size", "112", "--tto", "8", "--quality", "draft", "--holdout-every", "5", "-q"]
Made = tuple[Path, dict[str, Any]]


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street") / "photos"
    take_street(folder, COUNT, length=4.0, width=144, samples=1)
    return folder


def command(street: Path, ply: Path, *more: str) -> list[str]:
    poses = str(street.parent / "transforms.json")
    return ["reconstruct", str(street), "-o", str(ply), "--poses", poses, *SMALL, *more]


def reconstruct(street: Path, name: str, *more: str) -> Made:
    ply = street.parent / f"{name}.ply"
    assert run(command(street, ply, *more)) == ExitCode.DONE
    return ply, json.loads((ply.with_suffix("") / "report.json").read_text())


@pytest.fixture(scope="module")
def divided(street: Path) -> Made:
    return reconstruct(street, "divided", "--regions", "2")


def test_regions_make_one_scene(street: Path, divided: Made) -> None:
    ply, report = divided
    whole = reconstruct(street, "whole")[1]
    assert [region["photos"] for region in report["regions"]] == [4, 4]
    assert all(region["overlap"] == 2 for region in report["regions"])
    assert sum(region["gaussians"] for region in report["regions"]) + report["backdrop"] == report["gaussians"]
    assert len(read_ply(ply)) == report["gaussians"]
    assert report["seams"][0]["regions"] == [1, 2]
    assert report["seams"][0]["psnr"] > 20
    assert report["quality"]["heldout"]["psnr"] > whole["quality"]["heldout"]["psnr"] - 0.5
    assert whole["regions"] == whole["seams"] == []
    assert not list(ply.parent.glob(".*"))


def test_regions_with_depth_do_not_say_that_it_was_left_out(divided: Made) -> None:
    assert "depth" not in [entry["what"] for entry in divided[1]["left_out"]]


def test_the_scene_can_be_taken_further(divided: Made, tmp_path: Path) -> None:
    copy = tmp_path / "copy.ply"
    shutil.copy(divided[0], copy)
    shutil.copytree(divided[0].with_suffix(""), copy.with_suffix(""))
    assert run(["tto", str(copy), "--space", "gaussians", "--steps", "2", "-q"]) == ExitCode.DONE


@pytest.mark.parametrize(
    ("command", "way"), [(("tto", "--space", "features"), "--space gaussians"), (("inspect",), "")]
)
def test_what_needs_queries_is_refused(
    command: tuple[str, ...], way: str, divided: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last optimisation undid what the queries decode to, so the scene has none."""
    verb, *more = command
    target = [] if verb == "tto" else ["-o", str(divided[0].parent / "figures")]
    assert run([verb, str(divided[0]), *more, *target]) == ExitCode.BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert "was joined from regions, and has no queries" in said
    assert way in said
    assert "--regions 1" in said


@pytest.fixture
def stopped(street: Path, divided: Made, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose run was stopped in the second region."""
    make = build.region_maker

    def stopping(setup: None) -> Any:
        work = make(setup)

        def once(folder: Path) -> None:
            if folder.name == "region-2":
                raise KeyboardInterrupt
            work(folder)

        return once

    with monkeypatch.context() as patch:
        patch.setattr(build, "region_maker", stopping)
        ply = street.parent / "stopped.ply"
        assert run(command(street, ply, "--regions", "2")) == ExitCode.INTERRUPTED
    return ply.parent / ".stopped.ply.unfinished"


def test_a_stopped_run_goes_on(street: Path, divided: Made, stopped: Path) -> None:
    assert not (stopped.parent / "stopped.ply").exists()
    (stopped / "region-2" / "task.pt").write_bytes(b"cut off")
    ply, report = reconstruct(street, "stopped", "--regions", "2")
    assert report["resumed"] == ["went on with the cameras and 1 region of an unfinished run"]
    assert ply.read_bytes() == divided[0].read_bytes()
    assert not stopped.exists()


def test_near_duplicates_do_not_count_for_regions(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames of a film that hardly moved would be divided into groups of one photo, or none."""
    listing = json.loads((street.parent / "transforms.json").read_text())
    photos = tmp_path / "photos"
    photos.mkdir()
    frames = []
    for frame in listing["frames"][:4]:
        for copy in ("a", "b"):
            name = f"{copy}_{Path(frame['file_path']).name}"
            shutil.copy(street / Path(frame["file_path"]).name, photos / name)
            frames.append({**frame, "file_path": f"photos/{name}"})
    (tmp_path / "transforms.json").write_text(json.dumps({**listing, "frames": frames}))
    assert run(command(photos, tmp_path / "s.ply", "--regions", "2")) == ExitCode.BAD_INPUT
    assert "photos with cameras are too few" in capsys.readouterr().err
