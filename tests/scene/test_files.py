"""Files are written completely or not at all."""

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import NoReturn

import pytest

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import (
    atomic_folder,
    atomic_path,
    check_writable,
    refuse_existing,
    refuse_replacing,
    sole_writer,
    writable,
)


def write_half(draft: Path, failure: BaseException) -> NoReturn:
    draft.write_text("half")
    raise failure


def listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_file_takes_its_place_at_the_end_with_the_usual_permissions(tmp_path: Path) -> None:
    path = tmp_path / "new" / "scene.ply"
    with atomic_path(path) as draft:
        draft.write_text("whole")
        assert draft.suffix == ".ply"
        assert not path.exists()
    plain = tmp_path / "plain"
    plain.touch()
    assert path.read_text() == "whole"
    assert path.stat().st_mode == plain.stat().st_mode
    assert listing(path.parent) == ["scene.ply"]


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError, MemoryError])
def test_an_interrupted_file_leaves_the_old_one(tmp_path: Path, interruption: type[BaseException]) -> None:
    path = tmp_path / "scene.ply"
    path.write_text("before")
    with pytest.raises(interruption), atomic_path(path) as draft:
        write_half(draft, interruption())
    assert path.read_text() == "before"
    assert listing(tmp_path) == ["scene.ply"]


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_an_interrupted_folder_leaves_the_old_one(tmp_path: Path, interruption: type[BaseException]) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "report.json").write_text("before")
    with pytest.raises(interruption), atomic_folder(folder) as draft:
        write_half(draft / "report.json", interruption())
    assert (folder / "report.json").read_text() == "before"
    assert listing(tmp_path) == ["scene", "scene/report.json"]


def test_a_folder_replaces_the_old_one_wholly(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    for name in ("first", "second"):
        with atomic_folder(folder) as draft:
            (draft / name).write_text(name)
    assert listing(tmp_path) == ["scene", "scene/second"]


def test_files_that_may_only_be_read_are_flushed_and_links_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a scene's parts, users keep what they like, also links to files that no one may write to."""
    fcntl = pytest.importorskip("fcntl")
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda handle: flushed.append(fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE))
    with atomic_folder(tmp_path / "scene") as draft:
        (draft / "notes.txt").touch(mode=0o444)
        (draft / "link").symlink_to("notes.txt")
    assert flushed == [os.O_RDONLY]
    assert (tmp_path / "scene" / "link").is_symlink()


def test_a_failed_swap_puts_the_old_folder_back(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "report.json").write_text("before")
    with pytest.raises(OSError, match="No such file"), atomic_folder(folder) as draft:
        draft.rmdir()
    assert (folder / "report.json").read_text() == "before"


def test_a_folder_has_one_writer_at_a_time(tmp_path: Path) -> None:
    with sole_writer(tmp_path):
        with pytest.raises(QuerySplatError, match="another process"), sole_writer(tmp_path):
            pass
        with sole_writer(tmp_path.parent):
            pass
    with sole_writer(tmp_path):
        assert not list(tmp_path.iterdir())


def test_a_full_disk_is_reported_in_words(tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="disk is full"), atomic_path(tmp_path / "scene.ply") as draft:
        write_half(draft, OSError(errno.ENOSPC, "No space left on device"))
    assert listing(tmp_path) == []


def test_folders_that_were_made_for_a_failed_write_are_gone_again(tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError), atomic_path(tmp_path / "made" / "too" / "scene.ply") as draft:
        write_half(draft, OSError(errno.ENOSPC, "No space left on device"))
    assert listing(tmp_path) == []


def test_the_message_names_the_output_where_a_draft_is_written_in_a_draft(tmp_path: Path) -> None:
    scene = tmp_path / "scene.ply"
    with pytest.raises(QuerySplatError) as caught, atomic_path(scene) as outer, atomic_path(outer) as draft:
        write_half(draft, OSError(errno.ENOSPC, "No space left on device"))
    assert caught.value.message == f"{scene}: the disk is full"


def test_a_write_that_fails_without_a_reason_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV reports only that it could not write."""
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(QuerySplatError, match="disk is full"), atomic_folder(tmp_path / "scene"):
        raise OSError("cannot write preview.png")


def test_a_full_disk_reported_by_another_library(tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="disk is full"), atomic_folder(tmp_path / "scene"):
        raise RuntimeError("Error while serializing: I/O error: No space left on device (os error 28)")
    with pytest.raises(RuntimeError, match="a bug"), atomic_folder(tmp_path / "scene"):
        raise RuntimeError("a bug")


def test_missing_permission_is_reported_in_words(tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="permission"), atomic_path(tmp_path / "scene.ply"):
        raise PermissionError(errno.EACCES, "Permission denied")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc here")
@pytest.mark.parametrize("folder", [Path("/proc"), Path("/proc/here")])
def test_a_place_where_no_file_can_be_made_is_named_without_the_draft(folder: Path) -> None:
    with pytest.raises(QuerySplatError, match=r"/proc\S*: nothing can be written there|no permission") as caught:
        check_writable(folder)
    assert "querysplat-" not in caught.value.message


def test_a_folder_without_permission_is_named_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(QuerySplatError) as caught:
        check_writable(tmp_path)
    assert caught.value.message == f"{tmp_path}: no permission to write there"


def test_a_file_where_a_folder_is_needed(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(QuerySplatError) as caught:
            check_writable(folder)
        assert caught.value.message == f"{folder}: a file is where a folder is needed"


def test_a_writable_folder_is_made_and_left_empty(tmp_path: Path) -> None:
    check_writable(tmp_path / "out")
    assert listing(tmp_path) == ["out"]


def test_a_folder_that_was_made_for_a_failed_run_is_gone_again(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no number"), writable(tmp_path / "new" / "sub"):
        int("no number")
    assert listing(tmp_path) == []
    with pytest.raises(KeyboardInterrupt), writable(tmp_path / "new" / "sub"):
        write_half(tmp_path / "new" / "result", KeyboardInterrupt())
    assert listing(tmp_path) == ["new", "new/result"]
    with writable(tmp_path / "out"):
        pass
    assert (tmp_path / "out").is_dir()


def test_existing_outputs_are_refused_by_name_unless_forced(tmp_path: Path) -> None:
    there, missing = tmp_path / "scene.ply", tmp_path / "scene"
    there.touch()
    with pytest.raises(QuerySplatError, match=r"scene\.ply") as caught:
        refuse_existing([there, missing], force=False)
    assert "--force" in caught.value.hint
    refuse_existing([there, missing], force=True)
    refuse_existing([missing], force=False)


@pytest.mark.parametrize("output", [".", "../p", "../q/../p"])
def test_a_proposed_output_is_a_path_that_can_be_given(
    output: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`-o -pictures` would be read as an option, and a name alone would lie in another folder."""
    (tmp_path / "p").mkdir()
    (tmp_path / "q").mkdir()
    monkeypatch.chdir(tmp_path / "p")
    with pytest.raises(QuerySplatError) as caught:
        refuse_replacing([tmp_path / "p"], [Path(output)], instead="-pictures")
    assert caught.value.hint == f"Choose another output, for instance -o {tmp_path / 'p-pictures'}."
