"""Where libraries keep what they have compiled or found, where there is no home directory."""

import os
import stat
import tempfile
from collections.abc import MutableMapping
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def find_caches(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let numba and matplotlib use a temporary folder where they could write neither here nor in the home directory.

    Without one, numba refuses to compile. A variable that the environment has already stays as it is. Both libraries
    read the environment when they are imported.
    """
    if "NUMBA_CACHE_DIR" not in environment and not _writable(PACKAGE) and not _writable(_home(environment)):
        environment["NUMBA_CACHE_DIR"] = str(_own_folder() / "numba")
    if "MPLCONFIGDIR" not in environment and not _writable(_home(environment)):
        environment["MPLCONFIGDIR"] = str(_own_folder() / "matplotlib")


def is_cached(function: object) -> bool:
    """Whether numba's cache has an entry for the kernel, of whatever date: numba itself replaces old ones."""
    python, stats = function.py_func, function.stats  # type: ignore[attr-defined]
    name = f"{python.__module__.rpartition('.')[2]}.{python.__qualname__}-{python.__code__.co_firstlineno}.*.nbi"
    return any(Path(stats.cache_path).glob(name))


def hub_checkpoints() -> list[Path]:
    """The folder in which torch's hub keeps weights: none where the user has no home."""
    home = os.environ.get("TORCH_HOME")
    cache = _home(os.environ)
    torch_home = Path(home) if home else cache and cache / "torch"
    return [torch_home / "hub" / "checkpoints"] if torch_home else []


def _home(environment: MutableMapping[str, str]) -> Path | None:
    cache = environment.get("XDG_CACHE_HOME")
    try:
        return Path(cache) if cache else Path.home() / ".cache"
    except RuntimeError:  # no such user
        return None


def _writable(folder: Path | None) -> bool:
    """Whether files can be made in `folder`, or in the nearest folder above it that is there."""
    if folder is None:
        return False
    there = next((place for place in (folder, *folder.parents) if place.is_dir()), None)
    return there is not None and os.access(there, os.W_OK | os.X_OK)


def _own_folder() -> Path:
    """A temporary folder of this user alone, the same in every run: numba runs what it finds in its cache."""
    folder = Path(tempfile.gettempdir()) / f"querysplat-cache-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        facts = folder.lstat()
        if stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.getuid() and not facts.st_mode & 0o077:
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="querysplat-cache-"))
