"""Photo files of many kinds, decoded into one: upright, 8-bit RGB, not too large."""

import os
import re
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.runtime.threads import cores
from querysplat_cli.scene.decoding import Decoded, decode, no_photo, why_not_a_picture
from querysplat_cli.scene.masks import IMAGES, MASKS, BadMask, mask_file, read_mask, resized_mask
from querysplat_cli.scene.photo_names import names_a_photo, short_names
from querysplat_cli.scene.views import LeftOut, Photo

SUFFIXES = {
    ".jpg", ".jpeg", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".heic", ".heif", ".avif",
}  # fmt: skip
FILM_SUFFIXES = {".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi", ".3gp"}
PICTURE_FOLDERS = ("images", "images_2", "images_4", "images_8")
"""Where DL3DV and nerfstudio keep the pictures of a scene, largest first."""
SCENE_FOLDERS = ("", "nerfstudio", "colmap")
"""Where in a scene's folder DL3DV's releases keep these picture folders."""
LONGEST_NUMBER = 100
"""Longer rows of digits in a name are sorted as text."""
SMALLEST_SIDE = 64
LONGEST_SIDE = 1600
"""Pixels to which photos and frames of films are reduced when they are read, unless something else is asked for."""
CAMERAS = "cameras.json"
"""In the folder of a scene that was made."""
WHOLE = 1 << 16
"""As `max_side`, this reduces no photo."""
Keep = Callable[[Photo], Photo]


def find_photos(inputs: Sequence[Path]) -> list[Path]:
    """The files to read, in natural order (2 before 10) within each folder, none twice.

    A folder means all files in it that are not hidden, or, where it has no pictures or films of its own, those in its
    largest `images`, `images_2`, `images_4` or `images_8` (a DL3DV, nerfstudio or COLMAP
    scene). Raises QuerySplatError when an input is missing or has neither pictures nor films.
    """
    if not inputs:
        raise QuerySplatError("no photos were given", "Give a folder of photos, or photos.")
    found: dict[Path, Path] = {}
    for path in inputs:
        if not path.exists():
            raise QuerySplatError(f"{path}: no such file or folder", "Give a folder of photos, or photos.")
        for file in _folder_photos(path) if path.is_dir() else [path]:
            found.setdefault(file.resolve(), file)
    return list(found.values())


def unread_folders(inputs: Sequence[Path]) -> list[LeftOut]:
    """Folders with pictures beside the photos of a given folder, which `find_photos` does not look into.

    Masks, the smaller copies of a dataset, and scenes that were made there are no such folders.
    """
    given, found = {path.resolve() for path in inputs}, []
    for folder in (path for path in inputs if path.is_dir() and any(map(_is_picture, _visible_files(path)))):
        for each in sorted(folder.iterdir()):
            # Unlike Path.is_file, isfile is False in a folder that may not be looked into.
            own = each.name.startswith((".", MASKS, IMAGES)) or os.path.isfile(each / CAMERAS)
            if each.is_dir() and not own and each.resolve() not in given and _holds_pictures(each):
                why = "a folder of pictures beside the photos; give it as well if they belong to the scene"
                found.append(LeftOut(each.name, why))
    return found


def load_photos(
    paths: Sequence[Path],
    max_side: int = LONGEST_SIDE,
    progress: Progress = lambda text, fraction: None,
    names: Sequence[str] | None = None,
    keep: Keep = lambda photo: photo,
) -> tuple[list[Photo], list[LeftOut]]:
    """Decoded photos in the order of `paths`, and the files that are not usable as photos, with the reason.

    Sides longer than `max_side` pixels are reduced (area filter). Transparency is laid over white, and masked, unless a
    file in `masks` says what takes part (`scene/masks.py`). 16-bit values keep their high byte; of several pages the
    first is taken, and animations are not usable; colour profiles are not applied. Without `names`, photos have those
    of their files, with as much of their folders as makes these unique. `keep` gets each photo as soon as it is
    decoded, and gives what is kept of it.
    Raises QuerySplatError when there is no usable photo at all.
    """
    photos, left_out = decoded_photos(paths, names or short_names(paths), max_side, progress, keep)
    if not photos:
        raise none_usable(left_out)
    return photos, left_out


def decoded_photos(
    paths: Sequence[Path], names: Sequence[str], max_side: int, progress: Progress, keep: Keep
) -> tuple[list[Photo], list[LeftOut]]:
    """As `load_photos`, under these names; there may be no usable photo."""
    photos: list[Photo] = []
    left_out: list[LeftOut] = []
    with closing(_read_ahead(paths, names, max_side)) as results:
        for number, result in enumerate(results, start=1):
            if isinstance(result, Photo):
                photos.append(keep(result))
            else:
                left_out.append(result)
            progress(result.name, number / len(paths))
    return photos, left_out


def _read_ahead(paths: Sequence[Path], names: Sequence[str], max_side: int) -> Generator[Photo | LeftOut, None, None]:
    """The photos in their order. At most two for each core wait in memory, or are left to decode after an error."""
    ahead = cores()
    rest = zip(paths, names, strict=True)
    pool = ThreadPoolExecutor(ahead)
    try:
        jobs = deque(pool.submit(load_photo, path, name, max_side) for path, name in islice(rest, 2 * ahead))
        while jobs:
            yield jobs.popleft().result()
            jobs.extend(pool.submit(load_photo, path, name, max_side) for path, name in islice(rest, 1))
    finally:
        pool.shutdown(cancel_futures=True)


def none_usable(left_out: Sequence[LeftOut]) -> QuerySplatError:
    """The error where no file is left to make a scene of."""
    return QuerySplatError(
        f"none of the {len(left_out)} files is a usable photo: "
        + "; ".join(f"{each.name} ({each.why})" for each in left_out[:3])
        + ("; …" if len(left_out) > 3 else ""),
        "Give JPEG, PNG, TIFF, WebP or BMP pictures, or MP4, MOV or WebM films.",
    )


def load_photo(path: Path, name: str, max_side: int) -> Photo | LeftOut:
    """One photo, as `load_photos` decodes it, or why it is not usable."""
    if not names_a_photo(str(path)):
        # Native libraries crash on such names.
        return LeftOut(os.fsencode(name).decode(errors="replace"), "its file name is not valid UTF-8; rename it")
    if why := no_photo(path):
        return LeftOut(name, why)
    try:
        if not path.stat().st_size:
            return LeftOut(name, "the file is empty")
        found = decode(path, max_side)
        pixels, mask = found.pixels, _mask(path, found)
    except UnidentifiedImageError:
        return LeftOut(name, why_not_a_picture(path))
    except BadMask as error:
        return LeftOut(name, str(error))
    except Image.DecompressionBombError:
        return LeftOut(name, "far too many pixels for a photo")
    except Exception as error:  # damage can raise anything in Pillow's decoders
        return LeftOut(name, f"it cannot be decoded: {error}")
    if min(pixels.shape[:2]) < SMALLEST_SIDE:
        what = "too few" if min(found.full) < SMALLEST_SIDE else "too long and narrow"
        return LeftOut(name, f"{found.full[1]} × {found.full[0]} pixels are {what}")
    if mask is not None and not mask.any():
        return LeftOut(name, "its mask hides all of it")
    return Photo(
        name, path, pixels, found.focal,
        mask=mask, panorama=found.panorama, gps=found.gps, orientation=found.orientation,
    )  # fmt: skip


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Sorts names as people do: photo_2 before photo_10, and upper case with lower case."""
    parts = re.split(r"(\d+)", path.name.casefold())
    # Python refuses to read numbers of more than 4,300 digits.
    return [(0, int(part)) if part.isdecimal() and len(part) < LONGEST_NUMBER else (1, part) for part in parts]


def _folder_photos(folder: Path) -> list[Path]:
    inner = [folder / scene / name for scene in SCENE_FOLDERS for name in PICTURE_FOLDERS]
    for place in (folder, *inner):
        files = _visible_files(place) if place.is_dir() else []
        if any(file.suffix.lower() in SUFFIXES | FILM_SUFFIXES for file in files):
            return files
    if not any(folder.iterdir()):
        raise QuerySplatError(f"{folder}: an empty folder", "Put the photos there, or give another folder.")
    inside = _picture_folders(folder, "*") or _picture_folders(folder, "*/*")
    others = [f"{file.name}: {why}." for file in _visible_files(folder) if (why := no_photo(file))]
    raise QuerySplatError(f"{folder}: no pictures in this folder", _where_pictures_are(inside, others))


def _picture_folders(folder: Path, pattern: str) -> list[str]:
    """The folders with pictures that match, by their paths in `folder`."""
    found = sorted(each for each in folder.glob(pattern) if each.is_dir() and _holds_pictures(each))
    return [each.relative_to(folder).as_posix() for each in found]


def _where_pictures_are(folders: list[str], others: list[str]) -> str:
    if not folders:
        return next(iter(others), "Give a folder of JPEG or PNG photos.")
    if len(folders) == 1:
        return f"There are pictures in its folder {folders[0]}."
    some = ", ".join(folders[:3]) + (", …" if folders[3:] else "")
    return f"There are pictures in its folders {some}: give those that belong together, one after the other."


def _holds_pictures(folder: Path) -> bool:
    try:
        return any(map(_is_picture, folder.iterdir()))
    except PermissionError:  # lost+found of a card
        return False


def _visible_files(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    return sorted(files, key=lambda file: (natural_key(file), file.name))


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES


def _mask(path: Path, found: Decoded) -> np.ndarray | None:
    """The pixels that take part by the mask's file, or else by the alpha channel; None where all of them do."""
    file = mask_file(path)
    if file is None and found.opaque is None:
        return None
    height, width = found.pixels.shape[:2]
    mask = (
        read_mask(file, height, width, found.orientation)
        if file
        else resized_mask(np.asarray(found.opaque), height, width)
    )
    return None if mask.all() else mask
