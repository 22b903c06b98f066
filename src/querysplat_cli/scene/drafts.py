"""Hidden folders for work in progress.

Each is locked by its process, so that the next run can remove what a killed process left.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.locks import NoLocks, lock

DRAFTS = ".querysplat-"
"""How the names of folders for drafts begin, beside the outputs."""
SCRATCH = "querysplat-scratch-"
"""How the names of temporary folders begin."""
RANDOM_LETTERS = 8
"""That follow, by `tempfile.mkdtemp`."""
BEFORE = "before"
"""The folder in a folder for drafts that has what a draft is about to replace."""


@contextmanager
def own_folder(place: Path, prefix: str = DRAFTS) -> Iterator[Path]:
    """A new folder in `place`, which is removed at the end with all that it holds.

    Folders that killed processes left there are removed first.
    """
    sweep(place, prefix)
    folder, held = _locked_folder(place, prefix)
    try:
        yield folder
    finally:
        _remove(folder)
        if held is not None:
            os.close(held)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A new folder for temporary files, in TMPDIR."""
    with own_folder(Path(tempfile.gettempdir()), SCRATCH) as folder:
        yield folder


@contextmanager
def put_aside(place: Path) -> Iterator[None]:
    """Inside, the name `place`, an absolute path, is free for something new. After any exception all is as before.

    Where nothing has that name, what is new stays in any case.
    """
    if not os.path.lexists(place):
        yield
        return
    with own_folder(place.parent) as folder:
        (folder / BEFORE).mkdir()
        os.rename(place, folder / BEFORE / place.name)
        try:
            yield
        except BaseException:
            # The name is free then, and the end of the folder for drafts gives it back.
            with suppress(OSError):
                os.rename(place, folder / place.name)
            raise


@contextmanager
def claimed(place: Path) -> Iterator[None]:
    """Keep other processes from making `place`, an absolute path, while this one does.

    The claim is a hidden folder beside it, which is swept after a kill. Raises QuerySplatError when another process has
    it. Windows and some file systems have no such locks, and nothing is claimed there.
    """
    folder = place.with_name(f"{DRAFTS}{sha256(place.name.encode()).hexdigest()[:RANDOM_LETTERS]}")
    held = None
    while held is None:
        folder.mkdir(exist_ok=True)
        try:
            held = _own_lock(folder)
        except NoLocks:
            break
        if held is None and folder.is_dir():
            why = f"another process is making {place}"
            raise QuerySplatError(why, "Wait until it ends, or choose another output.")
    try:
        yield
    finally:
        _remove(folder)
        if held is not None:
            os.close(held)


def sweep(place: Path, prefix: str) -> None:
    """Remove the folders in `place` that processes of this user left when they were killed.

    What such a process was about to replace returns to its name, if nothing has that name now.
    """
    with suppress(OSError):
        for folder in place.glob(f"{prefix}{'?' * RANDOM_LETTERS}"):
            held = _own_lock(folder)
            if held is None:
                continue
            try:
                _remove(folder)
            finally:
                os.close(held)


def _remove(folder: Path) -> None:
    """Remove a folder of drafts, after what it was about to replace has its name back, or is replaced."""
    before = folder / BEFORE
    with suppress(OSError):
        for path in before.iterdir() if before.is_dir() else ():
            if not os.path.lexists(folder.parent / path.name):
                os.rename(path, folder.parent / path.name)
        for inside, _, _ in os.walk(folder):
            os.chmod(inside, 0o700)  # nothing can be removed from a read-only folder
        shutil.rmtree(folder, ignore_errors=True)


def _locked_folder(place: Path, prefix: str) -> tuple[Path, int | None]:
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
        try:
            held = _own_lock(folder)
        except NoLocks:
            return folder, None
        if held is not None or folder.is_dir():
            return folder, held
        # Another process swept it before it was locked.


def _own_lock(folder: Path) -> int | None:
    """`lock` of a folder; None also where it is another user's, or no longer there. Raises NoLocks."""
    try:
        if folder.is_symlink() or (os.name != "nt" and folder.stat().st_uid != os.geteuid()):
            return None
        held = lock(folder)
    except NoLocks:
        raise
    except OSError:
        return None
    if held is None:
        return None
    with suppress(OSError):
        if folder.stat().st_ino == os.fstat(held).st_ino:
            return held
    os.close(held)
    return None
