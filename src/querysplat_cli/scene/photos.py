"""Photo files to pixels."""

import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from querysplat_cli.errors import QuerySplatError
from querysplat_cli.progress import Progress
from querysplat_cli.scene.views import LeftOut, Photo

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".heic", ".heif"}
PICTURE_FOLDERS = ("images", "images_2", "images_4", "images_8")
"""Where datasets keep their pictures, finest first."""
SMALLEST_SIDE = 64
LONGEST_SIDE = 1600
FILM_WIDTH = 36.0
"""Millimetres: the film that a 35 mm equivalent focal length refers to."""


def find_photos(inputs: Sequence[Path]) -> list[Path]:
    """Photo files of a folder, or the files given, in natural order (2 before 10).

    A dataset folder (DL3DV, nerfstudio) stands for its finest pictures folder. Raises QuerySplatError when
    there is nothing to read.
    """
    if len(inputs) == 1 and inputs[0].is_dir():
        folder = inputs[0]
        files = _pictures(folder)
        for name in PICTURE_FOLDERS:
            files = files or (_pictures(folder / name) if (folder / name).is_dir() else [])
        if not files:
            raise QuerySplatError(
                f"there are no photos in {folder}", f"Expected files such as {', '.join(sorted(SUFFIXES)[:6])}."
            )
        return files
    missing = [path for path in inputs if not path.exists()]
    if missing:
        raise QuerySplatError(f"{missing[0]}: no such file or folder", "Give a folder of photos, or photo files.")
    folders = [path for path in inputs if path.is_dir()]
    if folders:
        raise QuerySplatError(f"{folders[0]} is one folder among several inputs", "Give one folder, or files.")
    return sorted(dict.fromkeys(inputs), key=_natural)


def load_photos(paths: Sequence[Path], *, progress: Progress) -> tuple[list[Photo], list[LeftOut]]:
    """Decode photos, reduced to at most 1,600 pixels on the longer side; what cannot be used is left out by name.

    Raises QuerySplatError when none is left.
    """
    names = _names(paths)
    photos: list[Photo] = []
    left_out: list[LeftOut] = []
    with ThreadPoolExecutor() as pool:
        for done, (name, result) in enumerate(zip(names, pool.map(_decode, paths, names), strict=True), 1):
            if isinstance(result, Photo):
                photos.append(result)
            else:
                left_out.append(LeftOut(name, result))
            progress(name, done / len(paths))
    if not photos:
        told = "; ".join(f"{photo.name}: {photo.why}" for photo in left_out[:3])
        raise QuerySplatError(f"none of the {len(paths)} files is a usable photo ({told})", "Give JPEG or PNG photos.")
    return photos, left_out


def _pictures(folder: Path) -> list[Path]:
    files = (path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in SUFFIXES)
    return sorted((path for path in files if not path.name.startswith(".")), key=_natural)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", str(path))
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


def _names(paths: Sequence[Path]) -> list[str]:
    """The files' own names, with the folder before them where a name comes twice."""
    plain = [path.name for path in paths]
    return [f"{path.parent.name}_{path.name}" if plain.count(path.name) > 1 else path.name for path in paths]


def _decode(path: Path, name: str) -> Photo | str:
    """The photo, or why it cannot be used."""
    try:
        if path.stat().st_size == 0:
            return "the file is empty"
        if path.suffix.lower() in (".heic", ".heif") and not _can_read_heic():
            return "HEIC needs `pip install pillow-heif`"
        with Image.open(path) as image:
            if min(image.size) < SMALLEST_SIDE:
                return f"only {image.width} × {image.height} pixels"
            exif = image.getexif()
            focal = _focal(exif, max(image.size))
            if image.format == "JPEG":
                image.draft("RGB", (LONGEST_SIDE, LONGEST_SIDE))
            upright = ImageOps.exif_transpose(_to_rgb(image))
        scale = min(1.0, LONGEST_SIDE / max(upright.size))
        if scale < 1:
            size = (round(upright.width * scale), round(upright.height * scale))
            upright = upright.resize(size, Image.Resampling.BOX, reducing_gap=None)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        return f"not a readable picture ({_brief(error)})"
    return Photo(name, path, np.asarray(upright), focal and focal * max(upright.size))


def _to_rgb(image: Image.Image) -> Image.Image:
    """8-bit RGB; 16-bit grey is scaled, transparency is laid over black, as the scene's background is."""
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image, dtype=np.float64)
        top = 65535 if values.max() > 255 else 255
        converted = Image.fromarray((values / top * 255).round().clip(0, 255).astype(np.uint8)).convert("RGB")
        converted.info["exif"] = image.info.get("exif", b"")
        return converted
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        layered = image.convert("RGBA")
        flat = Image.new("RGB", image.size)
        flat.paste(layered, mask=layered.getchannel("A"))
        flat.info["exif"] = image.info.get("exif", b"")
        return flat
    return image.convert("RGB")


def _focal(exif: Image.Exif, longer_side: int) -> float | None:
    """Focal length in units of the longer side, from the 35 mm equivalent or the sensor's resolution."""
    details = exif.get_ifd(ExifTags.IFD.Exif)
    equivalent = details.get(ExifTags.Base.FocalLengthIn35mmFilm)
    if equivalent:
        return float(equivalent) / FILM_WIDTH
    length, dots = details.get(ExifTags.Base.FocalLength), details.get(ExifTags.Base.FocalPlaneXResolution)
    millimetres = {2: 25.4, 3: 10.0, 4: 1.0}.get(details.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if length and dots and millimetres:
        return float(length) * float(dots) / millimetres / longer_side
    return None


def _can_read_heic() -> bool:
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def _brief(error: Exception) -> str:
    return str(error).splitlines()[0].split(" '")[0][:80] if str(error) else type(error).__name__
