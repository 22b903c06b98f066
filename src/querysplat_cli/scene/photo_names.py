"""The names of photos: the last parts of their paths, as few as tell them apart."""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePath, PurePosixPath

from querysplat_cli.runtime.current_folder import is_unicode


def short_names(paths: Sequence[PurePath]) -> list[str]:
    """The last parts of each path, as few as make it different from all others. None has a root or a `..`."""
    parts = [path_parts(path) for path in paths]
    different = list(dict.fromkeys(parts))
    depths = dict.fromkeys(different, 1)
    for depth in range(2, max(map(len, different), default=0) + 1):
        count = Counter(_ending(each, depths[each]) for each in different)
        depths = {each: depths[each] if count[_ending(each, depths[each])] == 1 else depth for each in different}
    return [_ending(each, depths[each]) for each in parts]


def path_parts(path: PurePath) -> tuple[str, ...]:
    """The folders and the file of a path, from the root of the file system on, which is not among them."""
    absolute = PurePath(os.path.abspath(path))
    return absolute.parts[1:]


def stated_parts(path: str) -> tuple[str, ...]:
    """The folders and the file of a path that a file of cameras states, without a root or a `..`."""
    return tuple(part for part in PurePosixPath(path).parts if part not in ("/", ".."))


def names_a_photo(name: str) -> bool:
    """Whether a text from a file can be the path of a photo: it ends in a file's name, in letters that exist."""
    return is_unicode(name) and PurePath(name).name not in ("", "..") and "\0" not in name


def _ending(parts: Sequence[str], depth: int) -> str:
    return "/".join(parts[-depth:])
