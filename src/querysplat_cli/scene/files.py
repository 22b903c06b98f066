"""Files that appear whole or not at all."""

import errno
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from querysplat_cli.runtime.errors import QuerySplatError

NEARLY_FULL = 64 << 20
"""With fewer free bytes, a failed write that gives no reason is taken to be one of a full disk."""

NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
NO_FOLDER = {errno.ENOTDIR, errno.EEXIST}


def refuse_existing(paths: Sequence[Path], *, force: bool) -> None:
    """Raise QuerySplatError when one of `paths` exists, unless `force`."""
    existing = [str(path) for path in paths if path.exists() or path.is_symlink()]
    if existing and not force:
        raise QuerySplatError(
            f"{' and '.join(existing)}: there already", "Add --force to replace, or choose another output."
        )


def refuse_replacing(inputs: Sequence[Path], outputs: Sequence[Path]) -> None:
    """Raise QuerySplatError when one of `outputs` would replace one of `inputs`, or a folder that holds it."""
    for path in inputs:
        here = path.resolve()
        for output in outputs:
            if output.resolve() in (here, *here.parents):
                raise QuerySplatError(f"{output} would replace {path}, which is read", "Choose another output.")


def check_writable(folder: Path) -> None:
    """Make `folder` if it is missing, and raise QuerySplatError unless files can be made in it.

    Worth calling before long work whose result goes there.
    """
    with _draft(folder / "probe") as draft:
        draft.touch()


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Hold `folder` for this process; raises QuerySplatError when another process holds it.

    The system frees the folder when the process ends, however it ends. Windows has no such locks, and nothing is
    checked there.
    """
    # The lock is on the folder itself. filelock would leave a file of its own among the user's.
    try:
        import fcntl
    except ImportError:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            why = f"{folder}: another process is writing there"
            raise QuerySplatError(why, "Wait until it ends, or use another folder.") from None
        yield
    finally:
        os.close(handle)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """The name of a draft beside `path`, with the same suffix. At the end the file of that name replaces `path`.

    On any exception, Ctrl-C included, the draft is removed and `path` stays as it was. A full disk and missing
    permission become QuerySplatError.
    """
    with _draft(path) as draft:
        yield draft
        _sync(draft)
        os.replace(draft, path)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """An empty draft folder beside `path`. At the end it replaces `path`, with all that it then holds.

    On any exception the draft is removed and `path` stays as it was. A full disk and missing permission become
    QuerySplatError.
    """
    with _draft(path) as draft:
        draft.mkdir()
        yield draft
        for file in draft.rglob("*"):
            if file.is_file():
                _sync(file)
        _swap(draft, path)


@contextmanager
def _draft(path: Path) -> Iterator[Path]:
    draft = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield draft
    except QuerySplatError:
        raise
    # safetensors has errors of its own for a full disk.
    except Exception as error:
        why = _in_words(error, path)
        if why is None:
            raise
        raise why from error
    finally:
        _remove(draft)


def _in_words(error: Exception, path: Path) -> QuerySplatError | None:
    reason = getattr(error, "errno", None)
    if reason in FORBIDDEN:
        return QuerySplatError(
            f"{path}: no permission to write there", "Choose another output, or change the folder's permissions."
        )
    if reason in NO_FOLDER and not path.parent.is_dir():
        return QuerySplatError(f"{path}: a file is where a folder is needed", "Choose another output.")
    if reason in NO_SPACE or os.strerror(errno.ENOSPC) in str(error) or _silent_failure(error, path.parent):
        return QuerySplatError(f"{path}: the disk is full", "Free some space, or choose an output on another disk.")
    return None


def _silent_failure(error: Exception, folder: Path) -> bool:
    """Whether a write failed without a reason, as OpenCV's do, on a disk that is nearly full."""
    without_reason = isinstance(error, OSError) and error.errno is None
    return without_reason and folder.is_dir() and shutil.disk_usage(folder).free < NEARLY_FULL


def _swap(draft: Path, path: Path) -> None:
    """Put `draft` in the place of `path`. No portable call exchanges two folders, hence two renames."""
    if not (path.exists() or path.is_symlink()):
        os.rename(draft, path)
        return
    before = draft.with_name(f"{draft.name}-before")
    os.rename(path, before)
    try:
        os.rename(draft, path)
    except BaseException:
        os.rename(before, path)
        raise
    _remove(before)


def _sync(file: Path) -> None:
    with file.open("rb+") as handle:
        os.fsync(handle.fileno())


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
