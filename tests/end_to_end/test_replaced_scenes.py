"""What --force replaces, and what of the user's it never touches."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.drafts import claimed


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photos, and with a scene `s` of one of them."""
    folder = tmp_path_factory.mktemp("place")
    photo = str(take_photos(folder / "photos", 3, 1)[0])
    assert run(["reconstruct", photo, "--max-size", "96", "--tto", "0", "-q", "-o", str(folder / "s.ply")]) == 0
    return folder


@contextmanager
def with_files(folder: Path, *names: str) -> Iterator[list[Path]]:
    """Files of the user's in a folder, which have to be there afterwards."""
    files = [folder / name for name in names]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("mine")
    yield files
    for file in files:
        assert file.read_text() == "mine"
        file.unlink()


@pytest.mark.parametrize(
    "command",
    [
        ["render", "s", "-o", "mine"],
        ["render", "s", "-o", "mine.mp4"],
        ["inspect", "s", "-o", "mine"],
        ["convert", "s", "mine"],
        ["convert", "s.ply", "mine.lod"],
        ["convert", "s.ply", "mine.ply"],
        ["convert", "s/cameras.json", "mine", "--photos", "photos"],
        ["convert", "s/cameras.json", "mine.json"],
        ["reconstruct", "photos", "-o", "mine.ply"],
        ["info", "s.ply", "--plot", "mine.png"],
        ["export", "s.ply", "-o", "mine.html"],
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("name", ["letter.txt", "holiday.png"])
def test_a_folder_of_other_files_is_never_replaced(
    place: Path, command: list[str], name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    output = next(word for word in command if word.startswith("mine"))
    with with_files(place / output, name) as (file,):
        assert run([*command, "--force"]) == ExitCode.BAD_INPUT
        file.parent.rename(place / "kept")  # no other file was written
        assert not [path for path in place.iterdir() if path.name.startswith(("mine", "."))]
        (place / "kept").rename(file.parent)
    file.parent.rmdir()
    assert output in capsys.readouterr().err


def test_the_folder_beside_a_cut_scene_is_no_other_folder(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with with_files(place / "cut", "letter.txt"):
        made = ["convert", str(place / "s.ply"), str(place / "cut.ply"), "--scale", "2", "--force"]
        assert run(made) == ExitCode.BAD_INPUT
    assert "letter.txt" in capsys.readouterr().err
    assert not (place / "cut.ply").exists()
    (place / "cut").rmdir()


@pytest.mark.parametrize(
    ("command", "beside", "mine"),
    [
        (["reconstruct", "photos", "-o", "mine.ply"], '{"frames": [{"file_path": "images/a.jpg"}]}', "images/only.jpg"),
        (["reconstruct", "photos", "-o", "mine.ply"], '[{"id": 0}]', "cfg_args"),
        (["convert", "s/cameras.json", "mine", "--photos", "photos"], '[{"id": 0}]', "images/only.jpg"),
        (["render", "s", "-o", "mine"], '{"frames": [{"file_path": "images/a.png"}]}', "holiday.png"),
        (["convert", "s", "mine"], None, "images.zip"),
    ],
)
def test_a_name_as_in_a_scene_makes_no_folder_this_programs(
    place: Path,
    command: list[str],
    beside: str | None,
    mine: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Other programs write a cameras.json as well, and users name their files as they like."""
    monkeypatch.chdir(place)
    folder = place / "mine"
    with with_files(folder, mine):
        if beside:
            (folder / "cameras.json").write_text(beside)
        assert run([*command, "--force"]) == ExitCode.BAD_INPUT
        assert "holds files that this command did not write" in capsys.readouterr().err
        assert beside is None or (folder / "cameras.json").read_text() == beside
    shutil.rmtree(folder)


def test_the_cameras_that_are_read_are_never_replaced(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (place / "s" / "cameras.json").read_text()
    poses = ["--poses", str(place / "s" / "cameras.json"), "--force"]
    assert run(["reconstruct", str(place / "photos"), "-o", str(place / "s.ply"), *poses]) == ExitCode.BAD_INPUT
    assert "cameras.json, which is read" in " ".join(capsys.readouterr().err.split())
    assert (place / "s" / "cameras.json").read_text() == before


def test_what_the_commands_wrote_is_replaced(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With what the system left in the folder, too."""
    monkeypatch.chdir(place)
    for command in (
        ["render", "s", "-o", "out", "--depth", "--float-depth"],
        ["inspect", "s", "-o", "out"],
        ["convert", "s", "out"],
        ["convert", "s", "out", "--text"],
        ["convert", "s.ply", "out.lod"],
    ):
        folder = Path(next(word for word in command if word.startswith("out")))
        for again in ([], ["--force"]):
            assert run([*command, *again, "-q"]) == ExitCode.DONE, command
            (folder / ".DS_Store").touch()
        for file in sorted(folder.rglob("*"), reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
        folder.rmdir()


def test_photos_of_the_demo_are_no_other_photos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with with_files(tmp_path / "photos", "holiday.jpg"):
        assert run(["demo", "-o", str(tmp_path), "--force"]) == ExitCode.BAD_INPUT
    assert "holiday.jpg" in capsys.readouterr().err


def test_a_scene_folder_keeps_the_files_of_the_user(place: Path) -> None:
    scene = str(place / "s")
    with with_files(place / "s", "notes.txt", "renders/one/a.png"):
        link = place / "s" / "latest"
        link.symlink_to("renders")
        assert run(["tto", scene, "--steps", "0", "-q"]) == ExitCode.DONE
        photo = str(next((place / "photos").iterdir()))
        made = ["reconstruct", photo, "--max-size", "96", "--tto", "0", "-o", f"{scene}.ply", "--force", "-q"]
        assert run(made) == ExitCode.DONE
        cut = ["convert", f"{scene}.ply", str(place / "cut.ply"), "--scale", "2", "-q"]
        assert run(cut) == ExitCode.DONE
        assert not (place / "cut" / "notes.txt").exists()  # it belongs to the first scene
        assert os.readlink(link) == "renders"
        link.unlink()


def test_a_photo_among_the_pictures_of_a_scene_stays(place: Path) -> None:
    with with_files(place / "s", "images/mine.jpg", "images/more/mine.jpg"):
        assert run(["tto", str(place / "s"), "--steps", "0", "-q"]) == ExitCode.DONE
    (place / "s" / "images" / "more").rmdir()


def test_the_folder_of_a_cut_scene_can_be_written_to(place: Path) -> None:
    """Also where that of the whole scene is protected."""
    parts = [Path("photos.json"), *(path.relative_to(place / "s") for path in (place / "s" / "images").iterdir())]
    for part in parts:
        (place / "s" / part).chmod(0o444)
    assert run(["convert", str(place / "s.ply"), str(place / "twice.ply"), "--scale", "2", "-q"]) == ExitCode.DONE
    assert all((place / "twice" / part).stat().st_mode & 0o200 for part in parts)


@pytest.mark.parametrize("verb", ["reconstruct", "tto"])
def test_a_scene_that_another_process_makes_is_left_alone(
    place: Path, verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = place / "s"
    photo = str(next((place / "photos").iterdir()))
    command = ["tto", str(scene)] if verb == "tto" else ["reconstruct", photo, "-o", f"{scene}.spz", "--force"]
    with claimed(scene):
        assert run(command) == ExitCode.BAD_INPUT
    assert "another process is making" in capsys.readouterr().err
    assert not [path for path in place.iterdir() if path.name.startswith(".")]


def test_a_link_to_a_scene_stays_one(place: Path) -> None:
    link = place / "link"
    link.symlink_to("s")
    before = (place / "s" / "report.json").read_text()
    assert run(["tto", str(link), "--steps", "1", "-q"]) == ExitCode.DONE
    assert link.is_symlink()
    assert (place / "s" / "report.json").read_text() != before
    assert not (place / "link.ply").exists()
    link.unlink()


def test_a_scene_whose_folder_is_a_link_keeps_its_file(place: Path) -> None:
    for part in ("s", "s.ply"):
        (place / part).rename(place / f"away-{part}")
    (place / "away-s.ply").rename(place / "s.ply")
    (place / "s").symlink_to("away-s")
    before = json.loads((place / "s" / "report.json").read_text())["tto"]
    assert run(["tto", str(place / "s.ply"), "--steps", "1", "-q"]) == ExitCode.DONE
    assert len(json.loads((place / "s" / "report.json").read_text())["tto"]) == len(before) + 1
    assert not (place / "away-s.ply").exists()
