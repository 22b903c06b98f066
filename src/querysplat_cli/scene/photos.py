"""Photo files of many kinds, decoded into one: upright, 8-bit RGB, not too large."""

import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.optional_parts import install_command
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.exif import Gps, focal_length, gps_place, says_panorama
from querysplat_cli.scene.masks import BadMask, mask_file, read_mask, resized_mask
from querysplat_cli.scene.photo_names import names_a_photo, short_names
from querysplat_cli.scene.views import LeftOut, Photo

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".heic", ".heif", ".avif"}
HEIF_SUFFIXES = {".heic", ".heif"}
FILM_SUFFIXES = {".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi"}
PICTURE_FOLDERS = ("images", "images_2", "images_4", "images_8")
"""Where DL3DV and nerfstudio keep the pictures of a scene, largest first."""
SCENE_FOLDERS = ("", "nerfstudio", "colmap")
"""Where in a scene's folder DL3DV's releases keep these picture folders."""
LONGEST_NUMBER = 100
"""Longer rows of digits in a name are sorted as text."""
SMALLEST_SIDE = 64
WHOLE = 1 << 16
"""As `max_side`, this reduces no photo."""
Keep = Callable[[Photo], Photo]
HALF_OPAQUE = 128
"""Pixels of a smaller alpha, of 255, take no part."""


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


def load_photos(
    paths: Sequence[Path],
    max_side: int = 1600,
    progress: Progress = lambda text, fraction: None,
    names: Sequence[str] | None = None,
    keep: Keep = lambda photo: photo,
) -> tuple[list[Photo], list[LeftOut]]:
    """Decoded photos in the order of `paths`, and the files that are not usable as photos, with the reason.

    Sides longer than `max_side` pixels are reduced (area filter). Transparency is laid over white, and masked, unless a
    file in `masks` says what takes part (`scene/masks.py`). 16-bit values keep their high byte; of several frames the
    first is taken; colour profiles are not applied. Without `names`, photos have those of their files, with as much of
    their folders as makes these unique. `keep` gets each photo as soon as it is decoded, and gives what is kept of it.
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
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = pool.map(lambda path, name: load_photo(path, name, max_side), paths, names)
        for number, result in enumerate(results, start=1):
            if isinstance(result, Photo):
                photos.append(keep(result))
            else:
                left_out.append(result)
            progress(result.name, number / len(paths))
    return photos, left_out


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
    try:
        if not path.stat().st_size:
            return LeftOut(name, "the file is empty")
        found = _decode(path, max_side)
        pixels, mask = found.pixels, _mask(path, found)
    except UnidentifiedImageError:
        return LeftOut(name, _why_not_a_picture(path))
    except BadMask as error:
        return LeftOut(name, str(error))
    except Image.DecompressionBombError:
        return LeftOut(name, "far too many pixels for a photo")
    except Exception as error:  # damage can raise anything in Pillow's decoders
        return LeftOut(name, f"it cannot be decoded: {error}")
    if min(pixels.shape[:2]) < SMALLEST_SIDE:
        return LeftOut(name, f"{pixels.shape[1]} × {pixels.shape[0]} pixels are too few")
    if mask is not None and not mask.any():
        return LeftOut(name, "its mask hides all of it")
    return Photo(name, path, pixels, found.focal, mask=mask, panorama=found.panorama, gps=found.gps)


def longer_side(path: Path, default: int) -> int:
    """The longer side of the picture in a file, in pixels; `default` where only its pixels show that."""
    if path.suffix.lower() in HEIF_SUFFIXES:
        _register_heif()
    try:
        with Image.open(path) as image:
            return max(image.size)
    except UnidentifiedImageError:
        return default


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
    inside = [each.name for each in sorted(folder.iterdir()) if each.is_dir() and any(map(_is_picture, each.iterdir()))]
    hint = f"There are pictures in its folder {inside[0]}." if inside else "Give a folder of JPEG or PNG photos."
    raise QuerySplatError(f"{folder}: no pictures in this folder", hint)


def _visible_files(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    return sorted(files, key=lambda file: (natural_key(file), file.name))


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES


@dataclass(frozen=True)
class _Decoded:
    """A picture file: upright, reduced RGB, the focal length in its pixels, where it is opaque, and if it is 360°."""

    pixels: np.ndarray
    focal: float | None = None
    opaque: np.ndarray | None = None
    panorama: bool = False
    gps: Gps | None = None


def _mask(path: Path, found: _Decoded) -> np.ndarray | None:
    """The pixels that take part by the mask's file, or else by the alpha channel; None where all of them do."""
    file = mask_file(path)
    if file is None and found.opaque is None:
        return None
    height, width = found.pixels.shape[:2]
    mask = read_mask(file, height, width) if file else resized_mask(np.asarray(found.opaque), height, width)
    return None if mask.all() else mask


def _decode(path: Path, max_side: int) -> _Decoded:
    if path.suffix.lower() in HEIF_SUFFIXES:
        _register_heif()
    try:
        image = Image.open(path)
    except UnidentifiedImageError:
        return _Decoded(reduced(_decode_deep_tiff(path), max_side))
    with image:
        focal, panorama, gps = focal_length(image), says_panorama(image), gps_place(image)
        width, height = image.size
        scale = min(1.0, max_side / max(width, height))
        image.draft("RGB", (round(width * scale), round(height * scale)))
        upright = ImageOps.exif_transpose(image)
        pixels = reduced(_rgb(upright), max_side)
        opaque = np.asarray(upright.convert("RGBA").getchannel("A")) >= HALF_OPAQUE if _has_alpha(upright) else None
    return _Decoded(pixels, focal and focal * max(pixels.shape) / max(width, height), opaque, panorama, gps)


def _rgb(image: Image.Image) -> np.ndarray:
    if image.mode.startswith("I"):
        high = np.asarray(image, dtype=np.int64) >> 8
        return np.repeat(high.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
    if image.mode == "F":
        raise ValueError("floating-point pixels have no agreed white")
    if _has_alpha(image):
        colour = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", colour.size, "white"), colour)
    return np.array(image.convert("RGB"))


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "La", "RGBa", "PA") or "transparency" in image.info


def _decode_deep_tiff(path: Path) -> np.ndarray:
    """TIFF kinds that Pillow cannot read, such as three channels of 16 bits."""
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.suffix.lower() in (".tif", ".tiff") else None
    if pixels is None:
        raise UnidentifiedImageError(path)
    return np.ascontiguousarray(pixels[..., ::-1])


def reduced(pixels: np.ndarray, max_side: int) -> np.ndarray:
    """Pixels [height, width, 3] whose longer side is at most `max_side` (area filter)."""
    height, width = pixels.shape[:2]
    scale = max_side / max(height, width)
    if scale >= 1:
        return pixels
    return cv2.resize(pixels, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)


def _register_heif() -> None:
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return
    register_heif_opener()


def _why_not_a_picture(path: Path) -> str:
    if path.suffix.lower() in HEIF_SUFFIXES:
        return f"HEIC needs one more package: {install_command('heic')}"
    return "not a picture that can be read"
