"""Drafts of killed processes are removed by the next run; nothing of the user's, and nothing that is in use, is."""

import errno
import os
import subprocess
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.drafts import DRAFTS, claimed, own_folder, put_aside, scratch_folder, sweep
from querysplat_cli.scene.files import (
    atomic_folder,
    atomic_path,
    atomic_together,
    check_writable,
    sole_writer,
    without_steps,
)

KILLED_BETWEEN_RENAMES = """
import os, signal, sys
from pathlib import Path
from querysplat_cli.scene import files

rename = os.rename
def rename_and_die(source, target):
    rename(source, target)
    if Path(target).parent.name == "before":
        os.kill(os.getpid(), signal.SIGKILL)

os.rename = rename_and_die
with files.atomic_folder(Path(sys.argv[1])) as draft:
    (draft / "new").touch()
"""

KILLED_WHILE_WRITING = """
import os, signal, sys
from pathlib import Path
from querysplat_cli.scene import files

with files.atomic_path(Path(sys.argv[1])) as draft:
    draft.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def killed(program: str, path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    assert done.returncode == -9


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EBADF])
def test_file_systems_without_locks_are_written_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, number: int
) -> None:
    in_use = tmp_path / f"{DRAFTS}12345678"
    in_use.mkdir()

    def no_locks(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", no_locks)
    with claimed(tmp_path / "scene"), atomic_folder(tmp_path / "scene") as draft, sole_writer(tmp_path):
        (draft / "new").touch()
    assert (tmp_path / "scene" / "new").is_file()
    assert listing(tmp_path) == [in_use.name, "scene", "scene/new"]  # it may be in use


def test_a_kill_between_two_renames_loses_no_scene(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "mine").touch()
    killed(KILLED_BETWEEN_RENAMES, scene)
    assert not scene.exists()
    check_writable(tmp_path)  # any later run that writes there
    assert listing(tmp_path) == ["scene", "scene/mine"]


def test_a_half_written_file_is_swept(tmp_path: Path) -> None:
    (tmp_path / "scene.ply").write_text("mine")
    killed(KILLED_WHILE_WRITING, tmp_path / "scene.ply")
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_path(tmp_path / "other.ply") as draft:
        draft.write_text("whole")
    assert listing(tmp_path) == ["other.ply", "scene.ply"]
    assert (tmp_path / "scene.ply").read_text() == "mine"


def test_folders_in_use_and_those_of_others_stay(tmp_path: Path) -> None:
    names = ["photos", f"{DRAFTS}notes", f"{DRAFTS}12345678.txt"]
    for name in names:
        (tmp_path / name).mkdir()
    (tmp_path / f"{DRAFTS}abcdefgh").symlink_to(tmp_path / "photos")
    (tmp_path / "photos" / "a.jpg").touch()
    with own_folder(tmp_path) as folder:
        sweep(tmp_path, DRAFTS)
        assert folder.is_dir()
        assert listing(tmp_path) == sorted([*names, f"{DRAFTS}abcdefgh", "photos/a.jpg", folder.name])
    assert not folder.exists()
    assert (tmp_path / "photos" / "a.jpg").exists()


def test_scratch_folders_of_killed_processes_are_swept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with ExitStack() as left:
        one, two = (left.enter_context(scratch_folder()) for _ in range(2))
        (one / "matches.db").touch()
        assert one != two
    (tmp_path / f"{one.name[:-8]}deadbeef").mkdir()
    with scratch_folder() as folder:
        assert listing(tmp_path) == [folder.name]


def test_all_outputs_take_their_places_or_none(tmp_path: Path) -> None:
    """The file cannot replace a folder that is not empty; then the scene folder stays as it was, too."""
    ply, folder = tmp_path / "s.ply", tmp_path / "s"
    for place in (ply, folder):
        place.mkdir()
        (place / "mine").touch()
    with suppress(OSError, QuerySplatError), atomic_together(ply, folder) as (one, two):
        one.write_text("new")
        two.mkdir()
    assert listing(tmp_path) == ["s", "s.ply", "s.ply/mine", "s/mine"]


@pytest.mark.parametrize("steps", ["s/../s", "s/.", "./s", "other/../s", "link/s"])
def test_places_are_found_before_anything_moves(steps: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("s", "other"):
        (tmp_path / name).mkdir()
    (tmp_path / "link").symlink_to(tmp_path)
    (tmp_path / "s" / "old").touch()
    monkeypatch.chdir(tmp_path)
    with atomic_folder(Path(steps)) as draft:
        (draft / "new").touch()
    assert listing(tmp_path / "s") == ["new"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "other", "s"]


def test_a_scene_is_replaced_from_inside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "s").mkdir()
    monkeypatch.chdir(tmp_path / "s")
    with atomic_folder(Path()) as draft:
        (draft / "new").touch()
    assert listing(tmp_path) == ["s", "s/new"]
    os.chdir(tmp_path)


def test_paths_that_end_in_no_name_are_refused() -> None:
    with pytest.raises(QuerySplatError, match="not the name of an output"):
        without_steps(Path("/"))
    with pytest.raises(QuerySplatError, match=r"no such place|no name"):
        without_steps(Path("a\0b/c"))


def fail_beside(place: Path, *, new: bool) -> None:
    """End early while `place` is put aside, after something new was made there or before."""
    with put_aside(place):
        assert not place.exists()
        if new:
            place.mkdir()
            (place / "new").touch()
        raise KeyboardInterrupt


@pytest.mark.parametrize("new", [False, True])
def test_what_was_put_aside_returns_after_an_exception(new: bool, tmp_path: Path) -> None:
    place = tmp_path / "photos"
    place.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        fail_beside(place, new=new)
    assert listing(tmp_path) == ["photos"]
    assert place.read_text() == "old"


def test_what_was_put_aside_is_gone_when_all_went_well(tmp_path: Path) -> None:
    place = tmp_path / "photos"
    place.write_text("old")
    with put_aside(place):
        place.write_text("new")
    assert listing(tmp_path) == ["photos"]
    assert place.read_text() == "new"


def test_where_nothing_was_put_aside_what_is_new_stays(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        fail_beside(tmp_path / "photos", new=True)
    assert listing(tmp_path) == ["photos", "photos/new"]
