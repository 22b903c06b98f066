"""Files that appear whole or not at all."""

import errno
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

from querysplat_cli.runtime import signals
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.scene.drafts import BEFORE, DRAFTS, own_folder
from querysplat_cli.scene.locks import NoLocks, lock

NEARLY_FULL = 64 << 20
"""With fewer free bytes, a failed write that gives no reason is taken to be one of a full disk."""

NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
NO_FOLDER = {errno.ENOTDIR, errno.EEXIST}
PROBE = "probe"
"""Name of the file by which a folder is tried."""
OF_THE_SYSTEM = {".DS_Store", "Thumbs.db", "desktop.ini"}
"""Files that systems leave in folders that someone looked at."""


@dataclass(frozen=True)
class FolderKind:
    """What a command writes into a folder of its own: `--force` replaces such a folder, and none with other files.

    Patterns are those of fnmatch, for paths relative to the folder. One of the files is named by a pattern of `marks`,
    and all others by one of those or of `files`. Files with a name like those of `listed` have to be among what
    `listing` returns for the folder, as well: others have such names, too.
    """

    marks: tuple[str, ...]
    files: tuple[str, ...] = ()
    listed: tuple[str, ...] = ()
    listing: Callable[[Path], Collection[str]] = lambda folder: ()

    def refuse_others(self, folder: Path) -> None:
        """Raise QuerySplatError when `folder` is none of this kind; an empty one is of any kind."""
        if not folder.is_dir():
            raise QuerySplatError(f"{folder} is a file, and a folder goes there", "Choose another output.")
        names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
        own = self.listing(folder)
        foreign = min((name for name in names if not self._knows(name, own)), default=None)
        if foreign or (names and not any(_matches(name, self.marks) for name in names)):
            why = f"{folder} holds files that this command did not write, as {foreign or min(names)}"
            raise QuerySplatError(why, "Choose another output, or move them.")

    def _knows(self, name: str, own: Collection[str]) -> bool:
        if PurePosixPath(name).name in OF_THE_SYSTEM:
            return True
        return name in own if _matches(name, self.listed) else _matches(name, (*self.marks, *self.files))


def _matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def refuse_existing(paths: Sequence[Path], *, force: bool, kind: FolderKind | None = None) -> None:
    """Raise QuerySplatError when one of `paths` exists, unless `force`.

    Folders of that `kind` go there; None for files. A folder that holds the current folder or the home directory is
    refused in any case, and so is one of another kind.
    """
    for path in paths:
        if path.is_dir() and any(here.is_relative_to(path.resolve()) for here in _homes()):
            raise QuerySplatError(f"{path} holds the folder that you are in, or your home", "Choose another output.")
    existing = [path for path in paths if path.exists() or path.is_symlink()]
    if existing and not force:
        names = " and ".join(map(str, existing))
        raise QuerySplatError(f"{names}: there already", "Add --force to replace, or choose another output.")
    for path in existing:
        if kind:
            kind.refuse_others(path)
        elif path.is_dir():
            raise QuerySplatError(f"{path}: a folder has that name", "Choose another output.")


def _homes() -> list[Path]:
    """The current folder and the home directory, as far as there are any."""
    found = []
    for find in (Path.cwd, Path.home):
        with suppress(OSError, RuntimeError):
            found.append(find().resolve())
    return found


def refuse_replacing(inputs: Sequence[Path], outputs: Sequence[Path], *, instead: str = "-scene.ply") -> None:
    """Raise QuerySplatError when one of `outputs` would replace one of `inputs`, or a folder that holds it.

    The message proposes the output's name with the ending `instead`.
    """
    for path in inputs:
        here = path.resolve()
        for output in outputs:
            if output.resolve() in (here, *here.parents):
                why = f"the output {output} would replace {path}, which is read"
                other = without_steps(output)
                other = other.with_name(f"{other.name}{instead}")
                raise QuerySplatError(why, f"Choose another output, for instance -o {other}.")


def check_writable(folder: Path) -> None:
    """Make `folder` if it is missing, and raise QuerySplatError unless files can be made in it.

    Worth calling before long work whose result goes there.
    """
    with _draft(folder.resolve() / PROBE) as draft:
        draft.touch()


@contextmanager
def writable(folder: Path) -> Iterator[None]:
    """`check_writable`; on any exception the folders that were made for it are removed again, if nothing is in them."""
    with ExitStack() as undo:
        _take_back(folder.resolve(), undo)
        check_writable(folder)
        yield
        undo.pop_all()


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Hold `folder` for this process; raises QuerySplatError when another process holds it.

    The system frees the folder when the process ends, however it ends. Windows and some file systems have no such
    locks, and nothing is checked there.
    """
    with ExitStack() as stack:
        with suppress(NoLocks):
            held = lock(folder)
            if held is None:
                why = f"{folder}: another process is writing there"
                raise QuerySplatError(why, "Wait until it ends, or use another folder.")
            stack.callback(os.close, held)
        yield


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """The name of a draft with the same name as `path`. At the end the file of that name replaces `path`.

    On any exception, Ctrl-C included, the draft is removed and `path` stays as it was. A full disk and missing
    permission become QuerySplatError.
    """
    with atomic_together(path) as (draft,):
        yield draft


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """An empty draft folder. At the end it replaces `path`, with all that it then holds. It fails as `atomic_path`."""
    with atomic_together(path) as (draft,):
        draft.mkdir()
        yield draft


@contextmanager
def atomic_together(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """A draft for each of `paths`. At the end all of them take their places, or none does.

    A draft is a name that nothing has yet, in a hidden folder beside its path. Fails as `atomic_path` does.
    """
    with ExitStack() as stack:
        places = [without_steps(path) for path in paths]
        drafts = tuple(stack.enter_context(_draft(place)) for place in places)
        yield drafts
        for draft in drafts:
            for file in (draft, *draft.rglob("*")):
                if file.is_file() and not file.is_symlink():
                    _sync(file)
        # One after the other, so that errors of each are in words. Folders first: they can be put back.
        pairs = sorted(zip(drafts, places, strict=True), key=lambda pair: not pair[0].is_dir())
        with signals.held(), ExitStack() as undo:
            for draft, place in pairs:
                _exchange(draft, place, undo)
            undo.pop_all()


def write_json(path: Path, content: Any) -> None:
    """Write `content` as a .json that people can read, whole or not at all. Fails as `atomic_path` does."""
    with atomic_path(path) as draft:
        draft.write_text(json.dumps(content, indent=1) + "\n")


def with_name(path: Path) -> Path:
    """`path`, or where it ends in `.` or `..` the same place by a path that ends in a name."""
    return path if path.name not in ("", "..") else path.resolve()


def without_steps(path: Path) -> Path:
    """The same place by an absolute path without `.`, `..` or a symbolic link to a folder on the way.

    Raises QuerySplatError for a path that ends in no name.
    """
    try:
        place = with_name(path)
        place = place.parent.resolve() / place.name
    except (OSError, RuntimeError, ValueError) as error:
        raise QuerySplatError(f"{shown(str(path))}: no such place: {error}", "Choose another output.") from None
    if not place.name:
        raise QuerySplatError(f"{path}: not the name of an output", "Choose another output.")
    return place


def can_be_named(place: Path) -> bool:
    """Whether names as long as that of `place` are possible there."""
    try:
        os.lstat(place)
    except OSError as error:
        return error.errno != errno.ENAMETOOLONG
    return True


@contextmanager
def _draft(place: Path) -> Iterator[Path]:
    """A name for a draft of `place`, which is as `without_steps` makes it. Errors of writing are put in words."""
    try:
        with ExitStack() as undo:
            _take_back(place.parent, undo)
            place.parent.mkdir(parents=True, exist_ok=True)
            with own_folder(place.parent) as folder:
                yield folder / place.name
            undo.pop_all()
    except QuerySplatError:
        raise
    # safetensors has errors of its own for a full disk.
    except Exception as error:
        why = _in_words(error, place)
        if why is None:
            raise
        raise why from error


def _take_back(folder: Path, undo: ExitStack) -> None:
    """Let `undo` remove `folder` and those above it, as far as they are missing now and empty then."""
    for each in reversed([each for each in (folder, *folder.parents) if not each.exists()]):
        undo.callback(_remove_if_empty, each)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def _in_words(error: Exception, place: Path) -> QuerySplatError | None:
    # A draft may hold drafts; messages name the output.
    path = Path(*(part for part in place.parts if not part.startswith(DRAFTS)))
    shown = path.parent if path.name == PROBE else path
    reason = getattr(error, "errno", None)
    if reason in FORBIDDEN:
        return QuerySplatError(
            f"{shown}: no permission to write there", "Choose another output, or change the folder's permissions."
        )
    if reason in NO_FOLDER and not path.parent.is_dir():
        return QuerySplatError(f"{shown}: a file is where a folder is needed", "Choose another output.")
    if reason in NO_SPACE or os.strerror(errno.ENOSPC) in str(error) or _silent_failure(error, path.parent):
        return QuerySplatError(f"{shown}: the disk is full", "Free some space, or choose an output on another disk.")
    failed = Path(str(getattr(error, "filename", None)))
    if reason and (failed.name.startswith(DRAFTS) or failed in place.parents):
        why = f"{shown}: nothing can be written there: {os.strerror(reason)}"
        return QuerySplatError(why, "Choose another output.")
    return None


def _silent_failure(error: Exception, folder: Path) -> bool:
    """Whether a write failed without a reason, as OpenCV's do, on a disk that is nearly full."""
    without_reason = isinstance(error, OSError) and error.errno is None
    there = next(place for place in (folder, *folder.parents) if place.is_dir())
    return without_reason and shutil.disk_usage(there).free < NEARLY_FULL


def _exchange(draft: Path, place: Path, undo: ExitStack) -> None:
    """Put `draft` in its place, and add to `undo` what puts everything back."""
    if not draft.is_dir():
        os.replace(draft, place)
        return
    if os.path.lexists(place):
        # No portable call exchanges two folders, hence two renames. `sweep` puts the old one back after a kill.
        before = draft.parent / BEFORE / place.name
        before.parent.mkdir()
        os.rename(place, before)
        undo.callback(os.rename, before, place)
    os.rename(draft, place)
    undo.callback(os.rename, place, draft)


def _sync(file: Path) -> None:
    # A copy of a read-only file cannot be opened for writing. Windows flushes no others.
    with file.open("rb+" if os.name == "nt" else "rb") as handle:
        os.fsync(handle.fileno())
