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

try:
    import fcntl
except ImportError:  # Windows has no such locks: nothing is swept there
    fcntl = None  # type: ignore[assignment]

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
    folder, lock = _locked_folder(place, prefix)
    try:
        yield folder
    finally:
        _remove(folder)
        if lock is not None:
            os.close(lock)


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
    if fcntl is None:
        yield
        return
    folder = place.with_name(f"{DRAFTS}{sha256(place.name.encode()).hexdigest()[:RANDOM_LETTERS]}")
    lock = None
    while lock is None:
        folder.mkdir(exist_ok=True)
        try:
            lock = _lock(folder)
        except _NoLocks:
            break
        if lock is None and folder.is_dir():
            why = f"another process is making {place}"
            raise QuerySplatError(why, "Wait until it ends, or choose another output.")
    try:
        yield
    finally:
        _remove(folder)
        if lock is not None:
            os.close(lock)


def sweep(place: Path, prefix: str) -> None:
    """Remove the folders in `place` that processes of this user left when they were killed.

    What such a process was about to replace returns to its name, if nothing has that name now.
    """
    with suppress(OSError):
        for folder in place.glob(f"{prefix}{'?' * RANDOM_LETTERS}"):
            lock = _lock(folder)
            if lock is None:
                continue
            try:
                _remove(folder)
            finally:
                os.close(lock)


def _remove(folder: Path) -> None:
    """Remove a folder of drafts, after what it was about to replace has its name back, or is replaced."""
    before = folder / BEFORE
    with suppress(OSError):
        for path in before.iterdir() if before.is_dir() else ():
            if not os.path.lexists(folder.parent / path.name):
                os.rename(path, folder.parent / path.name)
        shutil.rmtree(folder, ignore_errors=True)


def _locked_folder(place: Path, prefix: str) -> tuple[Path, int | None]:
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
        try:
            lock = _lock(folder)
        except _NoLocks:
            return folder, None
        if fcntl is None or lock is not None or folder.is_dir():
            return folder, lock
        # Another process swept it before it was locked.


class _NoLocks(OSError):
    """The file system has no locks, so nobody can tell which folders are in use."""


def _lock(folder: Path) -> int | None:
    """The lock of a folder, to be closed; None where a living process has it, or it is another user's.

    Raises _NoLocks where the file system has none: NFS and some of clusters and containers.
    """
    if fcntl is None:
        return None
    try:
        if folder.is_symlink() or folder.stat().st_uid != os.geteuid():
            return None
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    except OSError as error:
        os.close(handle)
        raise _NoLocks from error
    with suppress(OSError):
        if folder.stat().st_ino == os.fstat(handle).st_ino:
            return handle
    os.close(handle)
    return None
