"""Writing files so that an interruption leaves what was there before."""

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from querysplat_cli.errors import QuerySplatError


def refuse_existing(paths: Sequence[Path], *, force: bool) -> None:
    """Raises QuerySplatError if one of `paths` exists (unless `force`) or its folder cannot be written to."""
    for path in paths:
        if path.exists() and not force:
            raise QuerySplatError(f"{path} exists already", "Choose another name with -o, or replace it with --force.")
        folder = next(parent for parent in path.absolute().parents if parent.exists())
        if not folder.is_dir() or not os.access(folder, os.W_OK):
            raise QuerySplatError(f"no permission to write in {folder}", "Choose another place with -o.")


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that takes its place when the block ends well, and goes when it does not."""
    with _in_words(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        draft = Path(name)
        try:
            yield draft
            with draft.open("rb") as file:
                os.fsync(file.fileno())
            draft.chmod(0o666 & ~_umask())
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """The same for a folder: what was there before is replaced as a whole."""
    with _in_words(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
        old = draft.with_name(f"{draft.name}-old")
        try:
            yield draft
            draft.chmod(0o777 & ~_umask())
            if path.exists():
                path.rename(old)
            try:
                draft.rename(path)
            except BaseException:
                if old.exists():
                    old.rename(path)
                raise
        finally:
            for leftover in (draft, old):
                if leftover.is_dir():
                    shutil.rmtree(leftover, ignore_errors=True)
                else:
                    leftover.unlink(missing_ok=True)


@contextmanager
def _in_words(path: Path) -> Iterator[None]:
    """Operating system errors in words that say what to do."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise QuerySplatError(
                f"the disk is full: {path} could not be written", "Free some space and run again."
            ) from error
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise QuerySplatError(f"no permission to write {path}", "Choose another place with -o.") from error
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
